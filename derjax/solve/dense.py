"""Direct solution of the Newton systems: factor once, solve for many right-hand sides."""

from collections.abc import Callable
from typing import Protocol

import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import cho_solve, lu_factor, lu_solve, solve_triangular
from jaxtyping import Array, Bool, Float

from ..core.pytree import pytree

Matrix = Float[Array, "d d"]
Rhs = Float[Array, "d *k"]


class Factor(Protocol):
    """A factored matrix."""

    def solve(self, b: Rhs) -> Rhs:
        """Solution x of A x = b."""
        ...

    def solve_transposed(self, b: Rhs) -> Rhs:
        """Solution x of A^T x = b."""
        ...


@pytree
class Cholesky:
    """A = L L^T."""

    lower: Matrix

    def solve(self, b: Rhs) -> Rhs:
        return cho_solve((self.lower, True), b)

    def solve_transposed(self, b: Rhs) -> Rhs:
        return self.solve(b)


@pytree
class LU:
    """P A = L U."""

    lu: Matrix
    pivots: Array

    def solve(self, b: Rhs) -> Rhs:
        return lu_solve((self.lu, self.pivots), b)

    def solve_transposed(self, b: Rhs) -> Rhs:
        return lu_solve((self.lu, self.pivots), b, trans=1)


@pytree
class Triangles:
    """P A = L U, with any diagonals: also what a Cholesky factor is."""

    lower: Matrix
    upper: Matrix
    order: Array

    def solve(self, b: Rhs) -> Rhs:
        y = solve_triangular(self.lower, b[self.order], lower=True)
        return solve_triangular(self.upper, y)

    def solve_transposed(self, b: Rhs) -> Rhs:
        y = solve_triangular(self.upper, b, trans=1)
        y = solve_triangular(self.lower, y, lower=True, trans=1)
        return jnp.zeros_like(y).at[self.order].set(y)


LEAF = 48
"""Rows of a matrix that is inverted by LU."""


def inverse(matrix: Matrix) -> Matrix:
    """The inverse of a matrix whose symmetric part is positive definite, as that of a mobility is.

    By halves (Strassen, Numer. Math. 13, 354, 1969), which is nearly all products of matrices: two
    to three times as quick as triangular solutions for all columns of the identity. No rows need
    to change places, as the symmetric parts of leading blocks and of what is left after their
    elimination are positive definite as well.
    """
    size = matrix.shape[0]
    if size <= LEAF:
        return jnp.linalg.inv(matrix)
    half = size // 2
    upper = inverse(matrix[:half, :half])
    across, down = upper @ matrix[:half, half:], matrix[half:, :half] @ upper
    lower = inverse(matrix[half:, half:] - matrix[half:, :half] @ across)
    corner, left = -across @ lower, -lower @ down
    return jnp.block([[upper - across @ left, corner], [left, lower]])


def ridge(diagonal: Array, unit: Array) -> Array:
    """What is added to a diagonal, times more and more, for its matrix to be positive definite.

    Its mean in units of force and torque, so that it does not matter in which units positions and
    angles are. It is alike for all positions: in proportion to the entries themselves it would
    hold back what is stiff for what is soft.

    Args:
        diagonal: of a Newton matrix.
        unit: N and N m, of each degree of freedom; zero for those that are not free.
    """
    weight = unit**2
    free = weight > 0.0
    share = jnp.where(free, jnp.abs(diagonal) / jnp.where(free, weight, 1.0), 0.0)
    return weight * jnp.sum(share) / jnp.maximum(jnp.sum(free), 1)


def _held(matrix: Matrix, idle: Bool[Array, " d"]) -> Matrix:
    """The matrix with ones for degrees of freedom that nothing acts on: they stay where they are.

    The angles of rods that do not resist twist are such.
    """
    return matrix + jnp.diag(idle.astype(matrix.dtype))


def factor(matrix: Matrix, symmetric: bool, unit: Array) -> Factor:
    """Factor a Newton matrix for the iteration.

    Away from a minimum a symmetric matrix may be indefinite; then a growing multiple of its
    `ridge` is added until it is positive definite, which makes the Newton step a descent
    direction. At a stable solution nothing is added.
    """
    if not symmetric:
        return LU(*lu_factor(matrix))
    return _definite(matrix, unit, None)[0]


def factor_or_with(
    matrix: Matrix, unit: Array, more: Callable[[], Matrix]
) -> tuple[Factor, Bool[Array, ""]]:
    """Factor a symmetric matrix, or its sum with another where it is not positive definite.

    Args:
        matrix: to factor.
        unit: N and N m, of each degree of freedom.
        more: gives the other matrix, to which a multiple of the `ridge` may be added as well.

    Returns:
        The factor, and whether it is that of the matrix alone.
    """
    found, shift = _definite(matrix, unit, more)
    return found, shift < 0.0


def _definite(
    matrix: Matrix, unit: Array, more: Callable[[], Matrix] | None
) -> tuple[Cholesky, Array]:
    """The factor of a matrix made positive definite, and how many ridges were added to it: -1 if
    it is as it was, without what there may be more."""
    # What follows from the diagonal alone: every look at a whole matrix takes as long as a tenth of
    # its factor. Where it is positive, a zero on the diagonal is in a row of zeros.
    diagonal = jnp.diagonal(matrix)
    added = ridge(diagonal, unit)
    matrix = _held(matrix, diagonal == 0.0)

    def retry(carry):
        _, shift = carry
        least = 1e-8 if more is None else jnp.where(shift < 0.0, 0.0, 1e-8)
        shift = jnp.where(shift <= 0.0, least, 10.0 * shift)
        whole = matrix if more is None else matrix + more()
        return lax.linalg.cholesky(whole + jnp.diag(shift * added)), shift

    def indefinite(carry):
        lower, shift = carry
        return jnp.isnan(lower[-1, -1]) & (shift < 1e4)

    lower = lax.linalg.cholesky(matrix, symmetrize_input=False)
    lower, shift = lax.while_loop(indefinite, retry, (lower, jnp.array(-1.0)))
    return Cholesky(lower), shift


def factor_as_it_is(matrix: Matrix, symmetric: bool) -> Factor:
    """Factor a Newton matrix for derivatives, to which nothing may be added.

    That of an equilibrium which is not stable is indefinite, and its derivatives are none the less
    those of the implicit function theorem.
    """
    if not symmetric:
        return LU(*lu_factor(matrix))
    matrix = _held(matrix, ~jnp.any(matrix != 0.0, axis=1))
    lower = lax.linalg.cholesky(matrix, symmetrize_input=False)
    in_order = jnp.arange(len(matrix))

    def definite() -> Triangles:
        return Triangles(lower, lower.T, in_order)

    def indefinite() -> Triangles:
        both, _, order = lax.linalg.lu(matrix)
        unit_lower = jnp.tril(both, -1) + jnp.eye(len(matrix))
        return Triangles(unit_lower, jnp.triu(both), order.astype(in_order.dtype))

    return lax.cond(jnp.isnan(lower[-1, -1]), indefinite, definite)
