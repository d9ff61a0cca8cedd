"""What every scheme of integration in time is made of: intervals of implicit Euler.

In an interval of length l that starts from an origin q~ and a velocity v~, the end q makes the
incremental potential

    P(q) = E(q) + l Phi((q - q~)/l; q_m) + |q - q~ - l v~|^2_M / (2 l^2) - f . q

of the scene's terms stationary. With q~ and v~ those of the state this is a step of implicit
Euler; the stages of the diagonally implicit Runge-Kutta methods have the same form, with an
origin that takes in the stages before. Drag is linear in the velocity at a configuration q_m,
which is that where the rod is expected to be.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .blocks import Layout
from .control import Control
from .motor import Motor
from .newton import NewtonInfo, NewtonSettings, equilibrium
from .potential import Dofs, Mobility, Potential, gather
from .pytree import pytree, replace, static
from .rod import Rod, State, carry_frames
from .saddle import Saddle, no_drag
from .status import Status
from .terms.term import Interval, Outlook, Term


@pytree
class Step:
    """A step that has been tried.

    Attributes:
        state: at its end.
        info: how the solver did.
        error: (d,) m and rad, estimate of what the step adds to the error.
    """

    state: State
    info: NewtonInfo
    error: Dofs


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
        step_length: s, of a step, or of the first one if steps adapt to the motion.
        scheme: how one step of some length is taken.
        control: how the length of steps adapts; None for steps of one length.
        layout: the blocks in which a large robot is solved for; None for one dense matrix.
    """

    rod: Rod
    terms: tuple[Term, ...]
    motor: Motor | None
    newton: NewtonSettings
    step_length: Float[Array, ""]
    scheme: Callable[["Scene", State, Array], Step] = static()
    control: Control | None = None
    layout: Layout | None = None


def expected_velocity(state: State, ahead: Array) -> Dofs:
    """The velocity (m/s, rad/s) some time (s) ahead, if motion goes on as it did.

    Only where it is smooth: after a jump, as at the start, velocity is taken as constant.
    """
    # Before the first step there is no mean, but there may be a velocity.
    velocity = jnp.where(state.length > 0.0, state.mean_velocity, state.velocity)
    later = 0.5 * state.length + ahead
    first = later * state.mean_acceleration
    second = 0.5 * later * (later + state.length) * state.jerk
    first = jnp.where(first @ first < velocity @ velocity, first, 0.0)
    second = jnp.where(second @ second < first @ first, second, 0.0)
    return velocity + first + second


def expected_move(state: State, ahead: Array) -> Dofs:
    """How far (m, rad) the rod goes in some time (s), if motion goes on as it did."""
    return ahead * expected_velocity(state, 0.5 * ahead)


def prepare(scene: Scene, state: State, ahead: Array, length: Array) -> tuple[Term, ...]:
    """The terms for an interval of a step of some length (s) from `state`.

    Drag is that of the configuration some time (s) ahead.
    """
    configuration = state.q + expected_move(state, ahead)
    outlook = Outlook(configuration, expected_move(state, length))
    return tuple(term.prepared(scene.rod, state, outlook) for term in scene.terms)


def turned(scene: Scene, state: State, length: Array) -> Float[Array, " k"]:
    """Angle (rad) that the motors turn in the next `length` (s)."""
    if scene.motor is None:
        return jnp.zeros_like(state.motor_angle)
    return scene.motor.turned(state.time, state.time + length)


def solve(
    scene: Scene,
    terms: tuple[Term, ...],
    state: State,
    interval: Interval,
    turn: Float[Array, " k"],
    move: Dofs,
) -> tuple[Dofs, NewtonInfo]:
    """The end of an interval of the step that starts at `state`.

    Differentiable in forward and reverse mode. A failure gives the best iterate and a status.

    Args:
        scene: whose rod and solver.
        terms: prepared for the step.
        state: at the start of the step.
        interval: what to solve.
        turn: rad, by which the motors have turned at its end.
        move: (d,) m and rad, expected from the start of the step to the end of the interval.
    """
    topology = scene.rod.topology
    contributions = [t.contribution(scene.rod, state, interval) for t in terms]
    drag = next((c for c in contributions if isinstance(c, Mobility)), None)
    potential = gather([c for c in contributions if not isinstance(c, Mobility)])
    if potential.guards:
        move = potential.reach(state.q, move) * move
    guess = state.q + move
    if topology.spindles:
        dofs = topology.edge_dofs(topology.spindles)
        guess = guess.at[dofs].set(state.q[dofs] + turn, unique_indices=True)
    free = None
    if topology.clamped:
        free = tuple(np.setdiff1d(np.arange(topology.n_dofs), topology.clamped).tolist())
    if scene.layout is None:
        q, info = equilibrium(potential, guess, scene.newton, free)
    else:
        q, info = _in_blocks(scene, scene.layout, potential, drag, guess)
    if potential.guards:
        fault, before = (potential.fault(lax.stop_gradient(x)) for x in (q, state.q))
        status = jnp.where(info.status == Status.OK, fault, info.status)
        overlap = (status != Status.OK) & (before == Status.PENETRATION)
        status = jnp.where(overlap, Status.OVERLAP, status).astype(jnp.int32)
        info = replace(info, status=status)
    return q, info


def _in_blocks(
    scene: Scene, layout: Layout, potential: Potential, drag: Mobility | None, guess: Dofs
) -> tuple[Dofs, NewtonInfo]:
    """The end of an interval of a large robot."""
    topology = scene.rod.topology
    free = np.ones(topology.n_dofs)
    free[list(topology.clamped)] = 0.0
    scale = lax.stop_gradient(scene.newton.force_scale)
    saddle = Saddle(potential, drag or no_drag(layout), layout, guess, jnp.asarray(free), scale)
    dry = jnp.broadcast_to(jnp.asarray(scene.newton.size), guess.shape)
    size = saddle.join(dry, jnp.zeros(saddle.drag.dofs.array.size))
    settings = replace(scene.newton, force_scale=saddle.scales, size=size)
    z, info = equilibrium(saddle, saddle.start(guess), settings, None)
    return saddle.split(z)[0], info


def at_end(
    scene: Scene,
    state: State,
    length: Array,
    q: Dofs,
    velocity: Dofs,
    acceleration: Dofs,
    turn: Float[Array, " k"],
) -> State:
    """The state after a step from `state` to `q`, with what is known of its end."""
    new = carry_frames(scene.rod, replace(state, motor_angle=state.motor_angle + turn), q)
    return replace(
        new,
        velocity=velocity,
        acceleration=acceleration,
        mean_velocity=(q - state.q) / length,
        mean_acceleration=mean_acceleration(state, length, q),
        jerk=jerk(state, length, q),
        length=length,
        time=state.time + length,
    )


def jerk(state: State, length: Array, q: Dofs) -> Dofs:
    """d3q/dt3 (m/s^3 and rad/s^3), from a step to `q` and two of one length before it."""
    change = mean_acceleration(state, length, q) - state.mean_acceleration
    return change / (0.25 * length + 0.75 * state.length)


def mean_acceleration(state: State, length: Array, q: Dofs) -> Dofs:
    """From the middle of the last step to that of one to `q` (m/s^2 and rad/s^2)."""
    change = (q - state.q) / length - state.mean_velocity
    return 2.0 * change / (length + state.length)
