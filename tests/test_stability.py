"""Extreme robots with the default scheme: a run is completed, or stops with a message.

The whole map is made by `benchmarks/stability.py`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from derjax import RolloutStats, Scene, SceneFile, State, Status, build
from derjax.core.pytree import replace
from derjax.integrate.frames import march_frames
from derjax.scenes.build import build_unchecked
from derjax.scenes.motortable import RateTable

TINY = SceneFile.model_validate({"robot": {"edge_length": 0.03}})
DRIVEN = TINY.model_copy(update={"motor_table": RateTable(time=(0, 0.25, 0.2501, 1), rpm=(0,) * 4)})


@jax.jit
def half_a_second(scene: Scene, state: State) -> tuple[State, RolloutStats]:
    """Five frames of two steps of the first length."""
    states, report = march_frames(scene, state, 5, 2)
    return jax.tree.map(lambda leaf: leaf[-1], states), report


def check(state: State, report: RolloutStats, known: Status = Status.OK) -> None:
    """The run was completed, or stopped where all was well, with a message, as is known of it."""
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))
    if report.ok:
        assert float(state.time) == pytest.approx(0.5)
    else:
        assert Status(int(report.status)) is known
        assert "failed" in report.message()
        assert float(state.time) == pytest.approx(float(report.failed_at))


EXTREMES: list[tuple[dict[str, float], Status]] = [
    ({"youngs_modulus": 1e4}, Status.OK),
    ({"youngs_modulus": 1e10}, Status.OK),
    ({"viscosity": 1e-3}, Status.OK),
    ({"viscosity": 1e3}, Status.OK),
    ({"rpm": 1.0}, Status.OK),
    ({"rpm": 2000.0}, Status.TOO_MANY),
    ({"rpm": -2000.0, "viscosity": 1e3}, Status.TOO_MANY),
    ({"rod_radius": 1e-4}, Status.OK),
    ({"rod_radius": 2e-2}, Status.OK),
    ({"regularization": 1e-6}, Status.OK),
    ({"regularization": 4e-2}, Status.MAX_ITERATIONS),  # drag is no positive matrix any more
    ({"helix_radius": 1e-9}, Status.MAX_ITERATIONS),  # an edge of no length
    ({"C_t": 0.0, "C_r": 0.0}, Status.OK),
]
"""Robots that nobody would build, and how their runs end: what is completed once stays so."""


@pytest.mark.parametrize(
    ("numbers", "known"),
    EXTREMES,
    ids=[", ".join(f"{k} {v:g}" for k, v in numbers.items()) for numbers, _ in EXTREMES],
)
def test_an_extreme_robot(numbers: dict[str, float], known: Status):
    scene = build_unchecked(TINY, numbers)
    check(*half_a_second(scene, scene.start), known)


@pytest.mark.parametrize(
    ("rpm", "known"),
    [
        ((60, 60, -60, -60), Status.OK),
        ((2000, 2000, -2000, -2000), Status.TOO_MANY),
        ((600, 600, 0, 0), Status.OK),
        ((0, 0, 0, 0), Status.OK),
    ],
    ids=str,
)
def test_a_motor_that_jumps(rpm: Any, known: Status):
    scene = build(DRIVEN, {"rpm": np.array(rpm, float)})
    check(*half_a_second(scene, scene.start), known)


def test_what_is_not_finite_is_told():
    for number in ("viscosity", "youngs_modulus", "rpm"):
        scene = build_unchecked(TINY, {number: jnp.nan})
        start = scene.start
        state, report = half_a_second(scene, start)
        assert Status(int(report.status)) is Status.NON_FINITE, number
        assert "not finite" in report.message()
        np.testing.assert_array_equal(state.q, start.q)
    scene = build(TINY)
    start = scene.start
    broken = replace(start, q=start.q.at[5].set(jnp.inf))
    assert Status(int(half_a_second(scene, broken)[1].status)) is Status.NON_FINITE
