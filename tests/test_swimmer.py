"""A whole robot: balances that hold exactly, and the limit in which it is rigid."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import acting, advance, potential

from benchmarks.rigid import rigid_motions
from benchmarks.rigid_limit import free_motion
from derjax import Scene, SceneFile, State, build, positions, roll_frames
from derjax.core.pytree import replace
from derjax.rods.kinematics import angles
from derjax.terms import Bend, HeadDrag, StokesletSegments, Twist

RPM = 50.0
RATE = RPM * 2 * np.pi / 60


class Moment(NamedTuple):
    """A step in the middle of a run: scene, state before it, and the step's end, unwrapped."""

    file: SceneFile
    scene: Scene
    state: State
    q: jax.Array
    velocity: jax.Array


@jax.jit
def run_and_step(scene, state):
    states, report = roll_frames(scene, state, 1, 40)
    before = jax.tree.map(lambda leaf: leaf[-1], states)
    after, info = advance(scene, before)
    return before, after, report, info


def swim(modulus: float, step: float) -> Moment:
    """Forty steps from rest, and one more."""
    file = SceneFile.model_validate(
        {
            "robot": {"edge_length": 12e-3},
            "material": {"youngs_modulus": modulus},
            "motor": {"rpm": RPM},
            "time": {"step": step, "end": 50 * step, "scheme": "euler", "inertia": False},
            "solver": {"tolerance": 1e-12},
        }
    )
    scene = build(file)
    state = scene.start
    before, after, report, info = run_and_step(scene, state)
    report.raise_if_failed()
    assert info.status == 0
    velocity = after.history.moves[0] / step
    return Moment(file, scene, before, before.q + step * velocity, velocity)


@pytest.fixture(scope="module")
def soft() -> Moment:
    """The paper's robot, coarsely divided."""
    return swim(1.255e6, 1e-2)


@pytest.fixture(scope="module")
def stiff() -> Moment:
    """A thousand times stiffer, and in steps ten times shorter."""
    return swim(1.255e9, 1e-3)


@jax.jit
def gradient_of(rod, state, terms, step, q):
    return potential(rod, state, terms, step).gradient(q)


def drag_on(moment: Moment, kind: type) -> jax.Array:
    """Force (N) of one drag on the nodes, and torque (N m) on the edges, during the step."""
    scene, state = moment.scene, moment.state
    terms = acting(scene, state, kind)
    return -gradient_of(scene.rod, state, terms, scene.step_length, moment.q)


def torque_on_head(moment: Moment) -> float:
    """Torque (N m) along its axis with which the rest of the robot turns the head."""
    terms = tuple(t for t in moment.scene.terms if isinstance(t, Bend | Twist))
    scene, state, h = moment.scene, moment.state, moment.scene.step_length
    turned = state.motor_angle + scene.motor.rotation(state.time, state.time + h)
    driven = replace(state, motor_angle=turned)
    return -float(angles(scene.rod.topology, gradient_of(scene.rod, driven, terms, h, moment.q))[0])


def test_thrust_is_the_drag_of_the_head(soft):
    """6 pi mu r_h C_t v, which is all that the flagellum has to push."""
    topology = soft.scene.rod.topology
    head = positions(topology, drag_on(soft, HeadDrag))
    fluid = positions(topology, drag_on(soft, StokesletSegments))
    speed = positions(topology, soft.velocity)[0]
    stokes = 6 * np.pi * soft.file.fluid.viscosity * soft.file.robot.head_radius
    push = jnp.sum(head, axis=0)
    size = float(jnp.linalg.norm(push))
    assert size > 1e-4  # N
    np.testing.assert_allclose(push, -stokes * soft.file.head.C_t * speed, atol=1e-12 * size)
    # inertialess: nothing is left over
    np.testing.assert_allclose(jnp.sum(fluid, axis=0), -push, atol=1e-8 * size)


def test_efficiency_is_a_ratio_of_speeds(soft):
    """Thrust x head radius / torque = (3/4) (C_t / C_r) v / (r_h omega_h)."""
    topology, robot = soft.scene.rod.topology, soft.file.robot
    thrust = positions(topology, drag_on(soft, StokesletSegments)).sum(axis=0)
    velocity = positions(topology, soft.velocity)[0]
    # But for the little by which the head turns as its axis goes round in a step.
    spin = float(angles(topology, soft.velocity)[0])
    torque = -torque_on_head(soft)  # what the motor exerts on the flagellum
    efficiency = thrust * robot.head_radius / torque
    ratio = soft.file.head.C_t / soft.file.head.C_r
    expected = 0.75 * ratio * velocity / (robot.head_radius * -spin)
    assert float(jnp.abs(expected).max()) > 0.1
    np.testing.assert_allclose(efficiency, expected, rtol=5e-6, atol=1e-7)


def test_head_and_flagellum_turn_against_each_other_at_the_rate_of_the_motor(stiff):
    """Once the flagellum is wound up; a stiff one is, at once."""
    spin = angles(stiff.scene.rod.topology, stiff.velocity)
    assert float(spin[2] - spin[0]) == pytest.approx(RATE, rel=1e-3)
    assert float(spin[0]) < 0 < float(spin[2])


def test_a_stiff_robot_moves_as_a_rigid_one(stiff):
    """Speed of advance and spin of the head, by the 6 x 6 resistance of the flagellum."""
    topology = stiff.scene.rod.topology
    path = np.array(topology.filaments[0])
    x = positions(topology, stiff.state.q)[path]
    v = positions(topology, stiff.velocity)[path]
    motion, *_ = np.linalg.lstsq(np.asarray(rigid_motions(x)), np.asarray(v).ravel())
    residual = np.asarray(rigid_motions(x)) @ motion - np.asarray(v).ravel()
    assert np.abs(residual).max() < 0.01 * np.abs(v).max()  # it hardly deforms
    velocity, rate = np.split(motion, 2)
    expected = free_motion(stiff.file)
    assert abs(velocity @ rate) / np.linalg.norm(rate) == pytest.approx(expected.speed, rel=1e-3)
    spin = float(angles(topology, stiff.velocity)[0])
    assert abs(spin) / RATE == pytest.approx(expected.spin_ratio, rel=1e-3)
