"""Robots of all sizes move alike if their dimensionless groups are the same."""

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from derjax import SceneFile, build, march_frames, positions
from derjax.results.dataset import to_dataset
from derjax.results.summary import summarise
from derjax.scenes.plausibility import USUAL_LENGTHS

march = jax.jit(march_frames, static_argnums=(2, 3))

SWIMMER = {"robot": {"edge_length": 0.03}, "time": {"end": 0.5}}
SCENES: dict[str, dict[str, Any]] = {
    "rss": SWIMMER,
    "rft": SWIMMER | {"fluid": {"hydrodynamics": "rft", "spin_drag": True}},
    "second order": SWIMMER | {"time": {"end": 0.3, "scheme": "trbdf2"}},
    "contact": {
        "robot": {
            "kind": "two_flagella",
            "phase": [np.pi, 0.0],
            "separation": 0.012,
            "axial_length": 0.0636,
            "pitch": 0.0318,
            "edge_length": 0.02,
        },
        "friction": {},
        "time": {"end": 1.0},
    },
}


class Outcome(NamedTuple):
    """A run without dimensions.

    Attributes:
        shape: (t, n, 3) positions over the radius of the helix.
        numbers: speed over that of the helix, head rate over the motor's, efficiency.
        counts: steps, rejected steps, Newton iterations.
        touching: mean number of contacts.
    """

    shape: np.ndarray
    numbers: np.ndarray
    counts: tuple[int, ...]
    touching: float


def scaled(content: dict[str, Any], size: float, slowness: float) -> SceneFile:
    """A scene, so many times larger and slower.

    Forces of inertia, viscosity and elasticity keep their ratios with Young's modulus as it is.
    """
    robot, density = content["robot"], 1260.0 * slowness**2 / size**2
    lengths = USUAL_LENGTHS | {k: v for k, v in robot.items() if k in USUAL_LENGTHS}
    scene = content | {
        "robot": robot | {key: size * length for key, length in lengths.items()},
        "material": {"density": density},
        "fluid": content.get("fluid", {}) | {"viscosity": slowness, "fluid_density": density},
        "motor": {"rpm": 60.0 / slowness},
        "time": content["time"] | {"end": slowness * content["time"]["end"]},
    }
    return SceneFile.model_validate(scene)


@lru_cache
def outcome(name: str, size: float, slowness: float) -> Outcome:
    file = scaled(SCENES[name], size, slowness)
    scene = build(file)
    state = scene.start
    states, report = march(scene, state, file.n_frames, file.steps_per_frame)
    report.raise_if_failed()
    trajectory = to_dataset(scene, jax.tree.map(np.asarray, states))
    summary = summarise(trajectory)
    rate, radius = 2 * np.pi / slowness, file.robot.helix_radius
    return Outcome(
        shape=np.asarray(positions(scene.rod.topology, states.q)) / radius,
        numbers=np.array(
            [
                summary["v_x_m_per_s"] / (rate * radius),
                summary["head_rate_rad_per_s"] / rate,
                summary["efficiency"],
            ]
        ),
        counts=(int(report.steps), int(report.rejected), int(report.iterations)),
        touching=summary.get("contact_count", 0.0),
    )


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n == "rss" else pytest.mark.slow) for n in SCENES]
)
@pytest.mark.parametrize(
    ("size", "slowness"),
    [
        (1e-3, 1.0),
        pytest.param(1e3, 1.0, marks=pytest.mark.slow),
        pytest.param(1e-3, 1e-3, marks=pytest.mark.slow),
        (1e3, 1e3),
    ],
)
def test_size_does_not_matter(name, size, slowness):
    usual, other = outcome(name, 1.0, 1.0), outcome(name, size, slowness)
    extent = np.ptp(usual.shape)
    np.testing.assert_allclose(other.shape, usual.shape, rtol=0, atol=1e-9 * extent)
    np.testing.assert_allclose(other.numbers, usual.numbers, rtol=1e-9)
    assert other.counts[:2] == usual.counts[:2]
    assert abs(other.counts[2] - usual.counts[2]) <= 2  # rounding may decide on the last
    assert (usual.touching > 0) == (name == "contact")


def test_a_bacterium_swims_as_resistive_force_theory_says():
    """E. coli with a rigid flagellum: the balance of forces and torques along its axis.

    With the coefficients of Gray and Hancock it swims at 24.6 um/s and its head turns at -10.2
    turns a second.
    """
    robot = {"helix_radius": 0.2e-6, "pitch": 2.3e-6, "axial_length": 5.4e-6}
    robot |= {"rod_radius": 0.01e-6, "edge_length": 0.1e-6, "head_radius": 0.7e-6}
    file = SceneFile.model_validate(
        {
            "robot": robot,
            "material": {"youngs_modulus": 1e12},
            "fluid": {"viscosity": 1e-3, "hydrodynamics": "rft"},
            "head": {"C_t": 1.0, "C_r": 1.0},
            "motor": {"rpm": 13_200.0},
            "time": {"end": 0.01},
        }
    )
    scene = build(file)
    state = scene.start
    states, report = march(scene, state, file.n_frames, file.steps_per_frame)
    report.raise_if_failed()
    summary = summarise(to_dataset(scene, jax.tree.map(np.asarray, states)))
    assert abs(summary["v_x_m_per_s"]) == pytest.approx(24.6e-6, rel=0.02)
    assert summary["head_rate_rad_per_s"] / (2 * np.pi) == pytest.approx(-10.2, rel=0.02)
