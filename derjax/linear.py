"""Direct solution of the Newton systems: factor once, solve for many right-hand sides."""

from typing import Protocol

import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import cho_solve, lu_factor, lu_solve
from jaxtyping import Array, Float

from .pytree import pytree

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


def sizes(diagonal: Array) -> Array:
    """What is added to a diagonal, times more and more, for its matrix to be positive definite."""
    size = jnp.abs(diagonal)
    return jnp.where(size > 0.0, size, jnp.mean(size))


def factor(matrix: Matrix, symmetric: bool) -> Factor:
    """Factor a Newton matrix.

    Away from a minimum a symmetric matrix may be indefinite; then a growing multiple of its own
    diagonal is added until it is positive definite, which makes the Newton step a descent
    direction. At a stable solution nothing is added. Every degree of freedom having a share of its
    own, it does not matter in which units positions and angles are.
    """
    if not symmetric:
        return LU(*lu_factor(matrix))
    size = sizes(jnp.diagonal(matrix))

    def retry(carry):
        lower, shift = carry
        del lower
        shift = jnp.where(shift == 0.0, 1e-8, 10.0 * shift)
        return lax.linalg.cholesky(matrix + shift * jnp.diag(size)), shift

    def indefinite(carry):
        lower, shift = carry
        return jnp.isnan(lower[-1, -1]) & (shift < 1e4)

    lower = lax.linalg.cholesky(matrix, symmetrize_input=False)
    return Cholesky(lax.while_loop(indefinite, retry, (lower, jnp.zeros(())))[0])
