"""One step of time: gather the incremental potential, minimise it, carry the frames along."""

import numpy as np
from jaxtyping import Array, Float

from .motor import Motor
from .newton import NewtonInfo, NewtonSettings, equilibrium
from .potential import gather
from .pytree import pytree, replace
from .rod import Rod, State, carry_frames
from .terms.term import Interval, Term


@pytree
class Scene:
    """Everything that does not change during a run.

    The terms that a scene has are part of its structure: what is not in `terms` is not in
    the compiled program. All numbers are leaves and can be differentiated.

    Attributes:
        rod: topology and stress-free shape.
        terms: the physical ingredients.
        motor: what drives the natural twist of `rod.topology.motors`; None without motors.
        newton: when the solver stops.
        step_length: time step, s.
    """

    rod: Rod
    terms: tuple[Term, ...]
    motor: Motor | None
    newton: NewtonSettings
    step_length: Float[Array, ""]


def advance(scene: Scene, state: State) -> tuple[State, NewtonInfo]:
    """The state one step later, differentiable in forward and reverse mode.

    Finds q1 that makes the incremental potential

        P(q1) = E(q1) + h Phi((q1 - q0)/h; q0) + |q1 - q0 - h v0|^2_M / (2 h^2) - f . q1

    of the scene's terms stationary. A failed step returns its best iterate and a status.
    """
    h = scene.step_length
    topology = scene.rod.topology
    end = state.time + h
    motor_angle = state.motor_angle
    if scene.motor is not None:
        motor_angle = motor_angle + scene.motor.turned(state.time, end)
    interval = Interval(h, motor_angle)
    potential = gather([t.contribution(scene.rod, state, interval) for t in scene.terms])
    free = None
    if topology.clamped:
        free = tuple(np.setdiff1d(np.arange(topology.n_dofs), topology.clamped).tolist())
    q, info = equilibrium(potential, state.q + h * state.velocity, scene.newton, free)
    new = carry_frames(scene.rod, replace(state, motor_angle=motor_angle), q)
    return replace(new, velocity=(q - state.q) / h, time=end), info
