"""Profile likelihood: how well the data can be explained for every value of one parameter.

One parameter is held at values to both sides of its best, all others follow, and the rise of the
loss
says what the data exclude: 1.92 is the end of a 95 % interval. Where the model is about linear it
is that of the covariance; where the profile is no parabola, it is the profile that is right.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .fit import Solved, search

RISE = 0.5 * 1.959964**2
"""Of the loss, at the ends of a 95 % interval."""

FARTHEST = 1.25 * RISE
"""Rise of the loss at which a side is far enough."""

STEP, MOST = 0.7, 14
"""Steps of the parameter in standard errors, and how many to a side."""


@dataclass(frozen=True)
class Profile:
    """The profile of one parameter.

    Attributes:
        name: of the parameter.
        values: (n,) in its unit, increasing.
        rise: (n,) of the loss above its least.
        parabola: (n,) what the covariance makes of it.
        ci95: ends of the interval; infinite where the loss does not rise enough.
    """

    name: str
    values: Float[np.ndarray, " n"]
    rise: Float[np.ndarray, " n"]
    parabola: Float[np.ndarray, " n"]
    ci95: tuple[float, float]


def profiles(
    solved: Solved,
    names: Sequence[str] | None = None,
    on_point: Callable[[str, float], None] = lambda name, value: None,
) -> list[Profile]:
    """Profiles of parameters that were fitted.

    Args:
        solved: the best fit.
        names: which; by default all that are determined.
        on_point: called after every point, with the value.
    """
    found = []
    for place, unknown in enumerate(solved.problem.unknowns.every):
        wanted = unknown.fitted if names is None else unknown.name in names
        if wanted and np.isfinite(solved.known.std[place]):
            found.append(_profile(solved, place, on_point))
    return found


def _profile(solved: Solved, place: int, on_point: Callable[[str, float], None]) -> Profile:
    problem, best = solved.problem, solved.optimum
    std, unknown = float(solved.known.std[place]), problem.unknowns.every[place]
    held = solved.held.copy()
    held[place] = True
    lowest, centre = best.loss, float(best.free[place])
    points = [(centre, 0.0)]
    for side in (-1.0, 1.0):
        free, last, step = best.free.copy(), best.free.copy(), STEP * std
        for _ in range(MOST):
            ahead = free + (free - last)
            ahead[place] = free[place] + side * step
            found = search(problem, ahead, 15, held=held)
            if found is None:
                break
            if found.status == "interrupted":
                raise KeyboardInterrupt
            last, free = free, found.free
            rise = found.loss - lowest
            points.append((float(free[place]), rise))
            on_point(unknown.name, float(unknown.transform.value(free[place])))
            if rise > FARTHEST:
                break
            if rise < 0.3 * RISE and abs(free[place] - centre) > 2 * std:
                step *= 1.5
    points.sort()
    z, rise = np.array(points).T
    values = np.array([float(unknown.transform.value(one)) for one in z])
    ends = tuple(
        float(unknown.transform.value(jnp.asarray(end))) if np.isfinite(end) else end
        for end in (_end(z, rise, centre, -1), _end(z, rise, centre, 1))
    )
    return Profile(unknown.name, values, rise, 0.5 * ((z - centre) / std) ** 2, (ends[0], ends[1]))


def _end(z: np.ndarray, rise: np.ndarray, centre: float, side: int) -> float:
    """Where the rise is that of the interval, by its root, which is about linear."""
    chosen = (z - centre) * side >= 0
    away, height = np.abs(z[chosen] - centre), np.sqrt(np.maximum(rise[chosen], 0.0))
    order = np.argsort(away)
    away, height = away[order], height[order]
    wanted = np.sqrt(RISE)
    beyond = np.flatnonzero(height >= wanted)
    if not beyond.size:
        return side * np.inf
    k = int(beyond[0])
    if k == 0:
        return centre
    part = (wanted - height[k - 1]) / (height[k] - height[k - 1])
    return centre + side * float(away[k - 1] + part * (away[k] - away[k - 1]))
