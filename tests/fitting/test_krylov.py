"""Linear equations by products only, with several right sides."""

import numpy as np
import pytest

from fitting.joint.krylov import solved

SIZE = 120


@pytest.fixture(scope="module")
def contraction() -> np.ndarray:
    """Of most directions hardly anything is left, as of what dies out in a turn."""
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(SIZE, SIZE)))[0]
    slow = np.concatenate([[0.97, -0.9, 0.6, 0.5], 0.3 * 0.5 ** np.arange(SIZE - 4)])
    return basis @ np.diag(slow) @ basis.T + 1e-3 * rng.normal(size=(SIZE, SIZE))


class Counted:
    """Products of rows, and two numbers of each."""

    def __init__(self, matrix: np.ndarray) -> None:
        self.matrix, self.count = matrix, 0

    def __call__(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.count += 1
        return rows @ self.matrix.T, rows[:, :2]


def test_solutions_are_those_of_the_matrix(contraction, rng) -> None:
    b = rng.normal(size=(3, SIZE)) * np.array([[1.0], [1e-6], [1e3]])
    exact = np.linalg.solve(np.eye(SIZE) - contraction, b.T).T
    z, other = solved(Counted(contraction), b, 1e-10)
    for found, right in zip(z, exact, strict=True):
        assert np.linalg.norm(found - right) < 1e-7 * np.linalg.norm(right)
    assert other == pytest.approx(z[:, :2], rel=1e-9, abs=1e-15)


def test_several_take_fewer_products_than_each_alone(contraction, rng) -> None:
    b = rng.normal(size=(4, SIZE))
    together, alone = Counted(contraction), Counted(contraction)
    solved(together, b, 1e-4)
    for row in b:
        solved(alone, row[None], 1e-4)
    assert together.count < alone.count / 4


def test_right_sides_that_are_the_same_or_zero(contraction, rng) -> None:
    row = rng.normal(size=SIZE)
    exact = np.linalg.solve(np.eye(SIZE) - contraction, row)
    z, _ = solved(Counted(contraction), np.stack([row, row, 0 * row]), 1e-10)
    assert z[0] == pytest.approx(exact, rel=1e-6)
    assert z[1] == pytest.approx(exact, rel=1e-6)
    assert not z[2].any()
    none, _ = solved(Counted(contraction), np.zeros((1, SIZE)), 1e-4)
    assert not none.any()
