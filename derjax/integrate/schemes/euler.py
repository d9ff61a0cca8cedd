"""Implicit Euler: first order, L-stable, one solve in a step."""

from jaxtyping import Array

from ...rods.rod import State
from ...terms.term import Stage
from ..predictor import mean_acceleration
from ..step import (
    Scene,
    Step,
    finish_step,
    fluid_velocity,
    motor_angle,
    motor_rotation,
    predict,
    predicted_displacement,
    solve,
)


def euler(scene: Scene, state: State, length: Array) -> Step:
    """A step of some length (s), differentiable in forward and reverse mode.

    Drag matrices are taken where the rod is expected in the middle of the step. The error is
    estimated as h^2/2 d2q/dt2.
    """
    turn = motor_rotation(scene, state, length)
    prediction = predict(scene, state, 0.5 * length, length)
    flow = fluid_velocity(scene, prediction.configuration, state.time + 0.5 * length)
    end = state.motor_angle + turn
    stage = Stage(
        length, state.time + length, end, fluid_velocity=flow, motor_origin=state.motor_angle
    )
    q, info = solve(
        scene, prediction, state, stage, turn, predicted_displacement(scene, state, length)
    )
    velocity = (q - state.q) / length
    acceleration = (velocity - state.velocity) / length
    error = 0.5 * length**2 * mean_acceleration(state, length, q)
    angle = motor_angle(scene, state, stage, prediction, q)
    rate = (angle - state.motor_angle) / length
    new = finish_step(scene, state, length, q, velocity, acceleration, angle, rate)
    return Step(new, info, error)
