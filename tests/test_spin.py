"""Drag on rods that spin about their own axis."""

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import advance, finite_difference_jvp, share

from derjax import SceneFile, State, angles, build, march_frames, positions
from derjax.core.errors import InputError
from derjax.core.pytree import replace
from derjax.integrate.step import Scene
from derjax.rods.rod import transport_frames
from derjax.scenes.load import load_scene
from derjax.terms import SpinDrag

march = jax.jit(march_frames, static_argnums=(2, 3))

LENGTH, RADIUS, MODULUS = 0.1, 1e-2, 1e4
"""Of a thick rod, which whirls after few turns: m, m, Pa."""

BENDING = MODULUS * np.pi * RADIUS**4 / 4
TWISTING = 2 / 3 * BENDING
ZETA = 4 * np.pi * RADIUS**2
"""Drag per length on its spin in a fluid of 1 Pa s, N s."""

WHIRLING = 8.9 * BENDING / (ZETA * LENGTH**2)
"""Rate (rad/s) above which a rod that is turned at one end leaves its axis (Wolgemuth, Powers &
Goldstein, Phys. Rev. Lett. 84, 1623, 2000)."""


def rod_on_a_motor(rate: float, n_edges: int, turns: float, **tables: Any) -> SceneFile:
    """A straight rod on a fixed motor (rad/s)."""
    content = {
        "robot": {
            "kind": "clamped",
            "n_flagella": 1,
            "shape": "straight",
            "axial_length": LENGTH,
            "rod_radius": RADIUS,
            "edge_length": LENGTH / n_edges,
        },
        "material": {"youngs_modulus": MODULUS},
        "fluid": {"hydrodynamics": "rft", "spin_drag": True, "fluid_density": 0.0},
        "motor": {"rpm": rate * 30 / np.pi},
        "time": {"end": turns * 2 * np.pi / rate, "inertia": False},
    }
    return SceneFile.model_validate(content | tables)


def run(file: SceneFile) -> tuple[Scene, State]:
    """The scene, and the states at its frames."""
    scene = build(file)
    state = scene.start
    states, report = march(scene, state, file.n_frames, file.steps_per_frame)
    report.raise_if_failed()
    return scene, states


def test_the_tip_lags_behind_the_motor():
    """zeta omega L^2 / 2 GJ, from a torque that grows linearly from the tip; on any mesh."""
    scene, states = run(rod_on_a_motor(WHIRLING / 5, 4, turns=4.0))
    turned = angles(scene.rod.topology, states.q) + 2 * np.pi * states.turns
    exact = ZETA * WHIRLING / 5 * LENGTH**2 / (2 * TWISTING)
    assert float(turned[-1, 0] - turned[-1, -1]) == pytest.approx(exact, rel=1e-6)


@lru_cache
def excursion(part: float) -> np.ndarray:
    """Distance of the tip from the axis (in lengths) at a part of the rate of whirling.

    Its own weight disturbs the rod, by a hundredth of its length.
    """
    turns, n_frames = 20, 160
    end = turns * 2 * np.pi / (part * WHIRLING)
    tables = {
        "gravity": {"acceleration": [0.0, 0.0, -0.02]},
        "time": {"end": end, "frame": end / n_frames, "tolerance": 2e-3, "inertia": False},
    }
    tables["time"]["step"] = end / n_frames / 2  # as many at any rate: one program
    scene, states = run(rod_on_a_motor(part * WHIRLING, 8, turns, **tables))
    tip = np.asarray(positions(scene.rod.topology, states.q))[:, -1]
    return np.hypot(tip[:, 1], tip[:, 2]) / LENGTH


@pytest.mark.slow
def test_below_the_threshold_a_rod_stays_on_its_axis():
    assert excursion(0.85).max() < 0.03


def test_above_the_threshold_a_rod_whirls():
    away = excursion(1.15)
    assert away[: len(away) // 10].max() < 0.05
    assert away[-1] > 0.3


def with_resistance(scene: Scene, resistance: Any) -> Scene:
    """The scene with another drag per length on the spin (N s)."""
    terms = (
        replace(t, resistance=resistance) if isinstance(t, SpinDrag) else t for t in scene.terms
    )
    return replace(scene, terms=tuple(terms))


def test_derivatives_of_a_step():
    """Forward and reverse mode against differences, of a bent rod that spins and moves."""
    file = rod_on_a_motor(WHIRLING, 3, 1, time={"step": 1e-2, "end": 1e-2, "inertia": False})
    scene = build(file)
    state = scene.start
    aside = 3 * np.array([2, 3, 4]) + 1
    bent = state.q.at[aside].add(jnp.array([0.01, 0.03, 0.06]))
    state = transport_frames(scene.rod, state, bent)

    def outcome(resistance: Any) -> Any:
        return advance(with_resistance(scene, resistance), state)[0].q

    forward = jax.jit(lambda zeta: jax.jvp(outcome, (zeta,), (zeta,)))
    expected = finite_difference_jvp(lambda zeta: forward(zeta)[0], ZETA, ZETA, step=1e-3)
    slope = forward(ZETA)[1]
    assert np.abs(slope[-3:]).min() > 1e-3
    np.testing.assert_allclose(slope, expected, rtol=1e-6, atol=1e-10)
    back = jax.jit(jax.grad(lambda zeta: outcome(zeta).sum()))(ZETA)
    assert float(ZETA * back) == pytest.approx(float(slope.sum()), rel=1e-9)


@pytest.mark.parametrize(
    "tables",
    [
        pytest.param(
            {"time": {"step": 0.02, "end": 0.1, "scheme": "trbdf2"}}, marks=pytest.mark.slow
        ),
        {"time": {"step": 1e-4, "end": 5e-4, "scheme": "explicit"}},
        pytest.param(
            {"solver": {"method": "blocks"}, "time": {"step": 0.02, "end": 0.1}},
            marks=pytest.mark.slow,
        ),
    ],
    ids=["trbdf2", "explicit", "blocks"],
)
def test_spin_drag_slows_the_flagellum_in_every_scheme_and_solver(tables):
    """Turned by the same motor against a head that may turn as well, it turns less."""
    fluid = {"hydrodynamics": "rft", "spin_drag": True}
    file = SceneFile.model_validate({"robot": {"edge_length": 0.03}, "fluid": fluid} | tables)
    scene = build(file)
    state = scene.start
    turned = []
    for resistance in (0.0, 4 * np.pi * file.robot.rod_radius**2):
        states, report = march(
            with_resistance(scene, jnp.asarray(resistance)), state, 1, file.n_steps
        )
        report.raise_if_failed()
        turned.append(angles(scene.rod.topology, states.q[0])[np.array([0, -1])])
    (head, tip), (head_with_drag, tip_with_drag) = np.abs(turned)
    assert head_with_drag > head * (1 + 1e-4)
    assert tip_with_drag < tip * (1 - 1e-4)


def test_the_torque_of_a_rod_that_turns_as_a_whole_is_that_of_its_cylinder():
    """Also of one that turns about another axis: only the spin about its own meets drag."""
    file = rod_on_a_motor(1.0, 4, turns=1.0)
    scene = build(file)
    state = scene.start
    (drag,) = (t for t in scene.terms if isinstance(t, SpinDrag))
    topology = scene.rod.topology
    x = np.asarray(positions(topology, state.q))
    for axis in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.6, 0.8, 0.0]):
        rate = np.concatenate([np.cross(axis, x).ravel(), np.full(topology.n_edges, axis[0])])
        force = share(drag, scene.rod, state, 1e-3).gradient(state.q + 1e-3 * rate)
        power = float(force @ rate)
        length = LENGTH * (1 + 1 / 4)  # with the shaft
        expected = ZETA * length * axis[0] ** 2
        assert power == pytest.approx(expected, rel=1e-9, abs=1e-15)


def test_spin_drag_needs_a_fluid(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text("[fluid]\nhydrodynamics = 'none'\nspin_drag = true\n")
    with pytest.raises(InputError, match=r"scene.toml: \[fluid\] spin_drag = true: .* has none"):
        load_scene(path)
