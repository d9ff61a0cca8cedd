"""Linear equations whose matrix is known by its products only, for several right sides at once."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

Rows = Float[np.ndarray, "k n"]
Product = Callable[[Rows], tuple[Rows, Float[np.ndarray, "k g"]]]

MOST = 30
"""Products, after which what has been reached is taken."""


def solved(product: Product, b: Rows, tolerance: float) -> tuple[Rows, Float[np.ndarray, "k g"]]:
    """The z with z - M z = b, for all rows of b, by generalised conjugate residuals.

    All rows share one space, so that each has the directions of the others as well (block methods:
    O'Leary, Linear Algebra Appl. 29, 293, 1980), and a product of several rows hardly costs more
    than one of a single row.

    Args:
        product: of rows with M, and what else is linear in them, as (M z, g z).
        b: right sides.
        tolerance: of what is left of each row of b, as a part of it.

    Returns:
        z, and g z.
    """
    size = np.linalg.norm(b, axis=1)
    shape = b.shape[1]
    spaces, images, others = np.zeros((0, shape)), np.zeros((0, shape)), None
    weights, left = np.zeros((len(b), 0)), b
    for _ in range(MOST):
        if others is not None and np.all(np.linalg.norm(left, axis=1) <= tolerance * size):
            break
        rows = _orthonormal(left, spaces)
        moved, other = product(rows)
        spaces = np.concatenate([spaces, rows])
        images = np.concatenate([images, rows - moved])
        others = other if others is None else np.concatenate([others, other])
        weights = np.linalg.lstsq(images.T, b.T, rcond=1e-12)[0].T
        left = b - weights @ images
    assert others is not None
    return weights @ spaces, weights @ others


def _orthonormal(rows: Rows, others: Rows) -> Rows:
    """Rows of length 1, orthogonal to each other and to others; zero where nothing is left."""
    rows = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), np.finfo(float).tiny)
    for _ in range(2):  # once more against rounding
        rows = rows - rows @ others.T @ others
    q, r = np.linalg.qr(rows.T)
    return np.where(np.abs(np.diag(r))[:, None] > 1e-12, q.T, 0.0)
