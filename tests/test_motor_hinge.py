"""How a rod bends at a motor: alike at every angle, or as the published model has it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import rotation

import derjax as dj
from derjax.core.pytree import replace
from derjax.rods.rod import transport_frames

BEND = 0.4
"""rad, between the two edges at the motor."""

ANGLES = (0.0, 0.3, 1.5, np.pi, 4.0, 6.0)

STRAIGHT = {"shape": "straight", "edge_length": 0.03}


def scene(hinge: str) -> dj.Scene:
    return dj.build(dj.SceneFile.from_dict({"robot": STRAIGHT, "motor": {"hinge": hinge}}))


def bent(scene: dj.Scene, turned: float) -> dj.State:
    """The motor turned by an angle (rad), and with it the flagellum, which is bent at the motor."""
    topology, start = scene.rod.topology, scene.start
    (motor,) = topology.motors
    _, middle, _ = topology.hinge_nodes[motor]
    x = np.array(dj.positions(topology, start.q))
    x[middle:] = x[middle] + (x[middle:] - x[middle]) @ rotation([0.0, 0.0, 1.0], BEND).T
    theta = np.zeros(topology.n_edges)
    theta[motor + 1 :] = turned
    state = replace(start, motor_angle=jnp.array([turned]))
    return transport_frames(scene.rod, state, jnp.concatenate([jnp.asarray(x.ravel()), theta]))


@pytest.mark.parametrize("turned", ANGLES)
@pytest.mark.parametrize("hinge", ["rigid", "published"])
def test_the_stiffness_of_the_shaft_over_a_turn(hinge, turned):
    """EI at every angle; EI cos^2(angle / 2) in the published model, which averages directors."""
    robot = scene(hinge)
    (motor,) = robot.rod.topology.motors
    found = dj.energies(robot, bent(robot, turned))
    curvature = 2.0 * np.tan(BEND / 2)
    stiffness = robot[dj.Bend].stiffness[motor] / robot.rod.hinge_length[motor]
    full = 0.5 * stiffness * curvature**2
    part = 1.0 if hinge == "rigid" else np.cos(turned / 2) ** 2
    np.testing.assert_allclose(found["Bend"], part * full, rtol=1e-10, atol=1e-12 * full)
    np.testing.assert_allclose(found["Twist"], 0.0, atol=1e-20)


def test_the_motor_twists_the_shaft():
    """Turned by the motor and held, the hinge has the twist that is missing."""
    robot = scene("rigid")
    state = replace(robot.start, motor_angle=jnp.array([0.3]))
    (motor,) = robot.rod.topology.motors
    stiffness = robot[dj.Twist].stiffness[motor] / robot.rod.hinge_length[motor]
    np.testing.assert_allclose(dj.energies(robot, state)["Twist"], 0.5 * stiffness * 0.3**2)


@pytest.mark.slow
def test_derivatives_by_the_angle_of_the_motor_agree_with_differences():
    """Of the force on the rod, where the two frames differ."""
    robot = scene("rigid")
    state = bent(robot, 1.0)

    def force(angle):
        there = replace(state, motor_angle=jnp.array([angle]))
        return dj.potential(robot, there, 1.0).gradient(state.q)

    exact = jax.jacfwd(force)(1.2)
    steps = (force(1.2 + 1e-5) - force(1.2 - 1e-5)) / 2e-5
    np.testing.assert_allclose(exact, steps, atol=1e-8 * np.abs(exact).max())


@pytest.mark.slow
def test_a_steady_flagellum_keeps_its_shape():
    """It turns as a whole; with the published hinge it nods once in every turn."""
    spread = {}
    for hinge in ("rigid", "published"):
        file = dj.SceneFile.from_dict(
            {
                "robot": {"edge_length": 0.03},
                "fluid": {"hydrodynamics": "rft"},
                "motor": {"rpm": 60.0, "hinge": hinge},
                "time": {"step": 0.02, "end": 14.0, "frame": 0.2},
            }
        )
        run = dj.rollout(dj.build(file), end=14.0, reverse_mode=False)
        run.raise_if_failed()
        x = np.asarray(run.positions)
        length = np.linalg.norm(x[-6:, -1] - x[-6:, 0], axis=1)  # over the last turn
        spread[hinge] = np.ptp(length) / length.mean()
    assert spread["rigid"] < 1e-6
    assert spread["published"] > 1e-4
