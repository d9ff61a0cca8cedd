"""Slender filaments in Stokes flow: regularized Stokeslet segments.

The flow of a straight segment that carries a force density linear along it, each point force
spread by the blob 15 eps^4 / (8 pi (r^2 + eps^2)^(7/2)), is known in closed form (Cortez,
J. Comput. Phys. 375, 783, 2018). For a segment from y0 to y1 with v = y0 - y1, x0 = x - y0,
R(a)^2 = |x0 + a v|^2 + eps^2 and the moments T_mq = int_0^1 a^m R^-q da,

    8 pi mu u(x) = L (M1 f0 + M2 f1),
    M2 = (T11 + eps^2 T13) I + T13 x0 x0 + T23 (x0 v + v x0) + T33 v v,
    M1 = (T01 + eps^2 T03) I + T03 x0 x0 + T13 (x0 v + v x0) + T23 v v - M2.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from ...core.pytree import Indices, push, pytree, replace, static
from ...rods.kinematics import positions
from ...rods.rod import Rod, State
from ...solve.potential import Quadratic
from ..term import Prediction, Role, Stage, Term


class Moments(NamedTuple):
    """T_mq = int_0^1 a^m R(a)^-q da of a segment, in the units of R^-q."""

    t01: Array
    t03: Array
    t11: Array
    t13: Array
    t23: Array
    t33: Array


def moments(r0: Array, r1: Array, length_squared: Array, x0_v: Array) -> Moments:
    """The moments of a segment from R at its two ends, |v|^2 and x0 . v.

    T01 and T03 are written with R0 + R1 and R0 R1, which (unlike the textbook differences of
    logarithms and of inverses) keep their digits when x is in line with the segment; the
    others follow by integration by parts.
    """
    length = jnp.sqrt(length_squared)
    sum_, inverse0, inverse1 = r0 + r1, 1.0 / r0, 1.0 / r1
    t01 = 2.0 / length * jnp.arctanh(length / sum_)
    t03 = 2.0 * sum_ * inverse0 * inverse1 / ((sum_ - length) * (sum_ + length))
    t11 = (r1 - r0 - x0_v * t01) / length_squared
    t13 = (inverse0 - inverse1 - x0_v * t03) / length_squared
    t23 = (t01 - inverse1 - x0_v * t13) / length_squared
    t33 = (2.0 * t11 - inverse1 - x0_v * t23) / length_squared
    return Moments(t01, t03, t11, t13, t23, t33)


def segment_kernels(
    targets: Float[Array, "n 3"],
    starts: Float[Array, "s 3"],
    ends: Float[Array, "s 3"],
    regularization: Array,
) -> tuple[Float[Array, "3 3 n s"], Float[Array, "3 3 n s"]]:
    """The kernels M1 and M2 (1/m) of every segment at every target."""
    v, x0, t = _moments(
        targets.T[:, :, None], starts.T[:, None, :], ends.T[:, None, :], regularization
    )
    x0_x0, v_v = x0[:, None] * x0, v[:, None] * v
    x0_v_tensor = x0[:, None] * v + v[:, None] * x0
    identity = jnp.eye(3)[:, :, None, None]
    isotropic1 = t.t01 + regularization**2 * t.t03
    isotropic2 = t.t11 + regularization**2 * t.t13
    m2 = isotropic2 * identity + t.t13 * x0_x0 + t.t23 * x0_v_tensor + t.t33 * v_v
    m1 = isotropic1 * identity + t.t03 * x0_x0 + t.t13 * x0_v_tensor + t.t23 * v_v - m2
    return m1, m2


def segment_flow(
    targets: Float[Array, "n 3"],
    starts: Float[Array, "s 3"],
    ends: Float[Array, "s 3"],
    at_start: Float[Array, "s 3"],
    at_end: Float[Array, "s 3"],
    regularization: Array,
) -> Float[Array, "n 3"]:
    """`M1 f0 + M2 f1` summed over segments, in the units of f per m.

    The same as with the kernels, in a quarter of the operations.
    """
    v, x0, t = _moments(
        targets.T[:, :, None], starts.T[:, None, :], ends.T[:, None, :], regularization
    )
    f0, slope = at_start.T[:, None, :], (at_end - at_start).T[:, None, :]
    x0_f0, v_f0 = jnp.sum(x0 * f0, axis=0), jnp.sum(v * f0, axis=0)
    x0_slope, v_slope = jnp.sum(x0 * slope, axis=0), jnp.sum(v * slope, axis=0)
    isotropic1 = t.t01 + regularization**2 * t.t03
    isotropic2 = t.t11 + regularization**2 * t.t13
    along_x0 = t.t03 * x0_f0 + t.t13 * (v_f0 + x0_slope) + t.t23 * v_slope
    along_v = t.t13 * x0_f0 + t.t23 * (v_f0 + x0_slope) + t.t33 * v_slope
    flow = isotropic1 * f0 + isotropic2 * slope + along_x0 * x0 + along_v * v
    return jnp.sum(flow, axis=-1).T


def segment_pull(
    targets: Float[Array, "n 3"],
    starts: Float[Array, "s 3"],
    ends: Float[Array, "s 3"],
    at_targets: Float[Array, "n 3"],
    regularization: Array,
) -> tuple[Float[Array, "s 3"], Float[Array, "s 3"]]:
    """The transpose of `segment_flow`: `M1 g` and `M2 g` summed over targets."""
    # Segments by targets, as sums along the last axis are quicker.
    v, x0, t = _moments(
        targets.T[:, None, :], starts.T[:, :, None], ends.T[:, :, None], regularization
    )
    g = at_targets.T[:, None, :]
    x0_g, v_g = jnp.sum(x0 * g, axis=0), jnp.sum(v * g, axis=0)
    isotropic1 = t.t01 + regularization**2 * t.t03
    isotropic2 = t.t11 + regularization**2 * t.t13
    both = (
        isotropic1 * g + (t.t03 * x0_g + t.t13 * v_g) * x0 + (t.t13 * x0_g + t.t23 * v_g) * v,
        isotropic2 * g + (t.t13 * x0_g + t.t23 * v_g) * x0 + (t.t23 * x0_g + t.t33 * v_g) * v,
    )
    first, second = (jnp.sum(part, axis=-1).T for part in both)
    return first - second, second


def _moments(
    targets: Float[Array, "3 *#p"],
    starts: Float[Array, "3 *#p"],
    ends: Float[Array, "3 *#p"],
    regularization: Array,
) -> tuple[Float[Array, "3 *#p"], Float[Array, "3 *#p"], Moments]:
    """v, x0 and the moments of pairs of a segment and a target."""
    v, x0 = starts - ends, targets - starts
    length_squared = jnp.sum(v * v, axis=0)
    x0_v = jnp.sum(x0 * v, axis=0)
    squared = jnp.sum(x0 * x0, axis=0) + regularization**2
    r0 = jnp.sqrt(squared)
    r1 = jnp.sqrt(squared + 2.0 * x0_v + length_squared)
    return v, x0, moments(r0, r1, length_squared, x0_v)


def _by_node(starts: Float[Array, "*b s"], ends: Float[Array, "*b s"]) -> Float[Array, "*b n"]:
    """Sums over the segments of a filament what belongs to the nodes they start and end at."""
    rest = ((0, 0),) * (starts.ndim - 1)
    return jnp.pad(starts, (*rest, (0, 1))) + jnp.pad(ends, (*rest, (1, 0)))


def mobility(
    filaments: tuple[Float[Array, "_ 3"], ...],
    viscosity: Array,
    regularization: Array,
    end_nodes: str,
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
    """
    targets = jnp.concatenate(filaments)
    columns = []
    for nodes in filaments:
        m1, m2 = segment_kernels(targets, nodes[:-1], nodes[1:], regularization)
        if end_nodes == "half":
            length = _lengths(nodes)
            columns.append(_by_node(length * m1, length * m2) / _by_node(length / 2, length / 2))
        else:
            columns.append(_by_node(m1, m2))
    matrix = jnp.concatenate(columns, axis=-1) / (8.0 * jnp.pi * viscosity)
    size = 3 * targets.shape[0]
    return matrix.transpose(2, 0, 3, 1).reshape(size, size)


def flow(
    filaments: tuple[Float[Array, "_ 3"], ...],
    forces: Float[Array, "m 3"],
    viscosity: Array,
    regularization: Array,
    end_nodes: str,
) -> Float[Array, "m 3"]:
    """The product of `mobility` with forces (N) on all nodes: their velocities (m/s)."""
    targets, total, place = jnp.concatenate(filaments), jnp.zeros_like(forces), 0
    for nodes in filaments:
        density = forces[place : place + len(nodes)]
        place += len(nodes)
        if end_nodes == "half":
            length = _lengths(nodes)
            density = density / _by_node(length / 2, length / 2)[:, None]
            at_start, at_end = length[:, None] * density[:-1], length[:, None] * density[1:]
        else:
            at_start, at_end = density[:-1], density[1:]
        total += segment_flow(targets, nodes[:-1], nodes[1:], at_start, at_end, regularization)
    return total / (8.0 * jnp.pi * viscosity)


def pull(
    filaments: tuple[Float[Array, "_ 3"], ...],
    vectors: Float[Array, "m 3"],
    viscosity: Array,
    regularization: Array,
    end_nodes: str,
) -> Float[Array, "m 3"]:
    """The product of the transpose of `mobility` with a vector for every node."""
    targets, parts = jnp.concatenate(filaments), []
    for nodes in filaments:
        first, second = segment_pull(targets, nodes[:-1], nodes[1:], vectors, regularization)
        if end_nodes == "half":
            length = _lengths(nodes)
            part = _by_node(length * first.T, length * second.T)
            parts.append((part / _by_node(length / 2, length / 2)).T)
        else:
            parts.append(_by_node(first.T, second.T).T)
    return jnp.concatenate(parts) / (8.0 * jnp.pi * viscosity)


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
    """

    role: ClassVar[Role] = Role.DRAG

    viscosity: Float[Array, ""]
    regularization: Float[Array, ""]
    solved: tuple[tuple[int, ...], ...] = static()
    dragged: tuple[int, ...] = static()
    end_nodes: str = static(default="half")
    drag_matrix: str = static(default="symmetric")

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
        filaments = tuple(x[np.array(path)] for path in self.solved)
        a = mobility(filaments, self.viscosity, self.regularization, self.end_nodes)
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
        filaments = tuple(x[np.array(path)] for path in self.solved)
        fluid = self.viscosity, self.regularization, self.end_nodes
        return map_(filaments, vector.reshape(-1, 3), *fluid).ravel()

    def resistance(self, x: Float[Array, "n 3"]) -> Float[Array, "3m 3m"]:
        """Matrix (N s/m) that takes velocities of the solved nodes to the drag on them."""
        return self._resistance(x).matrix()

    def _resistance(self, x: Float[Array, "n 3"]) -> "Resistance":
        inverse = jnp.linalg.inv(lax.stop_gradient(self.mobility(x)))
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

    def apply(self, displacement: Float[Array, " 3m"]) -> Float[Array, " 3m"]:
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
        _, d_flow = push(lambda s, x: product(s, x, force), (segments, x), (d_segments, d_x))
        change = -d_flow if isinstance(d_b, SymbolicZero) else d_b - d_flow
        return force, solve(segments, x, inverse, change)

    return solve


_solve = _solver(StokesletSegments.product, lambda inverse, b: inverse @ b)
_solve_transposed = _solver(StokesletSegments.transposed_product, lambda inverse, b: b @ inverse)
