"""Variable projection: a search among the numbers that cost a simulation, all others following.

What a gait or a simulation depends on is dear, where the robot was, how it was turned and at which
phase is not: with the gaits at hand the best of these numbers takes milliseconds. So at every
point of the search they are brought to their best first, and the derivatives of the residuals are
those with all of them following (Golub & Pereyra 1973; Kaufman 1975). A phase that hardly shows,
along which a search of all numbers at once creeps for a long time, costs no simulations then.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from ..explore import without
from ..levenberg import Evaluation, Iteration, Optimum, minimise
from ..uncertainty import RANK_TOLERANCE, Residuals
from .parts import Point
from .problem import Free, Problem

FOLLOWING = 60
"""Steps in which the other numbers find their best."""

SETTLED = 1e-4
"""Of the log likelihood, that is left to gain by the other numbers."""


@dataclass(frozen=True)
class Followed:
    """A point of the search.

    Attributes:
        free: (p,) all numbers, the cheap ones at their best.
        trial: residuals and derivatives by all numbers.
        follow: (q, c) how the cheap numbers change with the dear ones.
    """

    free: Free
    trial: Evaluation[Point]
    follow: Float[np.ndarray, "q c"]


class Projection:
    """A problem as a function of the numbers that cost a simulation.

    Attributes:
        problem: the problem.
        whole: whether tracks from rest are simulated to their ends.
        dear, cheap: (p,) which numbers are searched, and which follow.
        known: points of the search, by their dear numbers.
    """

    def __init__(self, problem: Problem, start: Free, held: np.ndarray, whole: bool) -> None:
        self.problem, self.whole = problem, whole
        self.dear: Bool[np.ndarray, " p"] = problem.dear & ~held
        self.cheap: Bool[np.ndarray, " p"] = ~problem.dear & ~held
        self.start = np.array(start, float)
        self.known: dict[bytes, Followed] = {}
        self._best: Followed | None = None

    def at(self, dear: Free) -> Followed:
        """A point of the search that has been evaluated."""
        return self.known[np.asarray(dear, float).tobytes()]

    def evaluate(self, dear: Free) -> Evaluation[Point] | None:
        """Residuals at dear numbers, the others at their best, with derivatives as they follow.

        Raises:
            KeyboardInterrupt: also while the others are sought.
        """
        free = self.start.copy()
        if (best := self._best) is not None:
            free = best.free.copy()
            free[self.cheap] += best.follow @ (dear - best.free[self.dear])
        free[self.dear] = dear
        trial = self.problem.evaluate(free, self.whole)
        if trial is None:
            return None
        free, trial = self._settled(free, trial)
        residuals, follow = projected(trial.residuals, self.dear, self.cheap)
        here = Followed(free, trial, follow)
        self.known[np.asarray(dear, float).tobytes()] = here
        # A search goes on from the best of its points; one that it rejects may lie far away.
        if best is None or trial.residuals.loss() < best.trial.residuals.loss():
            self._best = here
        return Evaluation(residuals, trial.model)

    def _settled(self, free: Free, trial: Evaluation[Point]) -> tuple[Free, Evaluation[Point]]:
        """The cheap numbers at their best, with the gaits and tracks of a point."""
        if not self.cheap.any():
            return free, trial

        def moved(cheap: Free) -> Free:
            ahead = free.copy()
            ahead[self.cheap] = cheap
            return ahead

        def evaluate(cheap: Free) -> Evaluation[Point]:
            found = self.problem.moved(trial.model, moved(cheap))
            jacobian = found.residuals.jacobian[:, self.cheap]
            return replace(found, residuals=replace(found.residuals, jacobian=jacobian))

        best = minimise(
            evaluate, free[self.cheap], max_iterations=FOLLOWING, gain_tolerance=SETTLED
        )
        if best is None or best.status == "interrupted":
            raise KeyboardInterrupt
        there = moved(best.free)
        return there, self.problem.moved(trial.model, there)


def projected(
    residuals: Residuals, dear: np.ndarray, cheap: np.ndarray
) -> tuple[Residuals, Float[np.ndarray, "q c"]]:
    """Residuals with derivatives by dear numbers as cheap ones follow, and how these follow."""
    _, jacobian = residuals.whitened()
    others = jacobian[:, cheap]
    if not others.size:
        follow = np.zeros((int(cheap.sum()), int(dear.sum())))
    else:
        scale = np.maximum(np.linalg.norm(others, axis=0), np.finfo(float).tiny)
        least = np.linalg.lstsq(others / scale, jacobian[:, dear], rcond=RANK_TOLERANCE)[0]
        follow = -least / scale[:, None]
    raw = residuals.jacobian
    return replace(residuals, jacobian=raw[:, dear] + raw[:, cheap] @ follow), follow


def search_projected(
    projection: Projection,
    *,
    max_iterations: int,
    tolerance: float,
    is_lost: Callable[[Free, Residuals], bool],
    on_iteration: Callable[[Iteration], None],
) -> Optimum[Point] | None:
    """Downhill; what is told and found is of all numbers.

    Args:
        projection: the problem.
        max_iterations, tolerance: as of `minimise`.
        is_lost: whether a search that has come to all these numbers and residuals has diverged.
        on_iteration: called after every iteration.
    """

    def of_all(iteration: Iteration) -> Iteration:
        return replace(iteration, free=projection.at(iteration.free).free)

    def lost(dear: Free, residuals: Residuals) -> bool:
        there = projection.at(dear)
        return is_lost(there.free, there.trial.residuals)

    found = minimise(
        projection.evaluate,
        projection.start[projection.dear],
        max_iterations=max_iterations,
        step_tolerance=tolerance,
        is_lost=lost,
        on_iteration=lambda iteration: on_iteration(of_all(iteration)),
    )
    if found is None:
        return None
    best = projection.at(found.free)
    trial = without(best.trial, ~(projection.dear | projection.cheap))
    history = tuple(map(of_all, found.history))
    return replace(found, free=best.free, trial=trial, history=history)
