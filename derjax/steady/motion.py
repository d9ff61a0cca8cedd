"""Rigid motion of a shape that does not change: what a steady swimmer does.

A flagellum that swims steadily turns and moves as if it were rigid, and so does the head, which in
addition turns against it with the rate of the motor. With U the velocity of the shape at the origin
and Omega its angular velocity, a node x moves with U + Omega x x, and an edge with the tangent t
turns about itself with Omega . t, less the rate of the motor if it is on the head's side of that.
"""

from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..core.errors import InputError
from ..core.pytree import pytree, replace, static
from ..integrate.motor import Motor
from ..integrate.schemes.contact_corrected import contact_corrected_euler
from ..integrate.step import Scene, moving_stage
from ..rods.kinematics import positions, tangents
from ..rods.rod import State, moved, transport_frames
from ..rods.topology import Topology
from ..rods.vectors import cross, rotation_about
from ..solve.contributions import Contribution, Dofs, Matrix
from ..terms.gravity import Gravity
from ..terms.term import Role, contributions, standing


@pytree
class RigidMotion:
    """A velocity and an angular velocity.

    Attributes:
        velocity: (3,) m/s, of what is at the origin.
        rotation: (3,) rad/s.
    """

    velocity: Float[Array, " 3"]
    rotation: Float[Array, " 3"]


def screw(
    velocity: Float[Array, " 3"], rotation: Float[Array, " 3"], time: Array
) -> tuple[Float[Array, "3 3"], Float[Array, " 3"]]:
    """What a rigid motion that lasts makes of a shape: a turn about the origin, then a shift (m).

    Args:
        velocity: m/s, of what is at the origin at time zero.
        rotation: rad/s.
        time: s.
    """
    square = jnp.sum(rotation**2)
    turns = square > 0.0
    pace = jnp.sqrt(jnp.where(turns, square, 1.0))
    angle, axis = jnp.where(turns, pace * time, 0.0), rotation / pace
    # The integral of Rodrigues' formula over time.
    around = cross(axis, velocity)
    lag = (1.0 - jnp.cos(angle)) * around + (angle - jnp.sin(angle)) * cross(axis, around)
    return rotation_about(axis, angle), time * velocity + lag / pace


@pytree
class Symmetry:
    """In which ways the shape of a scene may move as a whole, and what drives it.

    Attributes:
        axes: (k, 3) about which it may turn: three of them, one with gravity, none if it is held.
        moves: whether it may move along.
        own_spin: (e,) of every edge about itself beyond that of the shape, in units of the motor's
            rate.
        driven: (3,) axis about which a held shape is turned by its motor; zero if it is not held.
        pivot: (3,) m, on that axis.
    """

    axes: Float[Array, "k 3"]
    moves: bool = static()
    own_spin: Float[Array, " e"]
    driven: Float[Array, " 3"]
    pivot: Float[Array, " 3"]

    @cached_property
    def size(self) -> int:
        """Number of unknowns of the motion."""
        return len(self.axes) + (3 if self.moves else 0)

    def motion(self, unknowns: Float[Array, " m"], rate: Array) -> RigidMotion:
        """The motion of the shape, from its unknowns and the rate of the motor (rad/s)."""
        turning = unknowns[self.size - len(self.axes) :] @ self.axes + rate * self.driven
        velocity = unknowns[:3] if self.moves else cross(self.pivot, turning)
        return RigidMotion(velocity, turning)


def held_still(scene: Scene) -> Symmetry:
    """The shape of a scene that is held somewhere, and whose motors stand still.

    Raises:
        InputError: nothing is held.
    """
    _check_forces(scene)
    topology = scene.rod.topology
    if not topology.fixed_dofs:
        raise InputError(
            "nothing holds the rod, so that it has no equilibrium at rest: hold an end, or ask for "
            "the steady state of a robot (derjax.steady)"
        )
    still = jnp.zeros(topology.n_edges)
    return Symmetry(jnp.zeros((0, 3)), False, still, jnp.zeros(3), jnp.zeros(3))


def _check_forces(scene: Scene) -> None:
    """Refuses scenes that have more to them than the forces of their terms."""
    if scene.layout is not None:
        raise InputError(
            "a robot in blocks: build the scene with [solver] method = 'dense' for steady shapes"
        )
    if scene.scheme is contact_corrected_euler:
        raise InputError(
            "[contact] method = 'spillmann_teschner' moves rods apart without a force, so that no "
            "forces can balance: choose another method"
        )


def prescribed(scene: Scene) -> Motor:
    """The motors of a scene, which turn at constant rates.

    Raises:
        InputError: there are none, their rates change in time, or they depend on the load.
    """
    motor = scene.motor
    if motor is None:
        raise InputError("there is no motor")
    if not isinstance(motor, Motor):
        raise InputError(
            "[motor] stall_torque: the rate of such a motor depends on the load; steady states and "
            "orbits need constant rates (rpm). Simulate it in time."
        )
    if not motor.is_constant:
        raise InputError(
            "the rate of the motor changes in time ([motor] table or ripple): steady states and "
            "orbits need constant rates"
        )
    return motor


def symmetry_of(scene: Scene) -> Symmetry:
    """How the shape of a scene may move.

    Raises:
        InputError: there is no motor, or there are several, which pass each other; its rate
            changes in time; or a filament is held at both ends.
    """
    _check_forces(scene)
    topology = scene.rod.topology
    count = len(topology.motors) + len(topology.driven_edges)
    if count != 1 or scene.motor is None:
        raise InputError(
            f"{count} motors turn: a steady shape needs one; flagella of several motors pass each "
            "other in every turn (derjax.orbit finds motions that repeat themselves)"
        )
    prescribed(scene)
    still = np.zeros(topology.n_edges)
    if topology.driven_edges:
        (base,) = topology.driven_edges
        held = np.flatnonzero(topology.held_edges)
        if len(held) > 1:
            raise InputError("a filament that is held at both ends does not turn as a whole")
        x = positions(topology, scene.start.q)
        axis, pivot = tangents(topology, x)[base], x[topology.edge_nodes[base][0]]
        return Symmetry(jnp.zeros((0, 3)), False, jnp.asarray(still), axis, pivot)
    axes = jnp.eye(3)
    weights = [term for term in scene.terms if isinstance(term, Gravity) and _acts(term)]
    if weights:
        (weight,) = weights
        size = jnp.linalg.norm(weight.acceleration)
        axes = (weight.acceleration / size)[None]
    return Symmetry(axes, True, jnp.asarray(_head_spin(topology)), jnp.zeros(3), jnp.zeros(3))


def _acts(weight: Gravity) -> bool:
    """Whether anything is heavier or lighter than the fluid; not known while JAX traces."""
    if isinstance(weight.buoyant_mass, Tracer) or isinstance(weight.acceleration, Tracer):
        return True
    return bool(np.any(weight.buoyant_mass) and np.any(weight.acceleration))


def with_part_of_weight(scene: Scene, part: Array | float) -> Scene:
    """The scene with less gravity, so that weight moves a robot no more than a slow motor does."""
    terms = tuple(
        replace(term, acceleration=part * term.acceleration) if isinstance(term, Gravity) else term
        for term in scene.terms
    )
    return replace(scene, terms=terms)


def _head_spin(topology: Topology) -> np.ndarray:
    """(e,): +-1 for edges on the head's side of the motor, by their direction along the rod."""
    (motor,) = topology.motors
    spin = np.full(topology.n_edges, np.nan)
    first, second = topology.hinges[motor]
    s0, s1 = topology.hinge_signs[motor]
    on_head = set(topology.head.edges) if topology.head is not None else {first}
    # Across the motor the second edge turns faster than the first, along the hinge.
    for start, value in ((first, -s0), (second, s1)):
        side = np.full(topology.n_edges, np.nan)
        side[start] = value
        pending = [start]
        while pending:
            known = pending.pop()
            for h, (a, b) in enumerate(topology.hinges):
                if h == motor or known not in (a, b):
                    continue
                new = b if a == known else a
                if np.isnan(side[new]):
                    side[new] = side[known] * np.prod(topology.hinge_signs[h])
                    pending.append(new)
        reached = ~np.isnan(side)
        spin[reached] = side[reached] if on_head & set(np.flatnonzero(reached)) else 0.0
    return spin


def rates(scene: Scene, symmetry: Symmetry, q: Dofs, motion: RigidMotion, rate: Array) -> Dofs:
    """(d,) m/s and rad/s: how all degrees of freedom change in a rigid motion of the shape `q`."""
    topology = scene.rod.topology
    x = positions(topology, q)
    spin = tangents(topology, x) @ motion.rotation + symmetry.own_spin * rate
    turning = cross(jnp.broadcast_to(motion.rotation, x.shape), x)
    return jnp.concatenate([(motion.velocity + turning).ravel(), spin])


def state_at(scene: Scene, q: Dofs) -> State:
    """The state in which the scene's rod is at `q`, its frames carried there from the start."""
    return transport_frames(scene.rod, scene.start, q)


LATER = 1.0
"""rad, by which `elsewhere` turns a shape, and its motor."""


def elsewhere(
    scene: Scene, symmetry: Symmetry, q: Dofs, motion: RigidMotion, rate: Array
) -> tuple[Scene, Dofs, RigidMotion]:
    """The same steady state at another time and place: moved, turned, with the motor turned on.

    Forces must be in balance there, too, else the state is not steady. The scene that comes back
    starts in the moved start.
    """
    topology, start = scene.rod.topology, scene.start
    about, pivot, shift = symmetry.driven, symmetry.pivot, jnp.zeros(3)
    if symmetry.moves:
        shift = jnp.sum(scene.rod.rest_length) * jnp.array([0.3, -0.2, 0.4])
    if len(symmetry.axes):
        weights = jnp.array([0.6, -0.5, 0.4])[: len(symmetry.axes)]
        about = (weights / jnp.linalg.norm(weights)) @ symmetry.axes
    turn = rotation_about(about, LATER)
    # A motor at rest does not turn on.
    onwards = LATER * jnp.sign(rate)

    offset = pivot - turn @ pivot + shift
    spun = jnp.concatenate([jnp.zeros(3 * topology.n_nodes), onwards * symmetry.own_spin])
    later = moved(topology, start, turn, offset)
    there = moved(topology, replace(start, q=q), turn, offset).q + spun
    later = replace(
        later,
        q=later.q + spun,
        motor_angle=start.motor_angle + onwards,
        time=start.time + jnp.where(rate == 0.0, 0.0, LATER / jnp.where(rate == 0.0, 1.0, rate)),
    )
    velocity = turn @ motion.velocity - cross(turn @ motion.rotation, shift)
    return replace(scene, initial=later), there, RigidMotion(velocity, turn @ motion.rotation)


@jax.jit  # traced once, and not for every program and derivative that asks
def imbalance(scene: Scene, q: Dofs, velocity: Dofs, acceleration: Dofs) -> Dofs:
    """(d,) N and N m: what is left of all forces, with the sign of a potential's gradient.

    Every term is asked in the frames of the rod at `q`, so that forces and rates are those of one
    set of frames.

    Args:
        scene: whose terms.
        q: (d,) m and rad.
        velocity: (d,) m/s and rad/s.
        acceleration: (d,) m/s^2 and rad/s^2.

    Raises:
        InputError: a term that forces are not known of.
    """
    state = state_at(scene, q)
    stage = moving_stage(scene, state, velocity, acceleration)
    total = jnp.zeros_like(q)
    prediction = standing(state, scene.terms)
    for part in contributions(scene.terms, scene.rod, state, stage, prediction):
        if not isinstance(part, Contribution):
            raise InputError("a robot in blocks: build it with [solver] method = 'dense'")
        total = total + part.gradient(state.q)
    return total


@jax.jit
def elastic_stiffness(scene: Scene, q: Dofs) -> Matrix:
    """(d, d) N/m and so on: the second derivative of all that stores energy, at `q`.

    Not quite how forces change with the shape, in which frames are carried along: enough for
    Newton's method, and a small part of the work of the whole derivative.
    """
    state, still = state_at(scene, q), jnp.zeros_like(q)
    stage = moving_stage(scene, state, still, still)
    energies = [term for term in scene.terms if term.role is Role.ENERGY]
    matrix = jnp.zeros((q.size, q.size))
    for part in contributions(energies, scene.rod, state, stage, standing(state, scene.terms)):
        if isinstance(part, Contribution):
            matrix = part.add_hessian(matrix, state.q)
    return matrix


@jax.jit
def steady_imbalance(
    scene: Scene, symmetry: Symmetry, q: Dofs, unknowns: Float[Array, " m"], rate: Array
) -> Dofs:
    """`moving_imbalance`, by the unknowns of the motion."""
    return moving_imbalance(scene, symmetry, q, symmetry.motion(unknowns, rate), rate)


def moving_imbalance(
    scene: Scene, symmetry: Symmetry, q: Dofs, motion: RigidMotion, rate: Array
) -> Dofs:
    """`imbalance` in a rigid motion of the shape `q`, inertia of the turning frame included."""
    velocity = rates(scene, symmetry, q, motion, rate)
    return imbalance(scene, q, velocity, rotating_acceleration(scene, motion, velocity))


def rotating_acceleration(scene: Scene, motion: RigidMotion, velocity: Dofs) -> Dofs:
    """(d,) m/s^2 and rad/s^2: how the rates of a rigid motion change as it turns."""
    n = 3 * scene.rod.topology.n_nodes
    at_nodes = velocity[:n].reshape(-1, 3)
    turning = cross(jnp.broadcast_to(motion.rotation, at_nodes.shape), at_nodes)
    return jnp.concatenate([turning.ravel(), jnp.zeros(len(velocity) - n)])


def gauge(scene: Scene, symmetry: Symmetry, anchor: Dofs, q: Dofs) -> Float[Array, " m"]:
    """Where a shape is and how it is turned, against another one: zero there. Dimensionless.

    The part of the displacement from `anchor` that is a rigid motion of it, lengths in units of
    that of the rod. Of shapes that differ much it may say little: some can be turned without any
    change of it.
    """
    still = jnp.zeros(())
    length = jnp.sum(scene.rod.rest_length)
    n = 3 * scene.rod.topology.n_nodes
    unit = jnp.where(np.arange(q.size) < n, length, 1.0)

    def generator(unknowns: Float[Array, " m"]) -> Dofs:
        return rates(scene, symmetry, anchor, symmetry.motion(unknowns, still), still)

    generators = jax.vmap(generator)(jnp.eye(symmetry.size)) / unit
    generators = generators / jnp.linalg.norm(generators, axis=1, keepdims=True)
    return generators @ ((q - anchor) / unit)
