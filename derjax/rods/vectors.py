"""Vectors and rotations in three dimensions, differentiable wherever a rod can go.

Everything acts on the last axis and broadcasts over the others. Nothing here divides by a
quantity that vanishes for a straight rod, a rod at rest, or a frame that did not turn.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

Vector = Float[Array, "*batch 3"]
Scalar = Float[Array, "*batch"]


def dot(a: Vector, b: Vector) -> Scalar:
    """Inner product over the last axis, written out: faster than a tiny matrix product."""
    return jnp.sum(a * b, axis=-1)


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product over the last axis."""
    a1, a2, a3 = a[..., 0], a[..., 1], a[..., 2]
    b1, b2, b3 = b[..., 0], b[..., 1], b[..., 2]
    return jnp.stack([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1], axis=-1)


def norm(a: Vector) -> Scalar:
    """Euclidean length, with derivative zero (instead of NaN) at the zero vector."""
    squared = dot(a, a)
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)


def unit(a: Vector) -> Vector:
    """`a` divided by its length; `a` must not vanish."""
    return a / jnp.sqrt(dot(a, a))[..., None]


def parallel_transport(u: Vector, start: Vector, end: Vector) -> Vector:
    """`u` carried along by the smallest rotation that takes unit vector `start` to `end`.

    With b = start x end and c = start . end,

        u' = c u + b x u + b (b . u) / (1 + c),

    which is smooth also for start = end; only start = -end is singular.
    """
    b = cross(start, end)
    c = dot(start, end)
    return c[..., None] * u + cross(b, u) + b * (dot(b, u) / (1.0 + c))[..., None]


def holonomy(before: Vector, tangent: Vector) -> Vector:
    """The turn (rad) about `tangent`, per change of it, of a frame transported from `before`.

    A frame that is transported by the smallest rotation from the unit vector `before` to each
    place of a tangent that moves on turns by this, times the change of the unit vector `tangent`,
    against one that comes along without turning about it.
    """
    return cross(tangent, before) / (1.0 + dot(before, tangent))[..., None]


def signed_angle(u: Vector, v: Vector, axis: Vector) -> Scalar:
    """Angle in (-pi, pi] by which `u` turns about the unit vector `axis` to reach `v`."""
    return jnp.arctan2(dot(axis, cross(u, v)), dot(u, v))


def rotation_about(axis: Float[Array, " 3"], angle: Array | float) -> Float[Array, "3 3"]:
    """The matrix of a rotation by some angle (rad) about a unit vector (Rodrigues)."""
    across = cross(jnp.broadcast_to(axis, (3, 3)), jnp.eye(3)).T
    return jnp.eye(3) + jnp.sin(angle) * across + (1.0 - jnp.cos(angle)) * across @ across


def any_normal(t: Vector) -> Vector:
    """Some unit vector perpendicular to the unit vector `t`."""
    smallest = jnp.argmin(jnp.abs(t), axis=-1)
    axis = jnp.eye(3, dtype=t.dtype)[smallest]
    return unit(cross(t, axis))


def rotation(turn: Vector) -> Float[Array, "*batch 3 3"]:
    """The rotation by some angle about some axis, of length 2 tan(angle / 2) (Cayley)."""
    half = 0.5 * turn
    squared = dot(half, half)[..., None, None]
    across = cross(half[..., None, :], jnp.eye(3))
    across = jnp.swapaxes(across, -1, -2)
    return jnp.eye(3) + 2.0 / (1.0 + squared) * (across + across @ across)
