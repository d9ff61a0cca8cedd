"""Where a rod is expected to go, from how it has moved: the owner of `State.history`.

Newton's method needs few iterations from a good guess, and drag matrices are those of where the rod
is expected, so that its motion is extrapolated through the last three steps.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..rods.rod import History, State
from ..solve.contributions import Dofs


def has_moved(state: State) -> Array:
    """Whether a step has been taken, and is known of."""
    return state.history.length > 0.0


def expected_velocity(state: State, ahead: Array, unit: Float[Array, " d"]) -> Dofs:
    """The velocity (m/s, rad/s) some time (s) ahead, if motion goes on as it did.

    Only where it is smooth: after a jump, as at the start, velocity is taken as constant. What is
    smooth shows in the power of the solver's units of force and torque, in which positions and
    angles count alike for robots of all sizes.

    Args:
        state: from which.
        ahead: s.
        unit: N and N m, of each degree of freedom.
    """

    def size(velocity: Dofs) -> Array:
        return jnp.sum((unit * velocity) ** 2)

    past = state.history
    # Before the first step there is no mean, but there may be a velocity.
    velocity = jnp.where(has_moved(state), past.mean_velocity, state.velocity)
    later = 0.5 * past.length + ahead
    first = later * past.mean_acceleration
    second = 0.5 * later * (later + past.length) * past.jerk
    first = jnp.where(size(first) < size(velocity), first, 0.0)
    second = jnp.where(size(second) < size(first), second, 0.0)
    return velocity + first + second


def mean_acceleration(state: State, length: Array, q: Dofs) -> Dofs:
    """From the middle of the last step to that of one to `q` (m/s^2 and rad/s^2)."""
    change = (q - state.q) / length - state.history.mean_velocity
    return 2.0 * change / (length + state.history.length)


def jerk(state: State, length: Array, q: Dofs) -> Dofs:
    """d3q/dt3 (m/s^3 and rad/s^3), from a step to `q` and two of one length before it."""
    past = state.history
    change = mean_acceleration(state, length, q) - past.mean_acceleration
    return change / (0.25 * length + 0.75 * past.length)


def with_step(state: State, length: Array, q: Dofs) -> History:
    """The history after a step of some length (s) from `state` to `q`."""
    return History(
        mean_velocity=(q - state.q) / length,
        mean_acceleration=mean_acceleration(state, length, q),
        jerk=jerk(state, length, q),
        length=length,
    )
