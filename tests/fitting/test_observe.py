"""What the camera sees, and interpolation between steps."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from derjax import SceneFile, build
from derjax.rods.topology import Head
from fitting.observe import interpolation, observations

STEP = 0.04
TIMES = np.array([0.0, 0.013, 0.04, 0.0401, 0.07, 0.12, 0.333, 0.4, 0.48 - 1e-14, 0.5])


def test_frames_on_steps_are_taken_as_they_are() -> None:
    values = np.random.default_rng(0).normal(size=(30, 2))
    frames = np.array([0, 1, 7, 29])
    at_frames = interpolation(frames * STEP, STEP)
    assert np.array_equal(at_frames(values), values[frames])
    assert at_frames.n_steps == 29


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_motions_quadratic_in_time_are_exact(degree) -> None:
    grid = STEP * np.arange(20)
    found = interpolation(TIMES, STEP)(grid[:, None] ** degree)[:, 0]
    assert np.allclose(found, TIMES**degree, rtol=0, atol=1e-12)


def test_error_is_of_third_order() -> None:
    def error(step: float) -> float:
        times = np.linspace(0.0, 1.0, 1777)
        values = np.sin(3.0 * step * np.arange(round(1.0 / step) + 4))
        return np.abs(interpolation(times, step)(values) - np.sin(3.0 * times)).max()

    order = np.log2(error(0.02) / error(0.01))
    assert order == pytest.approx(3.0, abs=0.3)


def test_interpolation_only_needs_the_steps_it_names() -> None:
    for time in TIMES[1:]:
        at_frame = interpolation(np.array([time]), STEP)
        values = np.full(40, np.nan)
        values[: at_frame.n_steps + 1] = 1.0
        assert at_frame(values)[0] == pytest.approx(1.0, abs=1e-12)


def test_head_node_and_angle_with_whole_turns() -> None:
    scene = build(SceneFile())
    state = scene.start
    topology = replace(scene.rod.topology, head=Head(node=1, line=(1, 0), edges=(0,)))
    q = state.q.at[topology.edge_dofs([0])[0]].set(0.25)
    state = replace(state, q=q, turns=state.turns.at[0].set(-3.0))
    states = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    seen = np.asarray(observations(topology, states))
    assert seen.shape == (2, 4)
    assert np.array_equal(seen[1, :3], np.asarray(state.q[3:6]))
    assert seen[0, 3] == pytest.approx(0.25 - 6 * np.pi, rel=1e-14)


def test_a_robot_without_a_head_cannot_be_tracked() -> None:
    scene = build(SceneFile())
    state = scene.start
    with pytest.raises(ValueError, match="head"):
        observations(replace(scene.rod.topology, head=None), state)
