"""Slender filaments in Stokes flow: regularized Stokeslet segments.

Every edge of a filament carries a force density that is linear along it. The flow of such segments
is asked of the `Domain`, which says what the fluid is bounded by; here it is collocated at the
nodes, and made a drag.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from ...core.pytree import Indices, jvp_nonzero, pytree, replace, static
from ...rods.kinematics import positions
from ...rods.rod import Rod, State
from ...solve.contributions import Quadratic
from ...solve.dense import inverse as inverted
from ..term import Prediction, Role, Stage, Term
from .domain import FREE_SPACE, Domain
from .kernels import joined


def _by_node(starts: Float[Array, "*b s"], ends: Float[Array, "*b s"]) -> Float[Array, "*b n"]:
    """Sums over the segments of a filament what belongs to the nodes they start and end at."""
    inner = starts[..., 1:] + ends[..., :-1]
    return jnp.concatenate([starts[..., :1], inner, ends[..., -1:]], axis=-1)


def _weighted(
    length: Float[Array, " s"],
    stands_for: Float[Array, " n"],
    starts: Float[Array, "*b s"],
    ends: Float[Array, "*b s"],
) -> Float[Array, "*b n"]:
    """The same of what is given for a density, by the force on a node over its length of rod."""
    return _by_node(length * starts, length * ends) / stands_for


def mobility(
    filaments: tuple[Float[Array, "_ 3"], ...],
    viscosity: Array,
    regularization: Array,
    end_nodes: str,
    domain: Domain = FREE_SPACE,
) -> Float[Array, "3m 3m"]:
    """Matrix (m/(N s)) that takes forces on the nodes of `filaments` to their velocities.

    Args:
        filaments: the nodes (m) of each filament, in order.
        viscosity: Pa s.
        regularization: eps, m.
        end_nodes: how a nodal force becomes a force density. "half": by the length of rod
            that the node stands for, half a segment at the two ends. "full": by the length
            of one segment everywhere, as published codes have it; it gives the end nodes
            twice the length that they stand for.
        domain: what the fluid is bounded by.
    """
    targets = jnp.concatenate(filaments)
    columns = []
    for nodes in filaments:
        m1, m2 = domain.segment_kernels(targets, nodes[:-1], nodes[1:], regularization)
        if end_nodes == "half":
            length = _lengths(nodes)
            stands_for = _by_node(length / 2, length / 2)
            of_node = partial(_weighted, length, stands_for)
        else:
            of_node = _by_node
        columns.append(jax.tree.map(of_node, m1, m2))
    whole = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-1), *columns)
    return joined(whole) / (8.0 * jnp.pi * viscosity)


def flow(
    filaments: tuple[Float[Array, "_ 3"], ...],
    forces: Float[Array, "m 3"],
    viscosity: Array,
    regularization: Array,
    end_nodes: str,
    domain: Domain = FREE_SPACE,
) -> Float[Array, "m 3"]:
    """The product of `mobility` with forces (N) on all nodes: their velocities (m/s)."""
    targets, total, place = jnp.concatenate(filaments), jnp.zeros_like(forces), 0
    for nodes in filaments:
        own = forces[place : place + len(nodes)]
        place += len(nodes)
        segments = nodes[:-1], nodes[1:], *_densities(nodes, own, end_nodes)
        total += domain.segment_flow(targets, *segments, regularization)
    return total / (8.0 * jnp.pi * viscosity)


def pull(
    filaments: tuple[Float[Array, "_ 3"], ...],
    vectors: Float[Array, "m 3"],
    viscosity: Array,
    regularization: Array,
    end_nodes: str,
    domain: Domain = FREE_SPACE,
) -> Float[Array, "m 3"]:
    """The product of the transpose of `mobility` with a vector for every node."""
    targets, parts = jnp.concatenate(filaments), []
    for nodes in filaments:
        both = domain.segment_pull(targets, nodes[:-1], nodes[1:], vectors, regularization)
        densities = partial(_densities, nodes, end_nodes=end_nodes)
        parts += jax.linear_transpose(densities, nodes)(both)
    return jnp.concatenate(parts) / (8.0 * jnp.pi * viscosity)


def _densities(
    nodes: Float[Array, "n 3"], forces: Float[Array, "n 3"], end_nodes: str
) -> tuple[Float[Array, "n-1 3"], Float[Array, "n-1 3"]]:
    """Force densities at the start and the end of every segment, times its length: N."""
    if end_nodes == "full":
        return forces[:-1], forces[1:]
    length = _lengths(nodes)
    density = forces / _by_node(length / 2, length / 2)[:, None]
    return length[:, None] * density[:-1], length[:, None] * density[1:]


def _lengths(nodes: Float[Array, "n 3"]) -> Float[Array, " n-1"]:
    edge = nodes[1:] - nodes[:-1]
    return jnp.sqrt(jnp.sum(edge * edge, axis=1))


@pytree
class StokesletSegments(Term):
    """`Phi = 1/2 v . R v`: non-local drag of all filaments on each other.

    The mobility A (velocities from forces, by collocation at the nodes) is not quite
    symmetric, as the exact one is. `drag_matrix` says what is made of it:

    - "symmetric": R is the symmetric part of A^-1, a true dissipation potential;
    - "collocation": R = A^-1, which has no potential;
    - "lower_triangle": R = B^-1, with B the symmetric matrix that shares the lower triangle
      of A: what codes compute that hand A to a Cholesky or LDL^T solver.

    Attributes:
        viscosity: Pa s.
        regularization: eps, m.
        solved: node paths that take part in the solve.
        dragged: nodes among them on which the force acts; forces on the others are dropped.
        end_nodes: "half" or "full"; see `mobility`.
        drag_matrix: see above.
        domain: what the fluid is bounded by.
    """

    role: ClassVar[Role] = Role.DRAG

    viscosity: Float[Array, ""]
    regularization: Float[Array, ""]
    solved: tuple[tuple[int, ...], ...] = static()
    dragged: tuple[int, ...] = static()
    end_nodes: str = static(default="half")
    drag_matrix: str = static(default="symmetric")
    domain: Domain = FREE_SPACE

    @property
    def nodes(self) -> np.ndarray:
        """The nodes that take part in the solve."""
        return np.concatenate([np.array(path) for path in self.solved])

    @property
    def symmetric(self) -> bool:
        everywhere = set(self.dragged) == {n for path in self.solved for n in path}
        return everywhere and self.drag_matrix != "collocation"

    def mobility(self, x: Float[Array, "n 3"]) -> Float[Array, "3m 3m"]:
        """Matrix (m/(N s)) whose inverse `drag_matrix` is made of, for nodes at `x` (m)."""
        a = mobility(self._filaments(x), *self._fluid)
        if self.drag_matrix == "lower_triangle":
            a = jnp.tril(a) + jnp.tril(a, -1).T
        return a

    def product(self, x: Float[Array, "n 3"], force: Float[Array, " 3m"]) -> Float[Array, " 3m"]:
        """That matrix times forces (N): velocities, m/s."""
        if self.drag_matrix == "lower_triangle":
            return self.mobility(x) @ force
        return self._through(flow, x, force)

    def transposed_product(
        self, x: Float[Array, "n 3"], vector: Float[Array, " 3m"]
    ) -> Float[Array, " 3m"]:
        """The transpose of that matrix times a vector."""
        if self.drag_matrix == "lower_triangle":
            return self.mobility(x) @ vector
        return self._through(pull, x, vector)

    def _through(self, map_: Callable[..., Array], x: Array, vector: Array) -> Array:
        return map_(self._filaments(x), vector.reshape(-1, 3), *self._fluid).ravel()

    def _filaments(self, x: Float[Array, "n 3"]) -> tuple[Float[Array, "_ 3"], ...]:
        return tuple(x[np.array(path)] for path in self.solved)

    @property
    def _fluid(self) -> tuple[Array, Array, str, Domain]:
        return self.viscosity, self.regularization, self.end_nodes, self.domain

    def resistance(self, x: Float[Array, "n 3"]) -> Float[Array, "3m 3m"]:
        """Matrix (N s/m) that takes velocities of the solved nodes to the drag on them.

        Differentiable, unlike the matrix of `prepare`, whose derivatives only products have.
        """
        return Resistance(self, x, jnp.linalg.inv(self.mobility(x)), jnp.ones(())).matrix()

    def _resistance(self, x: Float[Array, "n 3"]) -> "Resistance":
        inverse = inverted(lax.stop_gradient(self.mobility(x)))
        return Resistance(self, x, inverse, jnp.ones(()))

    def prepare(self, rod: Rod, state: State, prediction: Prediction) -> "Resistance":
        """The resistance where the rod is expected to be."""
        return self._resistance(positions(rod.topology, prediction.configuration))

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: "Resistance") -> Quadratic:
        dofs = Indices(rod.topology.node_dofs(self.nodes).ravel())
        operator = replace(cache, time=stage.length)
        return Quadratic(dofs, self.symmetric, operator, stage.fluid_origin_from(state))


@pytree
class Resistance:
    """The drag of `StokesletSegments` on displacements that take some time.

    The inverse of the mobility A is computed once. Derivatives do not go through it, nor through
    A, but through A f = v: dv - dA f is solved for with the same inverse, and dA f found
    without dA.

    Attributes:
        segments: whose drag this is.
        x: (n, 3) m, the nodes.
        inverse: (3m, 3m) of the mobility, N s/m.
        time: s.
    """

    segments: StokesletSegments
    x: Float[Array, "n 3"]
    inverse: Float[Array, "3m 3m"]
    time: Float[Array, ""]

    def _felt(self, force: Array) -> Array:
        """The force on nodes that are dragged; on the others it is dropped."""
        felt = np.isin(self.segments.nodes, self.segments.dragged)
        if felt.all():
            return force
        of_each = np.repeat(felt.astype(float), 3)
        return jnp.asarray(of_each.reshape(-1, *([1] * (force.ndim - 1)))) * force

    @property
    def _averaged(self) -> bool:
        return self.segments.drag_matrix == "symmetric"

    def matrix(self) -> Float[Array, "3m 3m"]:
        r = self.inverse
        if self._averaged:
            r = 0.5 * (r + r.T)
        return self._felt(r) / self.time

    def mv(self, displacement: Float[Array, " 3m"]) -> Float[Array, " 3m"]:
        force = _solve(self.segments, self.x, self.inverse, displacement)
        if self._averaged:
            other = _solve_transposed(self.segments, self.x, self.inverse, displacement)
            force = 0.5 * (force + other)
        return self._felt(force) / self.time


def _solver(product: Callable[..., Array], apply: Callable[[Array, Array], Array]) -> Any:
    """b to the f for which `product` is b, with derivatives through the product."""

    @jax.custom_jvp
    def solve(segments: StokesletSegments, x: Array, inverse: Array, b: Array) -> Array:
        return apply(inverse, b)

    @partial(solve.defjvp, symbolic_zeros=True)
    def solve_jvp(primals, tangents):
        segments, x, inverse, _ = primals
        d_segments, d_x, _, d_b = tangents
        force = solve(*primals)
        _, d_flow = jvp_nonzero(lambda s, x: product(s, x, force), (segments, x), (d_segments, d_x))
        change = -d_flow if isinstance(d_b, SymbolicZero) else d_b - d_flow
        return force, solve(segments, x, inverse, change)

    return solve


_solve = _solver(StokesletSegments.product, lambda inverse, b: inverse @ b)
_solve_transposed = _solver(StokesletSegments.transposed_product, lambda inverse, b: b @ inverse)
