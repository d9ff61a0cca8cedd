"""Linear systems known by products only."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

Vector = Float[Array, " n"]


def gmres(
    product: Callable[[Vector], Vector],
    b: Vector,
    tolerance: float,
    most: int,
    worst: float = float("inf"),
) -> Vector:
    """The x with |A x - b| below `tolerance` |b|, by the method of generalised minimal residuals.

    Saad & Schultz, SIAM J. Sci. Stat. Comput. 7, 856, 1986; without restarts, and with every
    direction made orthogonal to each before it, twice. Where it does not get there in `most`
    products, the best x that they give.

    Args:
        product: x to A x; stands in the program once.
        b: right-hand side.
        tolerance: dimensionless.
        most: products, and vectors that are kept.
        worst: of |A x - b| over |b|; where that is not reached either, x is NaN.
    """
    size = jnp.sqrt(b @ b)
    goal = tolerance * size

    def wanted(carry):
        count, _, _, left, _, _ = carry
        return (count < most) & (jnp.abs(left[count]) > goal)

    def extend(carry):
        count, basis, triangle, left, cosines, sines = carry

        # One by one: most systems need few of the directions that there is room for.
        def without(k, given):
            new, column = given
            part = basis[k] @ new
            return new - part * basis[k], column.at[k].add(part)

        given = product(basis[count]), jnp.zeros(most + 1)
        for _ in range(2):
            given = lax.fori_loop(0, count + 1, without, given)
        new, column = given
        length = jnp.sqrt(new @ new)
        column = column.at[count + 1].set(length)

        def rotate(k, column):
            c, s, a, b = cosines[k], sines[k], column[k], column[k + 1]
            return column.at[k].set(c * a + s * b).at[k + 1].set(c * b - s * a)

        column = lax.fori_loop(0, count, rotate, column)
        a, b = column[count], column[count + 1]
        both = jnp.maximum(jnp.hypot(a, b), jnp.finfo(b.dtype).tiny)
        c, s = a / both, b / both
        column = column.at[count].set(both).at[count + 1].set(0.0)
        rest = left[count]
        return (
            count + 1,
            basis.at[count + 1].set(new / jnp.maximum(length, jnp.finfo(b.dtype).tiny)),
            triangle.at[:, count].set(column[:-1]),
            left.at[count].set(c * rest).at[count + 1].set(-s * rest),
            cosines.at[count].set(c),
            sines.at[count].set(s),
        )

    first = b / jnp.where(size > 0.0, size, 1.0)
    start = (
        jnp.zeros((), jnp.int32),
        jnp.zeros((most + 1, b.size)).at[0].set(first),
        jnp.eye(most),
        jnp.zeros(most + 1).at[0].set(size),
        jnp.zeros(most),
        jnp.zeros(most),
    )
    count, basis, triangle, left, _, _ = lax.while_loop(wanted, extend, start)
    known = jnp.where(jnp.arange(most) < count, left[:-1], 0.0)
    weights = lax.linalg.triangular_solve(triangle, known[:, None], left_side=True)[:, 0]
    x = lax.fori_loop(0, count, lambda k, x: x + weights[k] * basis[k], jnp.zeros_like(b))
    return jnp.where(jnp.abs(left[count]) > worst * size, jnp.nan, x)
