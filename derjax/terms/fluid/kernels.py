"""Closed forms of flows in free space: of a straight segment and of a point.

The flow of a straight segment that carries a force density linear along it, each point force
spread by the blob 15 eps^4 / (8 pi (r^2 + eps^2)^(7/2)), is known in closed form (Cortez,
J. Comput. Phys. 375, 783, 2018). For a segment from y0 to y1 with v = y0 - y1, x0 = x - y0,
R(a)^2 = |x0 + a v|^2 + eps^2 and the moments T_mq = int_0^1 a^m R^-q da,

    8 pi mu u(x) = L (M1 f0 + M2 f1),
    M2 = (T11 + eps^2 T13) I + T13 x0 x0 + T23 (x0 v + v x0) + T33 v v,
    M1 = (T01 + eps^2 T03) I + T03 x0 x0 + T13 (x0 v + v x0) + T23 v v - M2.

That of a point with the same blob is (Cortez, Fauci & Medovikov, Phys. Fluids 17, 031504, 2005)

    8 pi mu u = ((r^2 + 2 eps^2) f + (f . r) r) / (r^2 + eps^2)^(3/2).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

Components = tuple[tuple[Array, Array, Array], ...]
"""The 3 x 3 components of a tensor, each an array of its own: as one array they would take twice
the time, and those of a symmetric one are found once."""


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
) -> tuple[Components, Components]:
    """The kernels M1 and M2 (1/m), symmetric, of every segment at every target: each (n, s)."""
    v, x0, t = _moments(
        targets.T[:, :, None], starts.T[:, None, :], ends.T[:, None, :], regularization
    )
    isotropic1 = t.t01 + regularization**2 * t.t03
    isotropic2 = t.t11 + regularization**2 * t.t13

    def both(i: int, j: int) -> tuple[Array, Array]:
        xx, xv, vv = x0[i] * x0[j], x0[i] * v[j] + v[i] * x0[j], v[i] * v[j]
        m1 = t.t03 * xx + t.t13 * xv + t.t23 * vv
        m2 = t.t13 * xx + t.t23 * xv + t.t33 * vv
        if i == j:
            m1, m2 = m1 + isotropic1, m2 + isotropic2
        return m1 - m2, m2

    xx, xy, xz, yy, yz, zz = (both(i, j) for i in range(3) for j in range(i, 3))
    m1, m2 = (
        ((xx[k], xy[k], xz[k]), (xy[k], yy[k], yz[k]), (xz[k], yz[k], zz[k])) for k in range(2)
    )
    return m1, m2


def joined(components: Components) -> Float[Array, "3n 3m"]:
    """One matrix, with the component (n, m) of row i and column j at rows 3 a + i and columns
    3 b + j."""
    rows = jnp.stack([jnp.stack(row, axis=-1) for row in components], axis=1)
    n, _, m, _ = rows.shape
    return rows.reshape(3 * n, 3 * m)


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


def point_flow(
    targets: Float[Array, "n 3"],
    sources: Float[Array, "p 3"],
    forces: Float[Array, "p 3"],
    regularization: Array,
) -> Float[Array, "n 3"]:
    """The flow of point forces (N) at `sources` (m), summed: 8 pi mu u, N/m.

    All sums are matrix products, also those in r^2 = x^2 - 2 x . y + y^2 and f . r = f . x - f . y.
    What cancels there costs digits where a target is close to a source, in proportion to the
    square of how far both are from the first source: see to those with segments.
    """
    origin, eps2 = lax.stop_gradient(sources[0]), regularization**2
    targets, sources = targets - origin, sources - origin
    squares, work = jnp.sum(sources * sources, axis=1), jnp.sum(forces * sources, axis=1)
    extended = jnp.pad(sources, ((0, 0), (0, 1)), constant_values=1.0)
    own = jnp.sum(targets * targets, axis=1)
    noise_floor = own[:, None] - 2.0 * targets @ sources.T + (squares + eps2)
    noise_floor = jnp.maximum(noise_floor, eps2)
    cubed = 1.0 / (noise_floor * jnp.sqrt(noise_floor))
    pulled = ((targets @ forces.T - work) * cubed) @ extended
    return ((noise_floor + eps2) * cubed) @ forces + pulled[:, 3:] * targets - pulled[:, :3]
