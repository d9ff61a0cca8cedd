"""What a rod is made of and what is joined to what: nodes, edges and hinges.

A rod is a set of nodes joined by edges, with an angle on each edge. It bends and twists at
*hinges*, (edge, node, edge) stencils with an orientation sign for each edge, so that several
filaments may meet at one body: a chain is the special case in which every sign is +1.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ..core.pytree import Indices, pytree, static


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
        motors: the hinges that motors turn.
        motor_hinge: how these bend. "rigid": as all others, at every angle of the motor.
            "published": with the motor as a natural twist, and the curvature on the average of
            directors across it, whose stiffness is EI cos^2(angle / 2): limp once in every turn.
        driven_edges: the clamped edges whose angle is driven; a rod has one or the other.
        fixed_dofs: degrees of freedom held fixed.
    """

    n_nodes: int = static()
    edges: tuple[tuple[int, int], ...] = static()
    hinges: tuple[tuple[int, int], ...] = static()
    filaments: tuple[tuple[int, ...], ...] = static(default=())
    head: Head | None = static(default=None)
    motors: tuple[int, ...] = static(default=())
    motor_hinge: str = static(default="rigid")
    driven_edges: tuple[int, ...] = static(default=())
    fixed_dofs: tuple[int, ...] = static(default=())

    @property
    def n_edges(self) -> int:
        return len(self.edges)

    @property
    def n_dofs(self) -> int:
        """Degrees of freedom: three per node, then one angle per edge."""
        return 3 * self.n_nodes + self.n_edges

    @cached_property
    def free_dofs(self) -> np.ndarray:
        """The degrees of freedom that are not held fixed."""
        return np.setdiff1d(np.arange(self.n_dofs), self.fixed_dofs)

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
        return np.all(np.isin(self.edge_stencil.array, self.fixed_dofs), axis=1)

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
