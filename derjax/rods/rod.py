"""What a rod is: its topology (static), its rest shape (parameters) and its state.

A rod is a set of nodes joined by edges, with an angle on each edge. It bends and twists at
*hinges*, (edge, node, edge) stencils with an orientation sign for each edge, so that several
filaments may meet at one body: a chain is the special case in which every sign is +1.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.pytree import Indices, pytree, replace, static
from .vectors import any_normal, cross, dot, norm, parallel_transport, signed_angle, unit


@pytree
class Head:
    """Which nodes and edges of a rod are the robot's head. Hashable.

    Three nodes, or two and the frame of the edge between them, give a position, a direction
    and all three components of an angular velocity w: with t the direction of `line` and s the
    mean rate of the angles of `edges`, which lie along it, w = t x dt/dt + s t.

    Attributes:
        node: whose position and velocity are the head's.
        line: (start, end) nodes; their direction and that of `edges` turn with the head.
        edges: whose angles turn with the head.
        ahead: nodes whose mean lies ahead of `node`, in the direction of the flagella: the
            head's axis. Empty if the axis is `line` itself.
    """

    node: int = static()
    line: tuple[int, int] = static()
    edges: tuple[int, ...] = static()
    ahead: tuple[int, ...] = static(default=())


@pytree
class Topology:
    """Which nodes, edges and hinges a rod has. Hashable; compared by content.

    Attributes:
        n_nodes: number of nodes, n.
        edges: for each edge its (start, end) node.
        hinges: for each hinge its (first edge, second edge); they share exactly one node.
        filaments: node paths on which the fluid acts, each a tuple of consecutive nodes.
        head: the nodes and edges of the head; None without a head.
        motors: the hinges whose natural twist is driven.
        driven_edges: the clamped edges whose angle is driven; a rod has one or the other.
        clamped: degrees of freedom held fixed.
    """

    n_nodes: int = static()
    edges: tuple[tuple[int, int], ...] = static()
    hinges: tuple[tuple[int, int], ...] = static()
    filaments: tuple[tuple[int, ...], ...] = static(default=())
    head: Head | None = static(default=None)
    motors: tuple[int, ...] = static(default=())
    driven_edges: tuple[int, ...] = static(default=())
    clamped: tuple[int, ...] = static(default=())

    @property
    def n_edges(self) -> int:
        return len(self.edges)

    @property
    def n_dofs(self) -> int:
        """Degrees of freedom: three per node, then one angle per edge."""
        return 3 * self.n_nodes + self.n_edges

    @cached_property
    def edge_nodes(self) -> np.ndarray:
        """(e, 2): start and end node of each edge."""
        return np.array(self.edges, dtype=np.int32).reshape(-1, 2)

    @cached_property
    def hinge_edges(self) -> np.ndarray:
        """(b, 2): first and second edge of each hinge."""
        return np.array(self.hinges, dtype=np.int32).reshape(-1, 2)

    @cached_property
    def edge_filaments(self) -> np.ndarray:
        """(e,): the filament that each edge lies on, -1 if none."""
        number = np.full(self.n_nodes, -1)
        for k, path in enumerate(self.filaments):
            number[np.array(path)] = k
        start, end = self.edge_nodes.T
        return np.where(number[start] == number[end], number[start], -1)

    @cached_property
    def held_edges(self) -> np.ndarray:
        """(e,): which edges have both their nodes held in place."""
        return np.all(np.isin(self.edge_stencil.array, self.clamped), axis=1)

    @cached_property
    def _hinge_layout(self) -> tuple[np.ndarray, np.ndarray]:
        nodes, signs = [], []
        for first, second in self.hinges:
            (a0, a1), (b0, b1) = self.edges[first], self.edges[second]
            shared = {a0, a1} & {b0, b1}
            if len(shared) != 1:
                raise ValueError(f"edges {first} and {second} of a hinge must share one node")
            (middle,) = shared
            nodes.append([a0 if a1 == middle else a1, middle, b1 if b0 == middle else b0])
            signs.append([1.0 if a1 == middle else -1.0, 1.0 if b0 == middle else -1.0])
        return (
            np.array(nodes, dtype=np.int32).reshape(-1, 3),
            np.array(signs, dtype=float).reshape(-1, 2),
        )

    @property
    def hinge_nodes(self) -> np.ndarray:
        """(b, 3): the nodes along each hinge."""
        return self._hinge_layout[0]

    @property
    def hinge_signs(self) -> np.ndarray:
        """(b, 2): +1 where an edge runs along the hinge, -1 where it runs against it."""
        return self._hinge_layout[1]

    def node_dofs(self, nodes: np.ndarray | Sequence[int]) -> np.ndarray:
        """(..., 3): the positions of `nodes` in the packed vector of degrees of freedom."""
        return 3 * np.asarray(nodes)[..., None] + np.arange(3)

    def edge_dofs(self, edges: np.ndarray | Sequence[int]) -> np.ndarray:
        """(...): the place of the angles of `edges` in the packed vector."""
        return 3 * self.n_nodes + np.asarray(edges)

    @cached_property
    def edge_stencil(self) -> Indices:
        """(e, 6): degrees of freedom of the two nodes of each edge."""
        return Indices(self.node_dofs(self.edge_nodes).reshape(self.n_edges, 6))

    @cached_property
    def hinge_stencil(self) -> Indices:
        """(b, 11): degrees of freedom of the three nodes and two angles of each hinge."""
        nodes = self.node_dofs(self.hinge_nodes).reshape(-1, 9)
        return Indices(np.concatenate([nodes, self.edge_dofs(self.hinge_edges)], axis=1))


def chain(n_nodes: int, **fields) -> Topology:
    """The topology of a single unbranched rod of `n_nodes` nodes."""
    edges = tuple((i, i + 1) for i in range(n_nodes - 1))
    hinges = tuple((i, i + 1) for i in range(n_nodes - 2))
    return Topology(n_nodes, edges, hinges, **fields)


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
        topology = replace(free, clamped=tuple(sorted({int(d) for d in held})))
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
class State:
    """All that a step needs to know of the past.

    Angles are kept within half a turn: whole turns are counted in `turns` and taken out of
    `theta`, `reference_twist` and `motor_angle` together, so that no digits are lost however
    long the motor runs.

    Attributes:
        q: (d,) node positions (m), then edge angles (rad).
        velocity: (d,) m/s and rad/s.
        acceleration: (d,) m/s^2 and rad/s^2.
        mean_velocity: (d,) m/s and rad/s over the step just taken.
        mean_acceleration: (d,) m/s^2 and rad/s^2, from the middle of the step before to that of
            the step just taken.
        jerk: (d,) m/s^3 and rad/s^3, likewise.
        length: s, of the step just taken.
        reference_director: (e, 3) first reference director of each edge.
        reference_twist: (b,) rad, twist of the reference frames across each hinge.
        motor_angle: (k,) rad, angle that each motor has turned.
        turns: (e,) whole turns taken out of the edge angles.
        time: s.
    """

    q: Float[Array, " d"]
    velocity: Float[Array, " d"]
    acceleration: Float[Array, " d"]
    mean_velocity: Float[Array, " d"]
    mean_acceleration: Float[Array, " d"]
    jerk: Float[Array, " d"]
    length: Float[Array, ""]
    reference_director: Float[Array, "e 3"]
    reference_twist: Float[Array, " b"]
    motor_angle: Float[Array, " k"]
    turns: Float[Array, " e"]
    time: Float[Array, ""]


def positions(topology: Topology, q: Float[Array, "*batch d"]) -> Float[Array, "*batch n 3"]:
    """Node positions (m) in the packed vector `q`."""
    return q[..., : 3 * topology.n_nodes].reshape(*q.shape[:-1], topology.n_nodes, 3)


def angles(topology: Topology, q: Float[Array, "*batch d"]) -> Float[Array, "*batch e"]:
    """Edge angles (rad) in the packed vector `q`."""
    return q[..., 3 * topology.n_nodes :]


def tangents(topology: Topology, nodes: Float[Array, "n 3"]) -> Float[Array, "e 3"]:
    """Unit tangent of every edge."""
    start, end = topology.edge_nodes.T
    return unit(nodes[end] - nodes[start])


def _untwisting(topology: Topology) -> np.ndarray:
    """(e, b): turns reference twists into the edge rotations that remove them all.

    Walks the tree of hinges from the first edge of each connected part.
    """
    rotation = np.full((topology.n_edges, len(topology.hinges)), np.nan)
    neighbours: dict[int, list[tuple[int, int]]] = {e: [] for e in range(topology.n_edges)}
    for hinge, (first, second) in enumerate(topology.hinges):
        neighbours[first].append((hinge, second))
        neighbours[second].append((hinge, first))
    for root in range(topology.n_edges):
        if not np.isnan(rotation[root]).any():
            continue
        rotation[root] = 0.0
        pending = [root]
        while pending:
            known = pending.pop()
            for hinge, new in neighbours[known]:
                if not np.isnan(rotation[new]).any():
                    continue
                s0, s1 = topology.hinge_signs[hinge]
                forward = topology.hinges[hinge][0] == known
                rotation[new] = s0 * s1 * rotation[known]
                rotation[new, hinge] += -s1 if forward else s0
                pending.append(new)
    return rotation


def space_parallel_directors(
    topology: Topology, tangent: Float[Array, "e 3"]
) -> Float[Array, "e 3"]:
    """A reference director for every edge, free of twist across every hinge.

    The director of the first edge of each connected part is an arbitrary normal.
    """
    director = any_normal(tangent)
    twist = hinge_reference_twist(topology, director, tangent, jnp.zeros(len(topology.hinges)))
    rotation = jnp.asarray(_untwisting(topology)) @ twist
    return material_directors(director, tangent, rotation)[0]


def curvature(
    t0: Float[Array, "*b 3"],
    t1: Float[Array, "*b 3"],
    m1: tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]],
    m2: tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]],
) -> Float[Array, "*b 2"]:
    """Integrated material curvature at a hinge (Bergou et al. 2008, eq. 1 and 2).

    The curvature binormal 2 t0 x t1 / (1 + t0 . t1), projected on the averages of the
    material directors of the two edges.
    """
    binormal = 2.0 * cross(t0, t1) / (1.0 + dot(t0, t1))[..., None]
    return 0.5 * jnp.stack([dot(binormal, m2[0] + m2[1]), -dot(binormal, m1[0] + m1[1])], axis=-1)


def reference_twist(
    d0: Float[Array, "*b 3"],
    d1: Float[Array, "*b 3"],
    t0: Float[Array, "*b 3"],
    t1: Float[Array, "*b 3"],
    previous: Float[Array, "*b"],
) -> Float[Array, "*b"]:
    """Angle (rad) from the director `d0` transported along the hinge to the director `d1`.

    Chosen within half a turn of `previous`, so that it goes on counting past +-pi.
    """
    angle = signed_angle(parallel_transport(d0, t0, t1), d1, t1)
    return previous + jnp.arctan2(jnp.sin(angle - previous), jnp.cos(angle - previous))


def hinge_tangents(
    topology: Topology, tangent: Float[Array, "e 3"]
) -> tuple[Float[Array, "b 3"], Float[Array, "b 3"]]:
    """Tangents of the two edges of every hinge, pointing along the hinge."""
    first, second = topology.hinge_edges.T
    signs = jnp.asarray(topology.hinge_signs)
    return signs[:, :1] * tangent[first], signs[:, 1:] * tangent[second]


def hinge_reference_twist(
    topology: Topology,
    director: Float[Array, "e 3"],
    tangent: Float[Array, "e 3"],
    previous: Float[Array, " b"],
) -> Float[Array, " b"]:
    """Reference twist (rad) of every hinge; see `reference_twist`."""
    first, second = topology.hinge_edges.T
    t0, t1 = hinge_tangents(topology, tangent)
    return reference_twist(director[first], director[second], t0, t1, previous)


def material_directors(
    director: Float[Array, "*e 3"], tangent: Float[Array, "*e 3"], theta: Float[Array, "*e"]
) -> tuple[Float[Array, "*e 3"], Float[Array, "*e 3"]]:
    """The reference frame turned by the edge angle `theta` (rad) about the tangent."""
    c, s = jnp.cos(theta)[..., None], jnp.sin(theta)[..., None]
    second = cross(tangent, director)
    return c * director + s * second, c * second - s * director


def hinge_lengths(topology: Topology, length: Float[Array, " e"]) -> Float[Array, " b"]:
    """The length of rod (m) that bends and twists at each hinge: half of its edges (m).

    An edge that is held is part of what holds it. A hinge between two of them cannot bend.
    """
    bends = np.where(topology.held_edges, 0.0, 1.0)[topology.hinge_edges]
    bends[~bends.any(axis=1)] = 1.0
    return 0.5 * jnp.sum(bends * length[topology.hinge_edges], axis=1)


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
    state = State(
        q=q,
        velocity=jnp.zeros_like(q),
        acceleration=jnp.zeros_like(q),
        mean_velocity=jnp.zeros_like(q),
        mean_acceleration=jnp.zeros_like(q),
        jerk=jnp.zeros_like(q),
        length=jnp.zeros(()),
        reference_director=director,
        reference_twist=m_ref,
        motor_angle=jnp.zeros(len(topology.motors) + len(topology.driven_edges)),
        turns=jnp.zeros(topology.n_edges),
        time=jnp.zeros(()),
    )
    return rod, state


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
        turns=state.turns + turns,
    )
