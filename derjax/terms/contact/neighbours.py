"""Which pairs of edges come close: found anew at the start of every step.

The edges of large robots are looked through in groups of some in a row first, each in a sphere.
"""

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...core.pytree import Indices, pytree, static
from ...core.status import Status
from ...rods.bodies import bodies, turns
from ...rods.kinematics import positions
from ...rods.rod import Rod, State
from ...rods.topology import Topology
from ...rods.vectors import dot, norm, rotation
from ...solve.contributions import Dofs
from .segments import between, distance
from .segments import closest as closest_points

PENETRATION = 0.01
"""The part of their diameter by which rods may penetrate each other at the end of a step."""

MANY = 20_000
"""Pairs from which on edges are looked through in groups."""

GROUP = 8
"""Edges of a group."""

TINY = 1e-12
"""m: rods whose centre lines meet have no plane between them."""

SEVERAL, PER_PLACE = 4096, 8
"""Pairs of edges that are looked at more closely than by the spheres around them: so many, or so
many for each place of the list of contacts where that is more."""

CLOSE_GROUPS = 24
"""Pairs of groups, per group, that are looked at, or more where the list of contacts is longer."""


def pairs_apart(topology: Topology, rest_length: np.ndarray, gap: float) -> Indices:
    """(p, 2): all pairs of edges with more than `gap` (m) of rod between them.

    Edges of different rods, or on different sides of a clamped base, have no rod between them.
    """
    n_edges = topology.n_edges
    between = np.full((n_edges, n_edges), np.inf)
    np.fill_diagonal(between, 0.0)
    neighbours: list[set[int]] = [set() for _ in range(n_edges)]
    at_node: dict[int, list[int]] = {}
    for edge, ends in enumerate(topology.edges):
        for node in ends:
            at_node.setdefault(node, []).append(edge)
    for edges in at_node.values():
        for edge in edges:
            neighbours[edge] |= set(edges) - {edge}
    for start in range(n_edges):
        pending = [(other, 0.0) for other in neighbours[start]]
        while pending:
            edge, gone = pending.pop()
            if gone >= between[start, edge] or gone > gap:
                continue
            between[start, edge] = gone
            pending += [(other, gone + rest_length[edge]) for other in neighbours[edge]]
    first, second = np.triu_indices(n_edges, k=1)
    far = between[first, second] > gap
    return Indices(np.stack([first[far], second[far]], axis=1))


@lru_cache(maxsize=8)
def _grouped(n_edges: int, pairs: Indices) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The edges (g, 8) of every group, -1 where there is none; the pairs (c, 2) of groups; and
    the edges (e, k) that every edge cannot touch, itself included."""
    groups = np.full(-(-n_edges // GROUP) * GROUP, -1, dtype=np.int32)
    groups[:n_edges] = np.arange(n_edges)
    groups = groups.reshape(-1, GROUP)
    barred = np.ones((n_edges, n_edges), bool)
    barred[pairs.array[:, 0], pairs.array[:, 1]] = False
    barred &= barred.T
    partners = np.full((n_edges, int(barred.sum(axis=1).max())), -1, dtype=np.int32)
    for edge, row in enumerate(barred):
        found = np.flatnonzero(row)
        partners[edge, : len(found)] = found
    return groups, np.stack(np.triu_indices(len(groups)), axis=1).astype(np.int32), partners


def _candidates(
    topology: Topology, x: Float[Array, "n 3"], pairs: Indices, reach: Array, capacity: int
) -> tuple[Int[Array, "c 2"], Bool[Array, " c"], Bool[Array, ""]]:
    """Pairs of edges that hold all those closer than `reach` (m), which of them count, and
    whether there were too many to find them all, for a list of so many contacts."""
    edges, counts, overflow = _by_groups(topology, x, pairs, reach, capacity)
    most = max(SEVERAL, PER_PLACE * capacity)
    if len(edges) <= most:
        return edges, counts, overflow
    start, end = (x[topology.edge_nodes[:, k]] for k in (0, 1))
    centre, radius = 0.5 * (start + end), 0.5 * norm(end - start)
    first, second = edges.T
    apart, room = centre[first] - centre[second], reach + radius[first] + radius[second]
    near = counts & (dot(apart, apart) < room**2)
    (chosen,) = jnp.nonzero(near, size=most, fill_value=0)
    number = jnp.sum(near)
    return edges[chosen], jnp.arange(most) < number, overflow | (number > most)


def _by_groups(
    topology: Topology, x: Float[Array, "n 3"], pairs: Indices, reach: Array, most: int
) -> tuple[Int[Array, "c 2"], Bool[Array, " c"], Bool[Array, ""]]:
    """Likewise the pairs of edges in groups of which the spheres come close, in large robots;
    of other robots all pairs. Too many are more pairs of groups than are looked at, which are
    `most` of them or more."""
    if len(pairs.array) <= MANY:
        return jnp.asarray(pairs.array), jnp.ones(len(pairs.array), bool), jnp.array(False)
    groups, couples, partners = _grouped(topology.n_edges, pairs)
    there = groups >= 0
    ends = x[topology.edge_nodes[groups]].reshape(len(groups), -1, 3)
    known = jnp.asarray(np.repeat(there, 2, axis=1))[..., None]
    centre = jnp.sum(jnp.where(known, ends, 0.0), axis=1) / jnp.sum(known, axis=1)
    away = jnp.where(known, (ends - centre[:, None]) ** 2, 0.0)
    radius = jnp.sqrt(jnp.max(jnp.sum(away, axis=-1), axis=1))
    first, second = couples.T
    apart = jnp.sqrt(jnp.sum((centre[first] - centre[second]) ** 2, axis=-1))
    near = apart < radius[first] + radius[second] + reach
    size = min(max(most, CLOSE_GROUPS * len(groups)), len(couples))
    (chosen,) = jnp.nonzero(near, size=size, fill_value=0)
    looked_at = jnp.arange(size) < jnp.sum(near)
    one, other = (jnp.asarray(groups)[jnp.asarray(couples)[chosen, k]] for k in (0, 1))
    shape = (size, GROUP, GROUP)
    i = jnp.broadcast_to(one[:, :, None], shape)
    j = jnp.broadcast_to(other[:, None, :], shape)
    barred = jnp.any(jnp.asarray(partners)[i] == j[..., None], axis=-1)
    counts = looked_at[:, None, None] & (i >= 0) & (j >= 0) & (i < j) & ~barred
    edges = jnp.maximum(jnp.stack([i.ravel(), j.ravel()], axis=1), 0)
    return edges, counts.ravel(), jnp.sum(near) > size


def _nodes_of(topology: Topology, edges: Int[Array, "c 2"]) -> Int[Array, "c 4"]:
    """Start and end of both edges."""
    return jnp.asarray(topology.edge_nodes)[edges].reshape(-1, 4)


def _nearest(
    topology: Topology, x: Float[Array, "n 3"], pairs: Indices, diameter: Array, capacity: int
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """The smallest distance (m) of two edges that can touch, if it is less than a diameter, and
    whether there were too many pairs to look at them all."""
    edges, counts, overflow = _candidates(topology, x, pairs, diameter, capacity)
    apart = distance(x[_nodes_of(topology, edges)])
    return jnp.min(jnp.where(counts, apart, jnp.inf)), overflow


def _apart(pairs: Float[Array, "k 4 3"]) -> tuple[Float[Array, "k 3"], Float[Array, "k 2 2 3"]]:
    """The shortest vector between two edges, and those from ends of the second to the first's."""
    gap = between(pairs, *closest_points(pairs))
    return gap, pairs[:, :2, None] - pairs[:, None, 2:]


def _closing(
    topology: Topology,
    nodes: Int[Array, "k 4"],
    x: Float[Array, "n 3"],
    move: Float[Array, "n 3"],
) -> Float[Array, "k 2 2 3"]:
    """How the ends of two edges move by each other, seen from a filament that both are of.

    A filament that turns as a whole does not come closer to itself.
    """
    body = jnp.asarray(bodies(topology))[nodes]
    frames = rotation(turns(topology, x + move, move))[body[:, 0]]
    one = jnp.all(body == body[:, :1], axis=1)[:, None, None]
    frames = jnp.where(one, frames, jnp.eye(3))
    apart, later = (v[:, :2, None] - v[:, None, 2:] for v in (x[nodes], (x + move)[nodes]))
    return jnp.einsum("kji,kabj->kabi", frames, later) - apart


def closest(
    topology: Topology,
    x: Float[Array, "n 3"],
    move: Float[Array, "n 3"],
    pairs: Indices,
    reach: Array,
    within: Array,
    capacity: int,
) -> tuple[Int[Array, "k 2"], Int[Array, ""]]:
    """The pairs of edges that come close in a move, and how many there are.

    More than `capacity` of them if there are too many to find them all.

    Args:
        topology: of the rod.
        x: m, the nodes.
        move: m, of every node.
        pairs: the edges that may touch.
        reach: m; pairs that are farther apart than this are not looked at.
        within: m, the distance that is close.
        capacity: of the list.
    """
    edges, counts, overflow = _candidates(topology, x, pairs, reach, capacity)
    nodes = _nodes_of(topology, edges)
    gap, _ = _apart(x[nodes])
    apart = norm(gap)
    # A plane between the two edges that stays between them tells how far apart they remain.
    speed = dot(gap[:, None, None], _closing(topology, nodes, x, move))
    least = apart + jnp.minimum(jnp.min(speed, axis=(1, 2)), 0.0) / jnp.maximum(apart, TINY)
    close = counts & (apart < reach) & (least < within)
    (chosen,) = jnp.nonzero(close, size=capacity, fill_value=0)
    return edges[chosen], jnp.where(overflow, capacity + 1, jnp.sum(close))


@pytree
class Neighbours:
    """The pairs of edges that may touch during a step.

    Attributes:
        edges: (k, 2) of each pair.
        nodes: (k, 4) start and end of both edges.
        mask: (k,) which places of the list are in use.
        found: how many pairs came close, more than k if the list was too short.
        topology: of the rod.
        pairs: (p, 2) all edges that could ever touch.
        start: (n, 3) m, where the nodes were.
        diameter: m, of the rod.
        expected: (n, 3) m, where they were expected to go.
        margin: m, how far beyond the diameter pairs were found on that way.
        skin: m, the farthest that a node may go at a time.
    """

    edges: Int[Array, "k 2"]
    nodes: Int[Array, "k 4"]
    mask: Bool[Array, " k"]
    found: Int[Array, ""]
    topology: Topology = static()
    pairs: Indices = static()
    start: Float[Array, "n 3"]
    expected: Float[Array, "n 3"]
    diameter: Float[Array, ""]
    margin: Float[Array, ""]
    skin: Float[Array, ""]

    def _distances(self, x: Float[Array, "n 3"]) -> Float[Array, " k"]:
        return jnp.where(self.mask, distance(x[self.nodes]), jnp.inf)

    def max_step(self, q: Dofs, direction: Dofs) -> Array:
        """How much of `direction` no pair can get through each other within.

        In one go the two edges of a pair may approach by half of their distance at most, and
        no node may go farther than the search went. How two edges approach is how their ends do
        along the gap between them: a plane that has one edge on either side, before and after,
        keeps them apart on the way, however far they slide along each other.
        """

        def of_the_nearest() -> Array:
            x, move = (lax.stop_gradient(self._nodes(v)) for v in (q, direction))
            pairs = x[self.nodes]
            gap, apart = _apart(pairs)
            squared = jnp.where(self.mask, dot(gap, gap), jnp.inf)
            closing = _closing(self.topology, self.nodes, x, move)
            normal = gap[:, None, None]
            room = dot(normal, apart) - 0.5 * squared[:, None, None]
            speed = -dot(normal, closing)
            part = jnp.min(jnp.where(speed > room, room / speed, 1.0), axis=(1, 2))
            # Rods whose centre lines nearly cross have no such plane.
            most = jnp.sqrt(jnp.max(dot(closing, closing), axis=(1, 2)))
            least = jnp.where(most > 0.0, 0.5 * jnp.sqrt(squared) / most, 1.0)
            part = jnp.min(jnp.clip(jnp.maximum(part, least), 0.0, 1.0), initial=1.0)
            farthest = jnp.sqrt(jnp.max(dot(move, move)))
            return jnp.where(part * farthest > self.skin, self.skin / farthest, part)

        return lax.cond(self.found > 0, of_the_nearest, lambda: jnp.ones(()))

    def status(self, q: Dofs) -> Array:
        """Whether the list was too short, or a step that ends at `q` cannot be accepted."""
        x = self._nodes(q)
        astray = 2.0 * jnp.sqrt(jnp.max(jnp.sum((x - self.expected) ** 2, axis=1)))
        places = len(self.nodes)
        nearest, unseen = lax.cond(
            astray > self.margin,  # then pairs that were not listed may touch
            lambda: _nearest(self.topology, x, self.pairs, self.diameter, places),
            lambda: (jnp.min(self._distances(x)), jnp.array(False)),
        )
        return jnp.select(
            [
                (self.found > places) | unseen,
                astray > self.margin + self.diameter,
                nearest < (1.0 - PENETRATION) * self.diameter,
            ],
            [Status.CAPACITY, Status.TOO_FAST, Status.PENETRATION],
            Status.OK,
        ).astype(jnp.int32)

    def _nodes(self, q: Dofs) -> Float[Array, "n 3"]:
        return q[: self.start.size].reshape(self.start.shape)


def search(
    rod: Rod,
    state: State,
    move: Dofs,
    pairs: Indices,
    diameter: Array,
    capacity: int,
) -> Neighbours:
    """The pairs of edges that come as close as their diameter and a margin if nodes go as expected.

    The margin allows every node to go astray by three eighths of what `move` would take the
    fastest, and by a quarter of the diameter in any case. A step that goes astray farther has all
    pairs checked.

    Args:
        rod: whose edges.
        state: at the start of the step.
        move: (d,) how far the step is expected to go, m.
        pairs: (p, 2) the edges that may touch.
        diameter: m.
        capacity: places of the list.
    """
    topology = rod.topology
    x = lax.stop_gradient(positions(topology, state.q))
    moves = lax.stop_gradient(positions(topology, move))
    farthest = jnp.sqrt(jnp.max(dot(moves, moves)))
    skin, margin = 2.5 * farthest + 0.25 * diameter, 0.75 * farthest + 0.5 * diameter
    edges, found = closest(
        topology, x, moves, pairs, diameter + 2.0 * farthest + margin, diameter + margin, capacity
    )
    return Neighbours(
        edges=edges,
        nodes=_nodes_of(topology, edges),
        mask=jnp.arange(capacity) < found,
        found=found,
        topology=topology,
        pairs=pairs,
        start=x,
        expected=x + moves,
        diameter=lax.stop_gradient(diameter),
        margin=lax.stop_gradient(margin),
        skin=lax.stop_gradient(skin),
    )
