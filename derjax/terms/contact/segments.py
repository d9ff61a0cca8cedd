"""Distances between straight segments, differentiable wherever two rods can meet.

A pair of segments is an array (4, 3): start and end of the first, start and end of the second.
The points on them are x(s) and y(t), with s and t from 0 to 1.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ...rods.vectors import dot, norm

Pair = Float[Array, "*b 4 3"]
Scalar = Float[Array, "*b"]


class _Quadratic(NamedTuple):
    """1/2 |x(s) - y(t)|^2 = 1/2 (a s^2 + c t^2) - b s t + d s - e t + constant."""

    a: Scalar
    b: Scalar
    c: Scalar
    d: Scalar
    e: Scalar


def _quadratic(pair: Pair) -> _Quadratic:
    x0, x1, y0, y1 = (pair[..., i, :] for i in range(4))
    u, v, r = x1 - x0, y1 - y0, x0 - y0
    return _Quadratic(dot(u, u), dot(u, v), dot(v, v), dot(u, r), dot(v, r))


def _quotient(a: Scalar, b: Scalar) -> Scalar:
    """a / b, and zero (with derivative zero) where b vanishes."""
    positive = b > 0.0
    return jnp.where(positive, a / jnp.where(positive, b, 1.0), 0.0)


def _least_on_square(f: _Quadratic) -> tuple[Scalar, Scalar]:
    """Where in the unit square a convex quadratic function is least.

    That is inside, or on one of the four sides; on each of these it is known.
    """
    a, b, c, d, e = f
    determinant = a * c - b * b
    zero, one = jnp.zeros_like(a), jnp.ones_like(a)
    s = jnp.stack(
        [_quotient(b * e - c * d, determinant), zero, one, _quotient(-d, a), _quotient(b - d, a)]
    )
    # Inside, t is best for the s that was found, so that nearly parallel segments may cross.
    t = jnp.stack([_quotient(e + b * s[0], c), _quotient(e, c), _quotient(e + b, c), zero, one])
    inside = (determinant > 0.0) & (s[0] >= 0.0) & (s[0] <= 1.0) & (t[0] >= 0.0) & (t[0] <= 1.0)
    s, t = jnp.clip(s, 0.0, 1.0), jnp.clip(t, 0.0, 1.0)
    value = 0.5 * (a * s * s + c * t * t) - b * s * t + d * s - e * t
    value = value.at[0].set(jnp.where(inside, -jnp.inf, jnp.inf))
    best = jnp.argmin(value, axis=0)[None]
    return jnp.take_along_axis(s, best, 0)[0], jnp.take_along_axis(t, best, 0)[0]


def closest(pair: Pair) -> tuple[Scalar, Scalar]:
    """Where two segments are closest: (s, t); any such place if there are several."""
    return _least_on_square(_quadratic(pair))


def between(pair: Pair, s: Scalar, t: Scalar) -> Float[Array, "*b 3"]:
    """The vector x(s) - y(t)."""
    x0, x1, y0, y1 = (pair[..., i, :] for i in range(4))
    s, t = s[..., None], t[..., None]
    return (1.0 - s) * x0 + s * x1 - (1.0 - t) * y0 - t * y1


@jax.custom_jvp
def distance(pair: Pair) -> Scalar:
    """Exact distance of two segments; not smooth where the closest points are not unique."""
    return norm(between(pair, *closest(pair)))


@distance.defjvp
def _distance_jvp(primals: tuple[Pair], tangents: tuple[Pair]) -> tuple[Scalar, Scalar]:
    """That the closest points move changes the distance to second order only.

    Left to the chain rule, points of nearly parallel segments, which move very far, would
    make a first order of their rounding.
    """
    (pair,), (dpair,) = primals, tangents
    s, t = closest(pair)
    gap = between(pair, s, t)
    apart = norm(gap)
    return apart, _quotient(dot(gap, between(dpair, s, t)), apart)


class Near(NamedTuple):
    """Two segments as a smooth contact sees them.

    Attributes:
        squared: squared softened distance.
        gap: (3,) vector between the near points.
        s, t: where they are, strictly between 0 and 1.
    """

    squared: Scalar
    gap: Float[Array, "*b 3"]
    s: Scalar
    t: Scalar


def barrier(a: Scalar) -> Scalar:
    """1 - 2 sqrt(a (1 - a)): from 0 in the middle of a segment to 1, infinitely steep, at its ends.

    Having an infinite slope it keeps points off the ends; being finite it adds no more than
    the squared softness for each of them.
    """
    return 1.0 - 2.0 * jnp.sqrt(a * (1.0 - a))


def _barrier_slope(a: Scalar) -> Scalar:
    return (2.0 * a - 1.0) / jnp.sqrt(a * (1.0 - a))


def barrier_curvature(a: Scalar) -> Scalar:
    """Second derivative of `barrier`."""
    b = a * (1.0 - a)
    return 0.5 / (b * jnp.sqrt(b))  # a power takes ten times as long


def near(pair: Float[Array, "4 3"], softness: Array) -> Near:
    """The softened distance of two segments,

        D = min over s, t of |x(s) - y(t)|^2 + softness^2 (barrier(s) + barrier(t)).

    The minimum is unique, parallel segments included, so that D and the points are infinitely
    differentiable. D exceeds the squared distance, by at most twice the squared softness (m).
    """
    s, t = _near_points(pair, softness)
    gap = between(pair, s, t)
    return Near(dot(gap, gap) + softness**2 * (barrier(s) + barrier(t)), gap, s, t)


NEWTON_STEPS = 10
"""Of the search for the near points: enough for round-off, from where it starts."""


@jax.custom_jvp
def _near_points(pair: Float[Array, "4 3"], softness: Array) -> tuple[Array, Array]:
    """The minimum of `near`: Newton's method, which never goes all the way to an end."""
    a, b, c, d, e = _quadratic(pair)
    weight, tiny = 0.5 * softness**2, jnp.finfo(pair.dtype).eps
    # Start with a barrier that is quadratic, of the same curvature in the middle ...
    k = 4.0 * weight
    s, t = _least_on_square(_Quadratic(a + k, b, c + k, d - 0.5 * k, e + 0.5 * k))

    def inner(p):
        """Where the barrier is finite, also next to an end of segments that are very long."""
        return jnp.clip(p, tiny**2, 1.0 - tiny)

    def off_the_ends(p, slope):
        """... and where that is not enough, where the true one balances the slope alone."""
        g = jnp.abs(slope) / weight
        inset = 2.0 / ((g**2 + 4.0) * (1.0 + g / jnp.sqrt(g**2 + 4.0)))
        return inner(jnp.clip(p, inset, 1.0 - inset))

    def room(p, dp):
        """The part of a step that may be gone: all of it, or most of the way to the end."""
        left = jnp.where(dp > 0.0, p, 1.0 - p)
        return jnp.where(jnp.abs(dp) < left, 1.0, 0.9 * left / jnp.abs(dp))

    def step(_, st):
        s, t = st
        g0 = a * s - b * t + d + weight * _barrier_slope(s)
        g1 = c * t - b * s - e + weight * _barrier_slope(t)
        ds, dt = _solve(a, b, c, weight, s, t, g0, g1)
        return inner(s - room(s, ds) * ds), inner(t - room(t, dt) * dt)

    start = off_the_ends(s, a * s - b * t + d), off_the_ends(t, c * t - b * s - e)
    return lax.fori_loop(0, NEWTON_STEPS, step, start)


def _solve(a, b, c, weight, s, t, g0, g1):
    """The Newton step of the search for the near points, from its gradient."""
    h00, h11 = a + weight * barrier_curvature(s), c + weight * barrier_curvature(t)
    determinant = h00 * h11 - b * b
    return (h11 * g0 + b * g1) / determinant, (b * g0 + h00 * g1) / determinant


@_near_points.defjvp
def _near_points_jvp(primals, tangents):
    pair, softness = primals
    s, t = _near_points(pair, softness)

    def slope(pair, softness):
        a, b, c, d, e = _quadratic(pair)
        weight = 0.5 * softness**2
        return (
            a * s - b * t + d + weight * _barrier_slope(s),
            c * t - b * s - e + weight * _barrier_slope(t),
        )

    _, (g0, g1) = jax.jvp(slope, primals, tangents)
    a, b, c, _, _ = _quadratic(pair)
    ds, dt = _solve(a, b, c, 0.5 * softness**2, s, t, g0, g1)
    return (s, t), (-ds, -dt)
