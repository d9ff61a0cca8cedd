"""Which pairs of edges come close: found anew at the start of every step."""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .potential import Dofs
from .pytree import Indices, pytree, static
from .rod import Rod, State, Topology, positions
from .segments import distance
from .status import Status

PENETRATION = 0.01
"""The part of their diameter by which rods may penetrate each other at the end of a step."""


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


@pytree
class Neighbours:
    """The pairs of edges that may touch during a step.

    Attributes:
        edges: (k, 2) of each pair.
        nodes: (k, 4) start and end of both edges.
        taken: (k,) which places of the list are in use.
        found: how many pairs came close, more than k if the list was too short.
        all_nodes: of every pair that could ever touch.
        start: (n, 3) m, where the nodes were.
        diameter: m, of the rod.
        skin: m, how far beyond the diameter the search went.
    """

    edges: Int[Array, "k 2"]
    nodes: Int[Array, "k 4"]
    taken: Bool[Array, " k"]
    found: Int[Array, ""]
    all_nodes: Indices = static()
    start: Float[Array, "n 3"]
    diameter: Float[Array, ""]
    skin: Float[Array, ""]

    def _distances(self, x: Float[Array, "n 3"]) -> Float[Array, " k"]:
        return jnp.where(self.taken, distance(x[self.nodes]), jnp.inf)

    def reach(self, q: Dofs, direction: Dofs) -> Array:
        """How much of `direction` no pair can get through each other within.

        In one go the two edges of a pair may approach by half of their distance at most, and
        no node may go farther than the search went.
        """

        def of_the_nearest() -> Array:
            x, move = (lax.stop_gradient(self._nodes(v)) for v in (q, direction))
            speed = jnp.sqrt(jnp.sum(move * move, axis=1))
            size = speed[self.nodes]
            approach = jnp.maximum(size[:, 0], size[:, 1]) + jnp.maximum(size[:, 2], size[:, 3])
            room = 0.5 * self._distances(x)
            part = jnp.min(jnp.where(approach > room, room / approach, 1.0), initial=1.0)
            farthest = jnp.max(speed)
            return jnp.where(part * farthest > self.skin, self.skin / farthest, part)

        return lax.cond(self.found > 0, of_the_nearest, lambda: jnp.ones(()))

    def fault(self, q: Dofs) -> Array:
        """Whether the list was too short, or a step that ends at `q` cannot be accepted."""
        x = self._nodes(q)
        moved = jnp.sqrt(jnp.max(jnp.sum((x - self.start) ** 2, axis=1)))
        every = self.all_nodes.array
        nearest = lax.cond(
            2.0 * moved > self.skin,  # then pairs that were not listed may touch
            lambda: jnp.min(distance(x[every])),
            lambda: jnp.min(self._distances(x)),
        )
        return jnp.select(
            [
                self.found > len(self.nodes),
                2.0 * moved > self.skin + self.diameter,
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
    """The pairs of edges that are closer than their diameter and a skin.

    The skin allows every node to go a quarter farther than `move` would take the fastest, and
    an eighth of the diameter in any case. A step that goes farther has all pairs checked.

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
    skin = 2.5 * jnp.sqrt(jnp.max(jnp.sum(moves * moves, axis=1))) + 0.25 * diameter
    all_nodes = topology.edge_nodes[pairs.array].reshape(-1, 4)
    close = distance(x[all_nodes]) < diameter + skin
    (chosen,) = jnp.nonzero(close, size=capacity, fill_value=0)
    found = jnp.sum(close)
    return Neighbours(
        edges=jnp.asarray(pairs.array)[chosen],
        nodes=jnp.asarray(all_nodes)[chosen],
        taken=jnp.arange(capacity) < found,
        found=found,
        all_nodes=Indices(all_nodes),
        start=x,
        diameter=lax.stop_gradient(diameter),
        skin=lax.stop_gradient(skin),
    )
