"""Designing a robot: dimensions that make an objective of its motion as large as possible.

The derivative of the objective with respect to all dimensions comes from one reverse sweep
through the simulation. The number of nodes stays that of the scene's own dimensions.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array

from derjax import InputError, Scene, SceneFile, State, roll_frames
from derjax.rods.head import head_angle, head_position
from derjax.terms.fluid.head import HeadDrag

from .descent import descend
from .simulate import build_with
from .transforms import Interval, Parameters, select_parameters

Merit = Callable[[Scene, State], Array]
"""From a scene and its saved frames (a `State` with a leading axis) to a scalar."""


def speed(scene: Scene, frames: State) -> Array:
    """Mean speed (m/s) of the head between the first and the last frame."""
    path = head_position(scene.rod.topology, frames)
    return jnp.linalg.norm(path[-1] - path[0]) / (frames.time[-1] - frames.time[0])


def efficiency(scene: Scene, frames: State) -> Array:
    """Power that drags the head along at its speed, over the power of the motor.

    Nothing else holds the robot, so the motor's torque is that which spins the head:
    eta = C_t 6 pi mu r_h U^2 / (C_r 8 pi mu r_h^3 |Omega_h| |omega_motor|).
    """
    drag = next((term for term in scene.terms if isinstance(term, HeadDrag)), None)
    if drag is None or scene.motor is None:
        raise ValueError("efficiency needs a head with drag and a motor")
    turned = head_angle(scene.rod.topology, frames)
    duration = frames.time[-1] - frames.time[0]
    spin = (turned[-1] - turned[0]) / duration
    motor = jnp.sum(scene.motor.rotation(frames.time[0], frames.time[-1])) / duration
    power = drag.spin * jnp.abs(spin) * jnp.abs(motor)
    return drag.translation * speed(scene, frames) ** 2 / power


@dataclass(frozen=True)
class Design:
    """The best design met.

    Attributes:
        values: parameters by name, in the units of the scene.
        merit: of the best design.
        merits: of every step; NaN where the simulation failed.
        status: "finished" or "interrupted".
    """

    values: dict[str, float]
    merit: float
    merits: tuple[float, ...]
    status: str


def design(
    scene: SceneFile,
    merit: Merit,
    bounds: Mapping[str, tuple[float, float]],
    *,
    steps: int = 30,
    rate: float = 0.1,
    on_step: Callable[[int, float, dict[str, float]], None] = lambda step, merit, values: None,
) -> Design:
    """Parameters within bounds that make `merit` large, by gradient ascent.

    Args:
        scene: simulated from rest to its `[time] end`; its values are the start.
        merit: of the scene and its frames, for instance `speed` or `efficiency`.
        bounds: (low, high) of every parameter to be changed; the start lies between them.
        steps: evaluations of the gradient.
        rate: of a parameter in units of about a quarter of its range, in the first steps.
        on_step: called after every evaluation with its number, merit and parameters.

    Raises:
        InputError: unknown parameters, or a start outside of its bounds.
        SolverError: the simulation fails at the start.
    """
    names = select_parameters(tuple(bounds), scene.single_numbers).names
    for name, (low, high) in bounds.items():
        if not low < high:
            raise InputError(f"bounds of {name}: {low:g} is not less than {high:g}")
    parameters = Parameters(names, tuple(Interval(*bounds[name]) for name in names))
    rpm = jnp.asarray(scene.parameters["rpm"], dtype=float)

    def loss(free: Array) -> tuple[Array, Array]:
        built, state = build_with(scene, parameters, free, rpm)
        frames, report = roll_frames(built, state, scene.n_frames, scene.steps_per_frame)
        return -merit(built, frames), report.status

    def values(free: Array) -> dict[str, float]:
        return {name: float(value) for name, value in parameters.values(free).items()}

    found = descend(
        loss,
        parameters.free(scene.single_numbers),
        steps=steps,
        rate=rate,
        on_step=lambda k, value, free: on_step(k, -value, values(jnp.asarray(free))),
    )
    merits = tuple(-value for value in found.losses)
    return Design(values(jnp.asarray(found.free)), -found.loss, merits, found.status)
