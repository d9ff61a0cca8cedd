"""One step of time: gather the incremental potential, minimise it, carry the frames along."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .motor import Motor
from .newton import NewtonInfo, NewtonSettings, equilibrium
from .potential import gather
from .pytree import pytree, replace, static
from .rod import Rod, State, carry_frames
from .status import Status
from .terms.term import Interval, Term


def advance(scene: "Scene", state: State) -> tuple[State, NewtonInfo]:
    """The state one step later, differentiable in forward and reverse mode.

    Finds q1 that makes the incremental potential

        P(q1) = E(q1) + h Phi((q1 - q0)/h; q0) + |q1 - q0 - h v0|^2_M / (2 h^2) - f . q1

    of the scene's terms stationary. A failed step returns its best iterate and a status.
    """
    h = scene.step_length
    topology = scene.rod.topology
    end = state.time + h
    motor_angle = state.motor_angle
    turned = jnp.zeros_like(motor_angle)
    if scene.motor is not None:
        turned = scene.motor.turned(state.time, end)
        motor_angle = motor_angle + turned
    interval = Interval(h, motor_angle)
    potential = gather([t.contribution(scene.rod, state, interval) for t in scene.terms])
    ahead = h * predicted_velocity(state)
    if potential.guards:
        ahead = potential.reach(state.q, ahead) * ahead
    guess = state.q + ahead
    if topology.spindles:
        dofs = topology.edge_dofs(topology.spindles)
        guess = guess.at[dofs].set(state.q[dofs] + turned, unique_indices=True)
    free = None
    if topology.clamped:
        free = tuple(np.setdiff1d(np.arange(topology.n_dofs), topology.clamped).tolist())
    q, info = equilibrium(potential, guess, scene.newton, free)
    if potential.guards:
        fault = potential.fault(lax.stop_gradient(q))
        info = replace(info, status=jnp.where(info.status == Status.OK, fault, info.status))
    new = carry_frames(scene.rod, replace(state, motor_angle=motor_angle), q)
    velocity = (q - state.q) / h
    change = velocity - state.velocity
    return replace(new, velocity=velocity, velocity_change=change, time=end), info


def predicted_velocity(state: State) -> Float[Array, " d"]:
    """The velocity of the coming step, if it changes as much as it did in the last one.

    Only where motion is smooth: after a jump, as at the start, velocity is taken as constant.
    """
    change, velocity = state.velocity_change, state.velocity
    smooth = change @ change < 0.25 * velocity @ velocity
    return velocity + jnp.where(smooth, change, 0.0)


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
        step: how one step is taken.
    """

    rod: Rod
    terms: tuple[Term, ...]
    motor: Motor | None
    newton: NewtonSettings
    step_length: Float[Array, ""]
    step: Callable[["Scene", State], tuple[State, NewtonInfo]] = static(default=advance)
