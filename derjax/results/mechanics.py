"""What acts on a robot at one moment: energies, forces, the potential of a step, resistance."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.pytree import pytree, replace, static
from ..integrate.step import Scene, acting_terms, motor_rotation, moving_stage
from ..rods.kinematics import positions, tangents
from ..rods.rod import State
from ..rods.vectors import cross
from ..solve.contributions import Contribution, Dofs, Mobility
from ..solve.potential import Potential, assemble
from ..solve.saddle import drag_forces
from ..steady.motion import imbalance
from ..terms.term import Role, Stage, Term, contributions, standing


def energies(scene: Scene, state: State) -> dict[str, Float[Array, ""]]:
    """The potential energy (J) of every term that has one, by the name of its type."""
    stage = Stage(jnp.ones(()), state.time, state.motor_angle)
    chosen = [term for term in scene.terms if term.role is Role.ENERGY]
    found: dict[str, Array] = {}
    for term, part in zip(chosen, _parts(scene, chosen, state, stage), strict=True):
        if not isinstance(part, Contribution):
            raise TypeError(f"{type(term).__name__} has the role of an energy, and is a mobility")
        name = type(term).__name__
        found[name] = found.get(name, jnp.zeros(())) + part.value(state.q)
    return found


def forces(scene: Scene, state: State) -> dict[str, Float[Array, "n 3"]]:
    """The force (N) of every term on every node, by the name of its type.

    Drag and friction are those of the state's velocity, inertia that of its acceleration.
    """
    found: dict[str, Array] = {}
    stage = moving_stage(scene, state, state.velocity, state.acceleration)
    for term, part in zip(scene.terms, _parts(scene, scene.terms, state, stage), strict=True):
        name = type(term).__name__
        force = positions(scene.rod.topology, _force(part, state))
        found[name] = found.get(name, jnp.zeros_like(force)) + force
    return found


@jax.jit
def motor_torques(scene: Scene, states: State) -> Float[Array, "t k"]:
    """N m, with which each motor turns its flagellum against the head, or a held filament.

    Args:
        scene: whose motors.
        states: with a leading axis of time. The torque on a held filament is that against its drag
            as it moves in them.
    """
    topology = scene.rod.topology

    def stored(angle: Float[Array, " k"], state: State) -> Array:
        return sum(energies(scene, replace(state, motor_angle=angle)).values(), jnp.zeros(()))

    def at_one_time(state: State) -> Float[Array, " k"]:
        if topology.driven_edges:
            stage = moving_stage(scene, state, state.velocity, state.acceleration)
            parts = _parts(scene, scene.terms, state, stage)
            balance = -sum((_force(part, state) for part in parts), jnp.zeros_like(state.q))
            return balance[topology.edge_dofs(topology.driven_edges)]
        return jax.grad(stored)(state.motor_angle, state)

    return jax.vmap(at_one_time)(states)


def motor_rates(scene: Scene, states: State) -> Float[Array, "t k"]:
    """rad/s, of every motor.

    Args:
        scene: whose motors.
        states: with a leading axis of time.
    """
    return states.motor_rate if scene.motor is None else scene.motor.rates(states)


def motor_angles(scene: Scene, states: State) -> Float[Array, "t k"]:
    """rad, that every motor has turned since the start of the run, whole turns counted.

    Args:
        scene: whose motors.
        states: with a leading axis of time.
    """
    return states.motor_angle if scene.motor is None else scene.motor.angles(states)


def potential(scene: Scene, state: State, length: float | Array) -> Potential:
    """The incremental potential of a step of implicit Euler from `state`.

    The end of the step makes its `value(q)` stationary: there `gradient(q)` vanishes on all degrees
    of freedom that are not held. Drag and friction are those of the configuration at the start.

    Args:
        scene: whose terms.
        state: at the start of the step.
        length: s.

    Raises:
        ValueError: the drag of a robot in blocks, which has no potential in these unknowns.
    """
    length = jnp.asarray(length, float)
    angle = state.motor_angle + motor_rotation(scene, state, length)
    stage = Stage(length, state.time + length, angle, motor_origin=state.motor_angle)
    parts = _parts(scene, acting_terms(scene), state, stage)
    found = [part for part in parts if isinstance(part, Contribution)]
    if len(found) < len(parts):
        raise ValueError(
            "the drag of a robot in blocks is known by what forces do, and has no potential; "
            "build the scene with [solver] method = 'dense'"
        )
    return assemble(found)


@pytree
class Operators:
    """The matrices of small motions about a state, `M a + D v + K x`, on all degrees of freedom.

    Attributes:
        stiffness: (d, d) K, N/m and so on: how forces resist displacements.
        drag: (d, d) D, N s/m and so on: how they resist rates, that of the fluid's and friction's
            law at the state.
        mass: (d, d) M, kg and kg m^2.
        free: (f,) the degrees of freedom that are not held.
    """

    stiffness: Float[Array, "d d"]
    drag: Float[Array, "d d"]
    mass: Float[Array, "d d"]
    free: tuple[int, ...] = static()


def operators(scene: Scene, state: State) -> Operators:
    """Stiffness, drag and mass of a state, for a modal analysis of one's own.

    They are derivatives of the forces of all terms by displacement, velocity and acceleration, in
    frames that are carried along from the state: the rate of an angle is the spin of its edge. The
    velocity and acceleration of the state count, as the force of a drag that changes with the shape
    is part of the stiffness.

    Args:
        scene: whose terms.
        state: about which.

    Raises:
        InputError: a robot in blocks.
    """
    return _operators(replace(scene, initial=state), state)


@jax.jit
def _operators(scene: Scene, state: State) -> Operators:
    at = state.q, state.velocity, state.acceleration
    by = jax.jacfwd(imbalance, argnums=(1, 2, 3))(scene, *at)
    return Operators(*by, free=tuple(scene.rod.topology.free_dofs.tolist()))


def resistance(
    scene: Scene, state: State | None = None, about: Float[Array, " 3"] | None = None
) -> Float[Array, "6 6"]:
    """What resists the motion of the robot as if it were rigid.

    Takes its velocity (m/s) and rate of rotation (rad/s) to force (N) and torque (N m) against
    the motion.

    Args:
        scene: whose drag.
        state: where the robot is; None for the start.
        about: m, the point about which it turns, and to which torques refer; None for the head,
            or for the origin if there is no head.
    """
    state = scene.start if state is None else state
    topology = scene.rod.topology
    nodes = positions(topology, state.q)
    if about is None:
        about = jnp.zeros(3) if topology.head is None else nodes[topology.head.node]
    drags = [term for term in scene.terms if term.role is Role.DRAG]

    def motion(rigid: Float[Array, " 6"]) -> Dofs:
        along, turn = rigid[:3], jnp.broadcast_to(rigid[3:], nodes.shape)
        spin = tangents(topology, nodes) @ rigid[3:]
        return jnp.concatenate([(along + cross(turn, nodes - about)).ravel(), spin])

    def drag(rigid: Float[Array, " 6"]) -> Dofs:
        stage = moving_stage(scene, state, motion(rigid), state.acceleration)
        parts = _parts(scene, drags, state, stage)
        return -sum((_force(part, state) for part in parts), jnp.zeros_like(state.q))

    motions, loads = jax.vmap(motion)(jnp.eye(6)), jnp.stack([drag(e) for e in jnp.eye(6)])
    return motions @ loads.T


def _parts(
    scene: Scene, terms: Sequence[Term], state: State, stage: Stage
) -> list[Contribution | Mobility]:
    """What terms contribute where the rod stands; they may ask all terms of the scene."""
    prediction = standing(state, scene.terms)
    return contributions(terms, scene.rod, state, stage, prediction)


def _force(part: Contribution | Mobility, state: State) -> Dofs:
    """N and N m, at the state's positions."""
    if isinstance(part, Contribution):
        return -part.gradient(state.q)
    wet = part.dofs.array
    velocity = (state.q - part.origin)[wet] / part.time
    return jnp.zeros_like(state.q).at[wet].add(-drag_forces(part.law, velocity))
