"""Slender filaments in Stokes flow: regularized Stokeslet segments.

The flow of a straight segment that carries a force density linear along it, each point force
spread by the blob 15 eps^4 / (8 pi (r^2 + eps^2)^(7/2)), is known in closed form (Cortez,
J. Comput. Phys. 375, 783, 2018). For a segment from y0 to y1 with v = y0 - y1, x0 = x - y0,
R(a)^2 = |x0 + a v|^2 + eps^2 and the moments T_mq = int_0^1 a^m R^-q da,

    8 pi mu u(x) = L (M1 f0 + M2 f1),
    M2 = (T11 + eps^2 T13) I + T13 x0 x0 + T23 (x0 v + v x0) + T33 v v,
    M1 = (T01 + eps^2 T03) I + T03 x0 x0 + T13 (x0 v + v x0) + T23 v v - M2.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..potential import Quadratic
from ..pytree import Indices, pytree, replace, static
from ..rod import Rod, State, positions
from .term import Interval, Outlook, Term


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
    v = (starts - ends).T[:, None, :]
    x0 = targets.T[:, :, None] - starts.T[:, None, :]
    length_squared = jnp.sum(v * v, axis=0)
    x0_v = jnp.sum(x0 * v, axis=0)
    squared = jnp.sum(x0 * x0, axis=0) + regularization**2
    r0 = jnp.sqrt(squared)
    r1 = jnp.sqrt(squared + 2.0 * x0_v + length_squared)
    t = moments(r0, r1, length_squared, x0_v)
    x0_x0, v_v = x0[:, None] * x0, v[:, None] * v
    x0_v_tensor = x0[:, None] * v + v[:, None] * x0
    identity = jnp.eye(3)[:, :, None, None]
    isotropic1 = t.t01 + regularization**2 * t.t03
    isotropic2 = t.t11 + regularization**2 * t.t13
    m2 = isotropic2 * identity + t.t13 * x0_x0 + t.t23 * x0_v_tensor + t.t33 * v_v
    m1 = isotropic1 * identity + t.t03 * x0_x0 + t.t13 * x0_v_tensor + t.t23 * v_v - m2
    return m1, m2


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
            edge = nodes[1:] - nodes[:-1]
            length = jnp.sqrt(jnp.sum(edge * edge, axis=1))
            columns.append(_by_node(length * m1, length * m2) / _by_node(length / 2, length / 2))
        else:
            columns.append(_by_node(m1, m2))
    matrix = jnp.concatenate(columns, axis=-1) / (8.0 * jnp.pi * viscosity)
    size = 3 * targets.shape[0]
    return matrix.transpose(2, 0, 3, 1).reshape(size, size)


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

    def resistance(self, x: Float[Array, "n 3"]) -> Float[Array, "3m 3m"]:
        """Matrix (N s/m) that takes velocities of the solved nodes to the drag on them."""
        return self._resistance(x).matrix()

    def _resistance(self, x: Float[Array, "n 3"]) -> "Resistance":
        mobility = self.mobility(x)
        inverse = lax.stop_gradient(jnp.linalg.inv(mobility))
        acts = tuple(node in self.dragged for node in self.nodes.tolist())
        average = self.drag_matrix == "symmetric"
        return Resistance(mobility, inverse, jnp.ones(()), acts, average)

    def prepared(self, rod: Rod, state: State, outlook: Outlook) -> "SettledDrag":
        x = positions(rod.topology, outlook.configuration)
        dofs = Indices(rod.topology.node_dofs(self.nodes).ravel())
        return SettledDrag(self._resistance(x), dofs, self.symmetric)

    def contribution(self, rod: Rod, state: State, interval: Interval) -> Quadratic:
        here = Outlook(state.q, jnp.zeros_like(state.q))
        return self.prepared(rod, state, here).contribution(rod, state, interval)


@pytree
class SettledDrag(Term):
    """The drag of `StokesletSegments` at the configuration of one step.

    Attributes:
        resistance: N s/m.
        dofs: (3m,) on which it acts.
        symmetric: whether it derives from a potential.
    """

    resistance: "Resistance"
    dofs: Indices = static()
    symmetric: bool = static()

    def contribution(self, rod: Rod, state: State, interval: Interval) -> Quadratic:
        operator = replace(self.resistance, time=interval.length)
        return Quadratic(self.dofs, self.symmetric, operator, interval.origin_from(state))


@pytree
class Resistance:
    """The drag of `StokesletSegments` on displacements that take some time.

    The inverse of the mobility is computed once. Derivatives do not go through it, but
    through A f = v: dv - dA f is solved for with the same inverse.

    Attributes:
        mobility: (3m, 3m) A, m/(N s).
        inverse: (3m, 3m) of the mobility, N s/m.
        time: s.
        acts: for each of the m nodes, whether it feels the force; on the others it is dropped.
        average: whether to take the symmetric part of the inverse.
    """

    mobility: Float[Array, "3m 3m"]
    inverse: Float[Array, "3m 3m"]
    time: Float[Array, ""]
    acts: tuple[bool, ...] = static()
    average: bool = static()

    def _felt(self, force: Array) -> Array:
        if all(self.acts):
            return force
        felt = np.repeat(np.array(self.acts, dtype=float), 3)
        return jnp.asarray(felt.reshape(-1, *([1] * (force.ndim - 1)))) * force

    def matrix(self) -> Float[Array, "3m 3m"]:
        r = self.inverse
        if self.average:
            r = 0.5 * (r + r.T)
        return self._felt(r) / self.time

    def apply(self, displacement: Float[Array, " 3m"]) -> Float[Array, " 3m"]:
        force = _solve(self.mobility, self.inverse, displacement)
        if self.average:
            force = 0.5 * (force + _solve(self.mobility.T, self.inverse.T, displacement))
        return self._felt(force) / self.time


@jax.custom_jvp
def _solve(a: Array, inverse: Array, b: Array) -> Float[Array, " 3m"]:
    """A^-1 b."""
    return inverse @ b


@_solve.defjvp
def _solve_jvp(primals, tangents):
    a, inverse, b = primals
    d_a, _, d_b = tangents
    force = _solve(a, inverse, b)
    return force, _solve(a, inverse, d_b - d_a @ force)
