"""Regularized Stokeslet segments for large robots: exact nearby, points far away, never inverted.

The mobility A of `stokeslets` is taken apart by blocks of some nodes in a row:

- within a block it is the inverse of the symmetric part of A^-1, as `drag_matrix = "symmetric"`
  has it for a whole robot;
- between the pairs of blocks that are closest, and always between neighbours on a filament, it is
  A with its transpose, averaged;
- between all others nodes act as points with the same blob, which leaves out a part (h / r)^2 / 24
  of what two segments of length h at a distance r do to each other.

What segments and points do is asked of the `Domain`, which says what the fluid is bounded by.

It is only ever multiplied with forces: memory is in proportion to the number of nodes, and time
to its square, but with the few operations that a pair of points takes.
"""

from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ...core.pytree import Indices, pytree, replace, static
from ...rods.kinematics import positions
from ...rods.rod import Rod, State
from ...solve.blocks import Layout
from ...solve.contributions import Mobility
from ..term import Prediction, Role, Stage, Term
from .domain import FREE_SPACE, Domain
from .kernels import joined

NEAR = 6
"""Pairs of blocks that are treated segment by segment, per block."""

LUMP = 4
"""Nodes in a row that are one point where the far field need not be exact."""


@pytree
class Places:
    """Where the nodes of every block are, and the one before and after. Hashable.

    Attributes:
        nodes: (b, m) nodes of every block; -1 where a filament is at its end.
        around: (b, m + 2) those, the node before and the node after; -1 where there is none.
        wet: (n_wet,) all nodes, in order.
    """

    nodes: Indices = static()
    around: Indices = static()
    wet: Indices = static()


def places(layout: Layout) -> Places:
    """The nodes of the blocks of a layout."""
    nodes = layout.nodes
    along = np.pad(nodes.reshape(len(nodes), -1), ((0, 0), (1, 1)), constant_values=-1)
    starts = np.arange(nodes.shape[1]) * layout.size
    around = along[:, starts[:, None] + np.arange(layout.size + 2)]
    flat = nodes.reshape(-1, layout.size)
    return Places(Indices(flat), Indices(around.reshape(len(flat), -1)), Indices(flat[flat >= 0]))


@pytree
class BlockStokeslets(Term):
    """`Phi = 1/2 v . A^-1 v`: non-local drag of all filaments on each other, by blocks.

    Attributes:
        viscosity: Pa s.
        regularization: eps, m.
        layout: the blocks.
        end_nodes: "half" or "full"; see `stokeslets.mobility`.
        domain: what the fluid is bounded by.
    """

    role: ClassVar[Role] = Role.DRAG

    viscosity: Float[Array, ""]
    regularization: Float[Array, ""]
    layout: Layout = static()
    end_nodes: str = static(default="half")
    domain: Domain = FREE_SPACE

    def prepare(self, rod: Rod, state: State, prediction: Prediction) -> "BlockMobility":
        """The mobility where the rod is expected to be."""
        return block_mobility(self, positions(rod.topology, prediction.configuration))

    def contribution(
        self, rod: Rod, state: State, stage: Stage, cache: "BlockMobility"
    ) -> Mobility:
        wet = places(self.layout).wet.array
        dofs = Indices(rod.topology.node_dofs(wet).ravel())
        return Mobility(dofs, cache, stage.fluid_origin_from(state), stage.length)


@pytree
class BlockMobility:
    """A linear map of forces on all wet nodes (N) to their velocities (m/s), by blocks.

    Attributes:
        layout: the blocks.
        own: (b, 3m, 3m) of every block on itself, m/(N s).
        resistance: (b, 3m, 3m) its inverse, N s/m; zero for nodes that are not there.
        pairs: (p, 2) blocks that are close.
        between: (p, 3m, 3m) of the second on the first, m/(N s).
        points: (b, p, 3) m, what acts on blocks that are not close; where there is none, the
            place of another.
        viscosity: Pa s.
        regularization: m.
        domain: what the fluid is bounded by.
        lump: nodes in a row that one point stands for.
    """

    layout: Layout = static()
    own: Float[Array, "b k k"]
    resistance: Float[Array, "b k k"]
    pairs: Int[Array, "p 2"]
    between: Float[Array, "p k k"]
    points: Float[Array, "b p 3"]
    viscosity: Float[Array, ""]
    regularization: Float[Array, ""]
    domain: Domain
    lump: int = static(default=1)

    @property
    def coarse(self) -> "BlockMobility":
        """Nearly the same map, of a fraction of the time: symmetric as well, and exactly what it
        is for blocks that are close; for others, `LUMP` nodes in a row are one point."""
        present = jnp.asarray(self._there, float)[..., None]
        number = self._lumped(present, LUMP)
        middle = self._lumped(present * self.points, LUMP) / jnp.maximum(number, 1.0)
        points = jnp.where(number > 0.0, middle, self.points[0, 0])
        return replace(self, points=points, lump=LUMP)

    def _lumped(self, nodal: Float[Array, "b m k"], lump: int) -> Float[Array, "b p k"]:
        """Sums over nodes in a row."""
        n_blocks, m, k = nodal.shape
        padded = jnp.pad(nodal, ((0, 0), (0, -m % lump), (0, 0)))
        return jnp.sum(padded.reshape(n_blocks, -1, lump, k), axis=2)

    @property
    def _there(self) -> np.ndarray:
        """(b, m) where there is a node."""
        return self.layout.nodes.reshape(-1, self.layout.size) >= 0

    def blocks(self, vector: Float[Array, " w"]) -> Float[Array, "b k"]:
        """A vector over the wet nodes in blocks, zero where there is no node."""
        number = np.where(self._there, np.cumsum(self._there).reshape(self._there.shape) - 1, -1)
        return jnp.pad(vector.reshape(-1, 3), ((0, 1), (0, 0)))[number].reshape(len(number), -1)

    def flat(self, blocks: Float[Array, "b k"]) -> Float[Array, " w"]:
        """And back."""
        return blocks.reshape(*self._there.shape, 3)[np.nonzero(self._there)].ravel()

    def precondition(self, velocity: Float[Array, " w"]) -> Float[Array, " w"]:
        """The forces (N) that move every block as if it were alone (m/s)."""
        return self.flat(jnp.einsum("bij,bj->bi", self.resistance, self.blocks(velocity)))

    def mv(self, force: Float[Array, " w"]) -> Float[Array, " w"]:
        """The velocities (m/s) for forces (N)."""
        f = self.blocks(force)
        first, second = self.pairs.T
        u = jnp.einsum("bij,bj->bi", self.own, f)
        u = u.at[first].add(jnp.einsum("pij,pj->pi", self.between, f[second]))
        u = u.at[second].add(jnp.einsum("pij,pi->pj", self.between, f[first]))
        return self.flat(u + self._far(f))

    def _far(self, f: Float[Array, "b k"]) -> Float[Array, "b k"]:
        """Velocities for forces on all blocks but those that are close."""
        n_blocks, m = self._there.shape
        far = 1.0 - jnp.eye(n_blocks)
        first, second = self.pairs.T
        far = far.at[first, second].set(0.0).at[second, first].set(0.0)
        forces = self._lumped(f.reshape(n_blocks, m, 3), self.lump)
        u = self._of_points(forces, far)
        u = jnp.repeat(u / (8.0 * jnp.pi * self.viscosity), self.lump, axis=1)[:, :m]
        return (u * self._there[:, :, None]).reshape(n_blocks, -1)

    def _of_points(
        self, forces: Float[Array, "b p 3"], felt: Float[Array, "b b"]
    ) -> Float[Array, "b p 3"]:
        """8 pi mu u at points, for forces on the points of the blocks that are `felt`."""
        sources = self.points.reshape(-1, 3)

        def on(given: tuple[Array, Array]) -> Float[Array, "p 3"]:
            targets, felt = given
            acting = (felt[:, None, None] * forces).reshape(-1, 3)
            return self.domain.point_flow(targets, sources, acting, self.regularization)

        return lax.map(on, (self.points, felt))


def block_mobility(segments: BlockStokeslets, x: Float[Array, "n 3"]) -> BlockMobility:
    """The mobility for nodes at `x` (m)."""
    where = places(segments.layout)
    around, nodes = where.around.array, where.nodes.array
    there = np.repeat(nodes >= 0, 3, axis=1).astype(float)
    present = there[:, :, None] * there[:, None, :]
    absent = np.eye(there.shape[1]) * (1.0 - there)[:, None, :]
    # Nodes that are not there stand where the first is, segments where the first is: nothing comes
    # of them, but what is computed for them must be finite in any domain.
    spare = x[around[0, 1:3]]
    extended = jnp.where((around < 0)[..., None], spare[0], x[around])
    kernel = partial(_block, segments, spare)
    linked = jnp.asarray((around[:, 1:] >= 0) & (around[:, :-1] >= 0), float)

    own = jax.vmap(kernel)(extended[:, 1:-1], extended, linked)
    own = own * present + absent
    inverse = jnp.linalg.inv(own)
    resistance = 0.5 * (inverse + jnp.swapaxes(inverse, 1, 2))
    own = jnp.linalg.inv(resistance)

    pairs = _close_pairs(segments.layout, lax.stop_gradient(extended[:, 1:-1]), nodes >= 0)
    first, second = pairs.T

    def there_and_back(pair: tuple[Array, Array]) -> Float[Array, "k k"]:
        a, b = pair
        there = kernel(extended[a, 1:-1], extended[b], linked[b])
        back = kernel(extended[b, 1:-1], extended[a], linked[a])
        return 0.5 * (there + back.T)

    between = lax.map(there_and_back, (first, second))
    known = jnp.asarray(there)
    between = between * known[first][:, :, None] * known[second][:, None, :]
    return BlockMobility(
        segments.layout,
        own * present,
        resistance * present,
        pairs,
        between,
        extended[:, 1:-1],
        segments.viscosity,
        segments.regularization,
        segments.domain,
    )


def _block(
    segments: BlockStokeslets,
    spare: Float[Array, "2 3"],
    targets: Float[Array, "m 3"],
    around: Float[Array, "m+2 3"],
    linked: Float[Array, " m+1"],
) -> Float[Array, "3m 3m"]:
    """Mobility of the forces on the nodes of one block at some targets, m/(N s).

    Args:
        segments: the fluid.
        spare: m, the ends of a segment that is there, where those stand that are not.
        targets: m.
        around: m, the nodes of the block, the one before and the one after.
        linked: 1 for segments that are there, 0 for others.
    """
    there = linked[:, None] > 0.0
    starts = jnp.where(there, around[:-1], spare[0])
    ends = jnp.where(there, around[1:], spare[1])
    m1, m2 = segments.domain.segment_kernels(targets, starts, ends, segments.regularization)
    edge = ends - starts
    length = linked * jnp.sqrt(jnp.sum(edge * edge, axis=1))
    if segments.end_nodes == "full":
        length, stands_for = linked, 1.0
    else:
        stands_for = 0.5 * (length[:-1] + length[1:])
        stands_for = jnp.where(stands_for > 0.0, stands_for, 1.0)

    def of_node(m1: Float[Array, "m m+1"], m2: Float[Array, "m m+1"]) -> Float[Array, "m m"]:
        return (length[:-1] * m2[:, :-1] + length[1:] * m1[:, 1:]) / stands_for

    return joined(jax.tree.map(of_node, m1, m2)) / (8.0 * jnp.pi * segments.viscosity)


def _close_pairs(layout: Layout, x: Float[Array, "b m 3"], there: np.ndarray) -> Int[Array, "p 2"]:
    """The pairs of blocks that are closest, neighbours on a filament first."""
    n_blocks = len(there)
    first, second = np.triu_indices(n_blocks, 1)
    if len(first) == 0:
        return jnp.zeros((0, 2), jnp.int32)
    weight = jnp.asarray(there / np.maximum(there.sum(1, keepdims=True), 1))
    known = jnp.where(there[..., None], x, 0.0)
    centre = jnp.sum(weight[..., None] * known, axis=1)
    away = jnp.where(there, jnp.sqrt(jnp.sum((known - centre[:, None]) ** 2, axis=-1)), 0.0)
    radius = jnp.max(away, axis=1)
    apart = jnp.sqrt(jnp.sum((centre[first] - centre[second]) ** 2, axis=-1))
    gap = apart - radius[first] - radius[second]
    per_filament = layout.nodes.shape[1]
    chained = (second == first + 1) & (first // per_filament == second // per_filament)
    _, chosen = lax.top_k(jnp.where(chained, jnp.inf, -gap), min(NEAR * n_blocks, len(first)))
    return jnp.stack([jnp.asarray(first)[chosen], jnp.asarray(second)[chosen]], axis=1)
