"""Large robots in pieces: a matrix of blocks along every filament, factored from tip to base.

Every filament is cut into blocks of some nodes in a row. Rods only couple a block to the next
and the first block of a filament to what is not in any filament, the border (heads, arms,
shafts). A matrix with that pattern,

    D_k          of every block,
    O_k          of block k + 1 with block k,
    U            of the first block of a filament with the border,
    B            of the border,

is eliminated from the tips to the bases and then to the border, all filaments at a time. It
takes time and memory in proportion to the number of nodes.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..core.pytree import pytree, static
from ..rods.topology import Topology
from .contributions import LocalHessians
from .dense import ridge

T = TypeVar("T")


@pytree
class Layout:
    """Which degrees of freedom of a robot stand in which block. Hashable.

    Attributes:
        topology: of the robot.
        size: m, nodes of a block.
    """

    topology: Topology = static()
    size: int = static()

    @cached_property
    def nodes(self) -> np.ndarray:
        """(f, b, m) the nodes of every block; -1 where a filament is at its end."""
        paths = self.topology.filaments
        n_blocks = -(-max(len(path) for path in paths) // self.size)
        nodes = np.full((len(paths), n_blocks * self.size), -1)
        for k, path in enumerate(paths):
            nodes[k, : len(path)] = path
        return nodes.reshape(len(paths), n_blocks, self.size)

    @property
    def width(self) -> int:
        """w, degrees of freedom of a block: of every node, and of the edge that leads to it."""
        return 4 * self.size

    @cached_property
    def dofs(self) -> np.ndarray:
        """(f, b, w) degrees of freedom of every block; the number d where there is none."""
        topology, nodes = self.topology, self.nodes
        none = topology.n_dofs
        ending = {frozenset(ends): e for e, ends in enumerate(topology.edges)}
        positions = np.where(nodes[..., None] < 0, none, 3 * nodes[..., None] + np.arange(3))
        angles = np.full(nodes.shape, none)
        for k, path in enumerate(topology.filaments):
            places = angles[k].reshape(-1)
            for i in range(1, len(path)):
                edge = ending[frozenset((path[i - 1], path[i]))]
                places[i] = 3 * topology.n_nodes + edge
        return np.concatenate([positions.reshape(*nodes.shape[:2], -1), angles], axis=-1)

    @cached_property
    def border(self) -> np.ndarray:
        """(g,) the degrees of freedom that are in no block."""
        return np.setdiff1d(np.arange(self.topology.n_dofs), self.dofs)

    @cached_property
    def _home(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(d + 1,) of every degree of freedom: filament (-1: border), block, and place in it."""
        filament = np.full(self.topology.n_dofs + 1, -1, dtype=np.int32)
        block, place = np.zeros_like(filament), np.zeros_like(filament)
        f, b, p = np.indices(self.dofs.shape)
        filament[self.dofs], block[self.dofs], place[self.dofs] = f, b, p
        place[self.border] = np.arange(len(self.border))
        return filament, block, place

    @property
    def _sizes(self) -> tuple[int, int, int, int]:
        """Entries of all D, O, U and B."""
        (f, b, w), g = self.dofs.shape, len(self.border)
        return f * b * w * w, f * (b - 1) * w * w, f * w * g, g * g

    def _place(self, rows: Any, columns: Any, xp: Any) -> Any:
        """Where the entries of a matrix are stored, in one vector; its last place if nowhere."""
        (_, b, w), g = self.dofs.shape, len(self.border)
        starts = np.cumsum([0, *self._sizes])
        filament, block, place = (xp.asarray(a) for a in self._home)
        f0, f1 = filament[rows], filament[columns]
        b0, b1 = block[rows], block[columns]
        p0, p1 = place[rows], place[columns]
        inside = (f0 == f1) & (f0 >= 0)
        return xp.select(
            [
                inside & (b0 == b1),
                inside & (b0 == b1 + 1),
                (f0 >= 0) & (b0 == 0) & (f1 < 0),
                (f0 < 0) & (f1 < 0),
            ],
            [
                starts[0] + ((f0 * b + b0) * w + p0) * w + p1,
                starts[1] + ((f0 * (b - 1) + b1) * w + p0) * w + p1,
                starts[2] + (f0 * w + p0) * g + p1,
                starts[3] + p0 * g + p1,
            ],
            starts[4],
        )

    def gather(self, q: Float[Array, " d"]) -> Float[Array, "f b w"]:
        """A vector in blocks, with zeros where there is no degree of freedom."""
        return jnp.pad(q, (0, 1))[self.dofs]

    def scatter(
        self, blocks: Float[Array, "f b w"], border: Float[Array, " g"]
    ) -> Float[Array, " d"]:
        """The vector that has these blocks."""
        filament, block, place = (a[:-1] for a in self._home)
        inside = (filament * self.dofs.shape[1] + block) * self.width + place
        where = np.where(filament >= 0, inside, self.dofs.size + place)
        return jnp.concatenate([blocks.ravel(), border])[where]


@pytree
class SmallMatrices:
    """A large matrix, as a sum of small ones on the degrees of freedom of elements.

    Those of pairs that touch are zero as long as none does: then nothing is done with them.

    Attributes:
        parts: for elements of one kind, their degrees of freedom (e, k) and matrices (e, k, k).
        used: for every kind, whether any is other than zero; None where that need not be asked.
    """

    parts: LocalHessians
    used: tuple[Bool[Array, ""] | None, ...]

    @classmethod
    def of(cls, parts: LocalHessians) -> "SmallMatrices":
        """Those on stencils that are known before are always in use."""
        known = (isinstance(dofs, np.ndarray) for dofs, _ in parts)
        used = zip(parts, known, strict=True)
        return cls(parts, tuple(None if k else jnp.any(m != 0.0) for (_, m), k in used))

    @property
    def absolute(self) -> "SmallMatrices":
        """With the absolute values of all entries."""
        return SmallMatrices(tuple((dofs, jnp.abs(m)) for dofs, m in self.parts), self.used)

    def added(self, total: T, add: Callable[[T, Any, Array], T]) -> T:
        """With what every kind in use adds to a total."""
        for (dofs, matrices), used in zip(self.parts, self.used, strict=True):

            def more(total: T, dofs: Any = dofs, matrices: Array = matrices) -> T:
                return add(total, dofs, matrices)

            total = more(total) if used is None else lax.cond(used, more, lambda same: same, total)
        return total

    def __matmul__(self, q: Float[Array, " d"]) -> Float[Array, " d"]:
        """The product with a vector."""

        def add(product: Array, dofs: Any, matrices: Array) -> Array:
            return product.at[dofs].add(jnp.einsum("eij,ej->ei", matrices, q[dofs]))

        return self.added(jnp.zeros_like(q), add)


@pytree
class BlockMatrix:
    """A symmetric matrix with the pattern of a layout.

    Attributes:
        layout: the pattern.
        entries: all of D, O, U and B, and a last one that belongs nowhere.
    """

    layout: Layout = static()
    entries: Float[Array, " s"]

    @property
    def parts(self) -> tuple[Array, Array, Array, Array]:
        """D (f, b, w, w), O (f, b - 1, w, w), U (f, w, g) and B (g, g)."""
        (f, b, w), g = self.layout.dofs.shape, len(self.layout.border)
        shapes = (f, b, w, w), (f, b - 1, w, w), (f, w, g), (g, g)
        ends = np.cumsum(self.layout._sizes)
        pieces = jnp.split(self.entries[:-1], ends[:-1])
        d, o, u, border = (p.reshape(s) for p, s in zip(pieces, shapes, strict=True))
        return d, o, u, border

    @property
    def diagonal(self) -> Float[Array, " d"]:
        """Its diagonal."""
        d, _, _, border = self.parts
        return self.layout.scatter(jnp.diagonal(d, axis1=-2, axis2=-1), jnp.diagonal(border))


def assemble(
    layout: Layout,
    matrices: SmallMatrices,
    diagonal: Float[Array, " d"],
    drag: Float[Array, "f b k k"],
    free: Float[Array, " d"],
) -> BlockMatrix:
    """The part of a sum of small matrices that has the pattern of a layout.

    Args:
        layout: the pattern. What couples other blocks is left out.
        matrices: the sum.
        diagonal: what is added to the diagonal.
        drag: added to the positions of every block, k = 3 m.
        free: 1 for degrees of freedom that may move, 0 for those that are held: the matrix is
            the identity on them.
    """

    def add(entries: Array, dofs: Any, matrices: Array) -> Array:
        xp = np if isinstance(dofs, np.ndarray) else jnp
        places = layout._place(dofs[:, :, None], dofs[:, None, :], xp)
        both = free[dofs]
        return entries.at[places].add(matrices * both[:, :, None] * both[:, None, :])

    entries = matrices.added(jnp.zeros(sum(layout._sizes) + 1), add)
    every = np.arange(layout.topology.n_dofs)
    here = layout._place(every, every, np)
    entries = entries.at[here].add(jnp.where(free > 0, diagonal, 1.0))
    d, o, u, border = BlockMatrix(layout, entries).parts
    moving = layout.gather(free)
    wet = moving[..., : drag.shape[-1]]
    rest = layout.width - drag.shape[-1]
    d = d + jnp.pad(
        drag * wet[..., :, None] * wet[..., None, :], ((0, 0), (0, 0), *[(0, rest)] * 2)
    )
    absent = np.asarray(layout.dofs == layout.topology.n_dofs, float)
    d = d + absent[..., :, None] * np.eye(layout.width)
    parts = [p.ravel() for p in (d, o, u, border)]
    return BlockMatrix(layout, jnp.concatenate([*parts, jnp.zeros(1)]))


@pytree
class BlockFactor:
    """The Cholesky factor of a matrix of blocks.

    Attributes:
        layout: the pattern.
        inverse: (b, f, w, w) L_k^-1, from the tips on.
        below: (b, f, w, w) L_k^-1 O_(k-1), from the tips on; the last is zero.
        base: (f, w, g) L_0^-1 U.
        border: (g, g) inverse of the factor of what is left for the border.
    """

    layout: Layout = static()
    inverse: Float[Array, "b f w w"]
    below: Float[Array, "b f w w"]
    base: Float[Array, "f w g"]
    border: Float[Array, "g g"]

    def solve(self, q: Float[Array, " d"]) -> Float[Array, " d"]:
        """The product of the inverse of the matrix with a vector."""
        blocks = jnp.moveaxis(self.layout.gather(q), 1, 0)[::-1]

        def towards_base(known, given):
            inverse, below, b = given
            y = jnp.einsum("fij,fj->fi", inverse, b - known)
            return jnp.einsum("fij,fi->fj", below, y), y

        still = jnp.zeros_like(blocks[0])
        _, y = lax.scan(towards_base, still, (self.inverse, self.below, blocks))
        border = self.border @ (q[self.layout.border] - jnp.einsum("fij,fi->j", self.base, y[-1]))
        border = self.border.T @ border
        first = y[-1] - jnp.einsum("fij,j->fi", self.base, border)
        y = y.at[-1].set(first)

        def towards_tip(x, given):
            inverse, below, y = given
            x = jnp.einsum("fji,fj->fi", inverse, y - jnp.einsum("fij,fj->fi", below, x))
            return x, x

        _, x = lax.scan(towards_tip, still, (self.inverse, self.below, y), reverse=True)
        return self.layout.scatter(jnp.moveaxis(x[::-1], 0, 1), border)


def _inverse_factor(matrix: Float[Array, "*b k k"]) -> Float[Array, "*b k k"]:
    """The inverse of the Cholesky factor; NaN if there is none."""
    lower = lax.linalg.cholesky(matrix, symmetrize_input=False)
    identity = jnp.broadcast_to(jnp.eye(matrix.shape[-1]), matrix.shape)
    return lax.linalg.triangular_solve(lower, identity, left_side=True, lower=True)


def _heavier(matrices: Float[Array, "*b k k"], added: Float[Array, "*b k"]) -> Array:
    """Matrices with something added to their diagonals."""
    return matrices + added[..., None] * jnp.eye(added.shape[-1])


def _factor(matrix: BlockMatrix, added: Float[Array, " d"]) -> BlockFactor:
    """The factor with something added to the diagonal."""
    d, o, u, border = matrix.parts
    from_tip = jnp.moveaxis(_heavier(d, matrix.layout.gather(added)), 1, 0)[::-1]
    couplings = jnp.pad(jnp.moveaxis(o, 1, 0)[::-1], ((0, 1), (0, 0), (0, 0), (0, 0)))

    def towards_base(taken, given):
        diagonal, coupling = given
        inverse = _inverse_factor(diagonal - taken)
        below = inverse @ coupling
        return jnp.swapaxes(below, -1, -2) @ below, (inverse, below)

    nothing = jnp.zeros_like(from_tip[0])
    _, (inverse, below) = lax.scan(towards_base, nothing, (from_tip, couplings))
    base = inverse[-1] @ u
    left = _heavier(border, added[matrix.layout.border]) - jnp.einsum("fij,fik->jk", base, base)
    return BlockFactor(matrix.layout, inverse, below, base, _inverse_factor(left))


def factor_blocks(matrix: BlockMatrix, unit: Float[Array, " d"]) -> BlockFactor:
    """Factor a matrix. One that is not positive definite gets more and more of its `ridge`.

    Args:
        matrix: to factor.
        unit: N and N m, of each degree of freedom; zero for those that are held.
    """
    added = ridge(matrix.diagonal, unit)

    def retry(carry):
        _, shift = carry
        shift = jnp.where(shift == 0.0, 1e-8, 10.0 * shift)
        return _factor(matrix, shift * added), shift

    def indefinite(carry):
        factor, shift = carry
        bad = jnp.any(jnp.isnan(factor.inverse[:, :, -1])) | jnp.any(jnp.isnan(factor.border))
        return bad & (shift < 1e4)

    start = (_factor(matrix, jnp.zeros_like(added)), jnp.zeros(()))
    return lax.while_loop(indefinite, retry, start)[0]
