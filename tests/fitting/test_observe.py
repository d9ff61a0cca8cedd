"""What the camera sees, and interpolation between steps."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from derjax import SceneFile, build
from derjax.rods.topology import Head
from fitting.observe import exposed, interpolation, observations, seen, silhouettes

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


def test_what_moves_while_the_shutter_is_open_is_blurred() -> None:
    exposure, rate = 0.2, 7.0
    wave, line = exposed(lambda t: (np.sin(rate * t), 3.0 * t), TIMES, exposure)
    half = 0.5 * rate * exposure
    np.testing.assert_allclose(wave, np.sin(half) / half * np.sin(rate * TIMES), atol=1e-5)
    np.testing.assert_allclose(line, 3.0 * TIMES, rtol=1e-14)
    sixth = exposed(lambda t: t**6, np.zeros(1), exposure)
    fifth = exposed(lambda t: t**5 + t**4, np.ones(1), exposure)
    mean = ((1.1**6 - 0.9**6) / 6 + (1.1**5 - 0.9**5) / 5) / exposure
    assert fifth == pytest.approx(mean, rel=1e-14)
    assert abs(sixth / (0.1**6 / 7) - 1) > 0.1


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


def stack(state: Any) -> Any:
    """A state as a stack of one."""
    return jax.tree.map(lambda x: x[None], state)


def pictured(scene: Any, q: np.ndarray, sight: int) -> np.ndarray:
    """(2,): centroid of the picture of a robot: pixels that a disc or one of the rods covers."""
    topology = scene.rod.topology
    keep = [k for k in range(3) if k != sight]
    nodes = q[: 3 * topology.n_nodes].reshape(-1, 3)[:, keep]
    head = nodes[topology.head.node]
    radii = (float(scene.parameters[name]) for name in ("head_radius", "rod_radius"))
    disc, rod = radii
    pixel = 0.25 * rod
    low, high = nodes.min(0) - 1.1 * disc, nodes.max(0) + 1.1 * disc
    grid = np.stack(
        np.meshgrid(*(np.arange(a, b, pixel) for a, b in zip(low, high, strict=True))), axis=-1
    )
    covered = np.linalg.norm(grid - head, axis=-1) < disc
    for start, end in topology.edges:
        along = nodes[end] - nodes[start]
        part = np.clip((grid - nodes[start]) @ along / (along @ along + 1e-30), 0, 1)
        covered |= np.linalg.norm(grid - nodes[start] - part[..., None] * along, axis=-1) < rod
    return grid[covered].mean(axis=0)


@pytest.fixture(scope="module")
def posed() -> Any:
    """A robot at rest, and a stack with it turned out of the axes."""
    scene = build(SceneFile())
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    n = 3 * scene.rod.topology.n_nodes
    nodes = np.asarray(scene.start.q[:n]).reshape(-1, 3) @ turn.T
    q = scene.start.q.at[:n].set(nodes.ravel())
    return scene, stack(replace(scene.start, q=q)), turn


@pytest.mark.parametrize("sight", [0, 1, 2])
def test_a_silhouette_is_that_of_a_picture(posed, sight) -> None:
    """To a tenth of what the flagellum moves the centroid by: it crosses itself in the picture."""
    scene, states, _ = posed
    keep = [k for k in range(3) if k != sight]
    found = np.asarray(silhouettes(scene, states, sight))[0, keep]
    head = np.asarray(observations(scene.rod.topology, states))[0, keep]
    picture = pictured(scene, np.asarray(states.q[0]), sight)
    assert np.linalg.norm(picture - head) > 5e-4
    assert np.linalg.norm(found - picture) < 0.1 * np.linalg.norm(picture - head)


def test_a_silhouette_turns_and_moves_with_the_robot_and_its_camera(posed) -> None:
    scene, _, _ = posed
    n = 3 * scene.rod.topology.n_nodes
    nodes = np.asarray(scene.start.q[:n]).reshape(-1, 3)
    here = np.asarray(silhouettes(scene, stack(scene.start), 2))[0]
    moved = nodes[:, [1, 2, 0]] + [0.3, -0.2, 0.1]  # x y z -> z x y: what was along z is along y
    q = scene.start.q.at[:n].set(moved.ravel())
    there = np.asarray(silhouettes(scene, stack(replace(scene.start, q=q)), 1))[0]
    assert there == pytest.approx(here[[1, 2, 0]] + [0.3, -0.2, 0.1], abs=1e-12)


def test_a_silhouette_is_smooth_in_states_and_parameters(posed) -> None:
    scene, states, _ = posed
    along = jnp.asarray(np.random.default_rng(1).normal(size=states.q.shape))

    def centroid(change):
        parameters = {**scene.parameters, "head_radius": 0.02 + 0.003 * change}
        moved = replace(states, q=states.q + 1e-3 * change * along)
        return silhouettes(replace(scene, parameters=parameters), moved, 2)[0, :2]

    _, exact = jax.jvp(centroid, (0.3,), (1.0,))
    differences = (centroid(0.3 + 1e-5) - centroid(0.3 - 1e-5)) / 2e-5
    assert np.asarray(exact) == pytest.approx(np.asarray(differences), rel=1e-6)
    straight = replace(states, q=states.q.at[:, 2::3].set(0.0))  # edges towards the camera
    down = jax.grad(lambda q: silhouettes(scene, replace(straight, q=q), 2)[0, 0])(straight.q)
    assert np.isfinite(down).all()


def test_the_angle_is_that_of_the_head_whatever_is_tracked(posed) -> None:
    scene, states, _ = posed
    head, robot = (np.asarray(seen(scene, states, sight)) for sight in (None, 2))
    assert np.array_equal(head, np.asarray(observations(scene.rod.topology, states)))
    assert np.array_equal(head[:, 3], robot[:, 3])
    assert np.linalg.norm(head[0, :2] - robot[0, :2]) > 1e-3
