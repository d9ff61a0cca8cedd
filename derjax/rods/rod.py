"""A rod: its rest shape (parameters), its state, and how frames go with it."""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.pytree import pytree, replace
from .kinematics import (
    angles,
    curvature,
    hinge_lengths,
    hinge_reference_twist,
    hinge_tangents,
    positions,
    reference_twist,
    space_parallel_directors,
    tangents,
)
from .topology import Topology, chain
from .vectors import cross, dot, norm, parallel_transport, unit


@pytree
class Rod:
    """A rod with its stress-free shape.

    Attributes:
        topology: what is joined to what.
        rest_length: (e,) m.
        hinge_length: (b,) m, the length of rod that bends and twists at a hinge.
        natural_curvature: (b, 2) integrated curvature of the stress-free shape, dimensionless.
        natural_twist: (b,) integrated twist of the stress-free shape, rad.
        nodes: (n, 3) m, where the rod starts; None for rods made with a state of their own.
        radius: m, of the circular cross-section; None where only the terms know it.
    """

    topology: Topology
    rest_length: Float[Array, " e"]
    hinge_length: Float[Array, " b"]
    natural_curvature: Float[Array, "b 2"]
    natural_twist: Float[Array, " b"]
    nodes: Float[Array, "n 3"] | None = None
    radius: Float[Array, ""] | None = None

    @classmethod
    def straight(
        cls,
        n_nodes: int,
        length: float | Array,
        radius: float | Array,
        fixed: Literal["start", "end", "both"] | None = None,
    ) -> "Rod":
        """A straight rod along x from the origin, without a robot: for statics and tests.

        Args:
            n_nodes: number of nodes.
            length: m.
            radius: m, of the circular cross-section.
            fixed: which ends are held: the position and direction of the last edge, and its angle.

        Raises:
            ValueError: less than three nodes, or another word for `fixed`.
        """
        if n_nodes < 3:
            raise ValueError(f"n_nodes = {n_nodes}: a rod needs three nodes to bend")
        ends = {None: (), "start": (0,), "end": (n_nodes - 2,), "both": (0, n_nodes - 2)}
        if fixed not in ends:
            raise ValueError(f"fixed = {fixed!r}: should be 'start', 'end', 'both' or None")
        free = chain(n_nodes, filaments=(tuple(range(n_nodes)),))
        held = [d for e in ends[fixed] for d in (*free.node_dofs([e, e + 1]).ravel(),)]
        held += [d for e in ends[fixed] for d in free.edge_dofs([e])]
        topology = replace(free, fixed_dofs=tuple(sorted({int(d) for d in held})))
        x = jnp.asarray(length, float) * np.linspace(0.0, 1.0, n_nodes)
        nodes = jnp.stack([x, jnp.zeros(n_nodes), jnp.zeros(n_nodes)], axis=1)
        rod, _ = at_rest(topology, nodes)
        return replace(rod, nodes=nodes, radius=jnp.asarray(radius, float))

    def at_rest(self) -> "State":
        """The state at rest where the rod starts.

        Raises:
            ValueError: the rod does not know where it starts.
        """
        if self.nodes is None:
            raise ValueError("this rod was made with a state of its own, and has no nodes")
        return at_rest(self.topology, self.nodes)[1]


@pytree
class History:
    """How a rod has moved in its last steps: what `integrate.predictor` makes and asks for.

    Attributes:
        moves: (3, d) m and rad, by which the last steps have displaced it, the latest first.
        lengths: (3,) s, of these steps; 0 for those before the start.
    """

    moves: Float[Array, "3 d"]
    lengths: Float[Array, " 3"]


@pytree
class State:
    """Where a rod is, how it moves, and how it has moved: all that a step needs to know.

    Angles are kept within half a turn: whole turns are counted in `turns` and `motor_turns`, and
    taken out of `theta`, `reference_twist` and `motor_angle` together, so that no digits are lost
    however long the motor runs.

    Attributes:
        q: (d,) node positions (m), then edge angles (rad).
        velocity: (d,) m/s and rad/s.
        acceleration: (d,) m/s^2 and rad/s^2.
        reference_director: (e, 3) first reference director of each edge.
        reference_twist: (b,) rad, twist of the reference frames across each hinge.
        motor_angle: (k,) rad, angle that each motor has turned.
        motor_rate: (k,) rad/s.
        motor_turns: (k,) whole turns taken out of the angles of the motors.
        turns: (e,) whole turns taken out of the edge angles.
        time: s.
        history: how it has moved.
    """

    q: Float[Array, " d"]
    velocity: Float[Array, " d"]
    acceleration: Float[Array, " d"]
    reference_director: Float[Array, "e 3"]
    reference_twist: Float[Array, " b"]
    motor_angle: Float[Array, " k"]
    motor_rate: Float[Array, " k"]
    motor_turns: Float[Array, " k"]
    turns: Float[Array, " e"]
    time: Float[Array, ""]
    history: History


def no_history(q: Float[Array, "*b d"]) -> History:
    """The history of a rod at `q` that has not moved yet."""
    *batch, d = q.shape
    return History(jnp.zeros((*batch, 3, d)), jnp.zeros((*batch, 3)))


def at_rest(topology: Topology, nodes: Float[Array, "n 3"]) -> tuple[Rod, State]:
    """A rod whose stress-free shape is `nodes` (m), and its state at rest in that shape.

    Filaments with another natural shape: change `natural_curvature` of the returned rod, or
    take the rod of one call and the state of another.
    """
    nodes = jnp.asarray(nodes, dtype=float)
    start, end = topology.edge_nodes.T
    length = norm(nodes[end] - nodes[start])
    tangent = tangents(topology, nodes)
    director = space_parallel_directors(topology, tangent)
    first, second = topology.hinge_edges.T
    t0, t1 = hinge_tangents(topology, tangent)
    d0, d1 = director[first], director[second]
    m_ref = reference_twist(d0, d1, t0, t1, jnp.zeros(len(topology.hinges)))
    kappa = curvature(t0, t1, (d0, d1), (cross(t0, d0), cross(t1, d1)))
    rod = Rod(
        topology=topology,
        rest_length=length,
        hinge_length=hinge_lengths(topology, length),
        natural_curvature=kappa,
        natural_twist=m_ref,
    )
    q = jnp.concatenate([nodes.ravel(), jnp.zeros(topology.n_edges)])
    n_motors = len(topology.motors) + len(topology.driven_edges)
    state = State(
        q=q,
        velocity=jnp.zeros_like(q),
        acceleration=jnp.zeros_like(q),
        reference_director=director,
        reference_twist=m_ref,
        motor_angle=jnp.zeros(n_motors),
        motor_rate=jnp.zeros(n_motors),
        motor_turns=jnp.zeros(n_motors),
        turns=jnp.zeros(topology.n_edges),
        time=jnp.zeros(()),
        history=no_history(q),
    )
    return rod, state


def moved(
    topology: Topology, state: State, turn: Float[Array, "3 3"], shift: Float[Array, " 3"]
) -> State:
    """The state turned about the origin, and then shifted (m): frames and rates as well."""
    n = 3 * topology.n_nodes

    def turned(vectors: Array) -> Array:
        return vectors.at[:n].set((positions(topology, vectors) @ turn.T).ravel())

    history = state.history
    return replace(
        state,
        q=turned(state.q).at[:n].add(jnp.tile(shift, topology.n_nodes)),
        velocity=turned(state.velocity),
        acceleration=turned(state.acceleration),
        reference_director=state.reference_director @ turn.T,
        history=replace(history, moves=jax.vmap(turned)(history.moves)),
    )


def transport_frames(rod: Rod, state: State, q: Float[Array, " d"]) -> State:
    """The state at `q`: frames transported in time from `state`, whole turns taken out.

    Time-parallel transport adds no rotation about the tangent, so the rate of an edge angle
    is the physical spin of that edge (Bergou et al. 2010, section 4.2.2).
    """
    topology = rod.topology
    old = tangents(topology, positions(topology, state.q))
    new = tangents(topology, positions(topology, q))
    director = parallel_transport(state.reference_director, old, new)
    director = unit(director - dot(director, new)[..., None] * new)  # no drift by round-off
    twist = hinge_reference_twist(topology, director, new, state.reference_twist)
    turns = jnp.round(angles(topology, q) / (2 * jnp.pi))
    q = q.at[3 * topology.n_nodes :].add(-2 * jnp.pi * turns)
    first, second = topology.hinge_edges.T
    signs = topology.hinge_signs
    twist = twist + 2 * jnp.pi * (signs[:, 1] * turns[second] - signs[:, 0] * turns[first])
    motor_angle = state.motor_angle
    motor_turns = jnp.round(motor_angle / (2 * jnp.pi))
    motor_angle = motor_angle - 2 * jnp.pi * motor_turns
    if topology.motors:
        twist = twist.at[np.array(topology.motors)].add(-2 * jnp.pi * motor_turns)
    return replace(
        state,
        q=q,
        reference_director=director,
        reference_twist=twist,
        motor_angle=motor_angle,
        motor_turns=state.motor_turns + motor_turns,
        turns=state.turns + turns,
    )
