"""Weight and buoyancy act on all of a robot: on its rods and on its head."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import share

from derjax import Scene, SceneFile, State, build, march_frames, positions
from derjax.core.status import Status
from derjax.terms import Gravity, HeadDrag, Inertia, ResistiveDrag

G = 9.81
DENSITY, FLUID = 1100.0, 1000.0


def robot(head: dict[str, Any], kind: str = "single_flagellum", **tables: Any) -> SceneFile:
    """A robot with a straight flagellum that sinks head first, with its motor at rest."""
    return SceneFile.model_validate(
        {
            "robot": {"kind": kind, "shape": "straight", "edge_length": 0.03},
            "material": {"density": DENSITY, "youngs_modulus": 1e9},
            "fluid": {"hydrodynamics": "rft", "fluid_density": FLUID},
            "head": head,
            "motor": {"rpm": 0.0},
            "time": {"step": 0.01, "end": 0.1, "inertia": False},
            "gravity": {"acceleration": [-G, 0.0, 0.0]},
            "contact": {"method": "none"},
            **tables,
        }
    )


def of_kind(scene: Scene, kind: type) -> Any:
    (term,) = (term for term in scene.terms if isinstance(term, kind))
    return term


def masses(scene: Scene, file: SceneFile) -> tuple[float, float]:
    """Of the robot and of the fluid in its place, by nodes, kg; the head's node is all head."""
    numbers, node = file.parameters, scene.rod.topology.head.node
    length = np.zeros(scene.rod.topology.n_nodes)
    np.add.at(
        length, scene.rod.topology.edge_nodes, 0.5 * np.asarray(scene.rod.rest_length)[:, None]
    )
    volume = np.pi * numbers["rod_radius"] ** 2 * length
    ball = 4 / 3 * np.pi * numbers["head_radius"] ** 3
    volume[node] = ball
    mass = volume * DENSITY
    mass[node] = file.head.mass or ball * DENSITY
    return float(mass.sum()), float(volume.sum() * FLUID)


@pytest.mark.parametrize("kind", ["single_flagellum", "two_flagella"])
@pytest.mark.parametrize("head", [{}, {"mass": 0.2}], ids=["ball", "given mass"])
def test_all_forces_are_the_weight_less_that_of_the_fluid(kind, head):
    file = robot(head, kind, time={"step": 0.01, "end": 0.1})
    scene = build(file)
    state = scene.start
    load = share(of_kind(scene, Gravity), scene.rod, state, file.step)
    n = 3 * scene.rod.topology.n_nodes
    mass, displaced = masses(scene, file)
    force = np.asarray(load.force[:n]).reshape(-1, 3).sum(axis=0)
    np.testing.assert_allclose(force, [-(mass - displaced) * G, 0, 0], rtol=1e-12)
    inertia = np.asarray(of_kind(scene, Inertia).mass[:n:3]).sum()
    assert inertia == pytest.approx(mass, rel=1e-12)


def test_a_robot_as_dense_as_the_fluid_is_neutral_everywhere():
    scene = build(robot({}, material={"density": FLUID}))
    assert not np.asarray(of_kind(scene, Gravity).buoyant_mass).any()


@jax.jit
def sink(scene: Scene, state: State) -> Any:
    return march_frames(scene, state, 1, 4)


@pytest.mark.parametrize("head", [{}, {"mass": 0.2}], ids=["ball", "given mass"])
def test_a_robot_sinks_as_fast_as_its_drag_allows(head):
    """Stokes' law for the head, resistive force theory for the flagellum, and all the weight."""
    file = robot(head)
    scene = build(file)
    state = scene.start
    states, report = sink(scene, state)
    assert int(report.status) == Status.OK
    topology = scene.rod.topology
    speed = positions(topology, states.velocity[0])[:, 0]
    (path,) = topology.filaments
    length = np.ptp(np.asarray(positions(topology, state.q))[list(path), 0])
    drag = float(of_kind(scene, ResistiveDrag).parallel) * length
    drag += 6 * np.pi * file.fluid.viscosity * file.robot.head_radius * file.head.C_t
    assert drag > 1.05 * float(of_kind(scene, HeadDrag).translation)
    mass, displaced = masses(scene, file)
    np.testing.assert_allclose(speed, -(mass - displaced) * G / drag, rtol=1e-3)
    others = positions(topology, states.q[0] - state.q)[:, 1:]
    assert float(jnp.abs(others).max()) < 1e-9


def test_a_light_head_rises():
    scene = build(robot({"mass": 0.1}))
    state = scene.start
    states, _ = sink(scene, state)
    assert float(states.q[0, 0] - state.q[0]) > 1e-4
