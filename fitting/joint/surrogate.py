"""What a simulation gives, as a polynomial of the parameters around the best fit.

A posterior asks for a model thousands of times. Gaits, and tracks from rest, are smooth in the
parameters, and over the few standard errors that matter a polynomial of second degree, made of
values and exact derivatives at a few points, is as good as they are. How good is found out at other
points; where it is not, this says so instead of giving a posterior of something else.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from derjax import SolverError

from .fit import Solved
from .parts import Point

REACH = 4.0
"""Standard errors to each side within which the polynomial is made."""

GOOD = 0.2
"""Error of a prediction, in units of the noise as it counts, that changes no posterior."""


@dataclass(frozen=True)
class Polynomial:
    """Outputs of a simulation by its numbers.

    Attributes:
        places: (k,) of its numbers among all unknowns.
        centre, scale: (k,) of these, in free numbers.
        coefficients: (b, g) of 1, all numbers, and all products of two.
    """

    places: tuple[int, ...]
    centre: Float[np.ndarray, " k"]
    scale: Float[np.ndarray, " k"]
    coefficients: Float[np.ndarray, "b g"]

    def __call__(self, free: Float[Array, " p"]) -> Float[Array, " g"]:
        """The outputs at free numbers of all unknowns."""
        u = (free[np.array(self.places, int)] - self.centre) / self.scale
        return basis(u) @ self.coefficients


def basis(u: Array) -> Array:
    """1, all numbers, and all products of two."""
    k = u.shape[0]
    one, two = np.triu_indices(k)
    return jnp.concatenate([jnp.ones(1), u, u[one] * u[two]])


def _slopes(u: np.ndarray) -> np.ndarray:
    """(b, k) derivatives of `basis`."""
    k = len(u)
    one, two = np.triu_indices(k)
    pairs = np.zeros((len(one), k))
    pairs[np.arange(len(one)), one] += u[two]
    pairs[np.arange(len(one)), two] += u[one]
    return np.concatenate([np.zeros((1, k)), np.eye(k), pairs])


def polynomials(solved: Solved) -> dict[int, Polynomial]:
    """For every gait, by its number.

    Raises:
        SolverError: the polynomial misses what it stands for by more than the noise hides.
    """
    problem, best = solved.problem, solved.optimum
    std = np.where(np.isfinite(solved.known.std), solved.known.std, 0.0)
    ranges = np.maximum(REACH * std, 1e-6)
    moving = sorted({place for one in problem.sources for place in one.varied})
    count = len(moving)
    points = [best.free]
    for k in range(count):
        for side in (-1.0, 1.0):
            free = best.free.copy()
            free[moving[k]] += side * ranges[moving[k]]
            points.append(free)
    from scipy.stats import qmc  # slow to import

    checks = qmc.Sobol(count, rng=1).random(4) if count else np.zeros((0, 0))
    for corner in checks:
        free = best.free.copy()
        free[moving] += (2 * corner - 1) * ranges[moving] * 0.7
        points.append(free)
    found = [_at(solved, free) for free in points]
    made, used = {}, points[: len(points) - len(checks)]
    for number, sourced in enumerate(problem.sources):
        made[number] = _fitted(number, sourced.varied, used, found, best.free, ranges)
    _check(solved, made, points[len(used) :], found[len(used) :])
    return made


def _at(solved: Solved, free: np.ndarray) -> Point:
    point = solved.problem.point(free)
    if point is None:
        raise SolverError(solved.problem.failure)
    return point


def _fitted(
    number: int,
    places: tuple[int, ...],
    points: Sequence[np.ndarray],
    found: Sequence[Point],
    centre: np.ndarray,
    ranges: np.ndarray,
) -> Polynomial:
    chosen = list(places)
    rows, values = [], []
    for free, point in zip(points, found, strict=False):
        u = (free[chosen] - centre[chosen]) / ranges[chosen]
        known = point.gaits[number]
        rows.append(np.asarray(basis(jnp.asarray(u)))[None])
        values.append(known.gait[None])
        rows.append(_slopes(u).T)
        values.append((known.jacobian * (point.slopes[chosen] * ranges[chosen])).T)
    matrix, data = np.concatenate(rows), np.concatenate(values)
    coefficients = np.linalg.lstsq(matrix, data, rcond=None)[0]
    return Polynomial(places, centre[chosen], ranges[chosen], coefficients)


def _check(
    solved: Solved,
    made: dict[int, Polynomial],
    points: Sequence[np.ndarray],
    found: Sequence[Point],
) -> None:
    """Compares at points that were not used."""
    problem = solved.problem
    residuals = solved.residuals.observed
    size = np.sqrt(residuals.variances())
    worst = 0.0
    for free, point in zip(points, found, strict=True):
        gaits = {
            number: type(point.gaits[number])(np.asarray(one(jnp.asarray(free))), g.jacobian)
            for (number, one), g in zip(made.items(), point.gaits.values(), strict=True)
        }
        other = Point(point.values, point.slopes, gaits, point.tracks)
        apart = (problem.rows(other).value - problem.rows(point).value) / size
        worst = max(worst, float(np.linalg.norm(apart)))
    if worst > GOOD * np.sqrt(max(1, len(solved.known.std))):
        raise SolverError(
            "the posterior reaches so far that tracks are no polynomial of second degree there "
            f"(off by {worst:.2g} of the noise, all frames together): use --profile, or give "
            "priors that keep the parameters closer together"
        )
