"""Where the optimum may be: a search that looks beyond the basin of the start.

The loss of tracked positions often has many minima. A head that is seen from its positions only
is known by how it wobbles, and a rate at which the wobble comes out of step with the tracks within
a turn or two is as bad as any other: around the one good value lies a plateau with many shallow
minima. A search that goes downhill ends in one of them and finds a small error there.

Three things are done about it, all with the cheap model that the caller gives:

- a search downhill from the start;
- parameters that hardly matter, and on which what is found for the others hardly depends, are
  held at their start, so that they neither wander nor spoil the others;
- for every other parameter, a look at both sides of where that ended. If the loss rises there as
  the derivatives say, there is nothing else to be found along this parameter;
- else a walk along the parameter to both sides, far enough to contain every value that is within a
  factor of six of the start, with the other parameters following. Steps are short enough for the
  tracks to change about linearly in each of them, so that no minimum is stepped over. The lowest
  points of the walk are starts of more searches downhill.

A search that runs away with a parameter, since the loss falls as far as it goes, is stopped where
the parameter does not change the tracks any more. Then all values between there and the start are
looked at. If none of them is better, there is no optimum.

The walk also says which values fit nearly as well as the best, which the curvature at one minimum
cannot.
"""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from .levenberg import Evaluation, Iteration, Optimum, damped_step, minimise
from .plausible import FARTHEST, runaway
from .uncertainty import Residuals, shifted

T = TypeVar("T")
Free = Float[np.ndarray, " p"]
Evaluate = Callable[[Free], Evaluation[T] | None]

REACH = float(np.log(6.0))
"""How far a walk goes beyond start and optimum, in a free parameter."""

ASIDE = 0.35
"""How far from an optimum the two looks at its sides are taken, in a free parameter."""

AS_PROMISED, STEEP = 0.3, 8.0
"""A parameter is simple if the loss rises at both sides by this part of what the derivatives
promise, and these promise at least so much."""

HARDLY = 1.0
"""Standard error of a free parameter from which on it hardly matters."""

FACTOR, HARDLY_COUPLED = float(np.log(5.0)), 0.1
"""A parameter is only held if a change of it by this much changes the others by less than that."""

HARDLY_WORSE = 2.0
"""How much higher the loss may be with a parameter held at its start."""

NONLINEAR, UNSEEN = 0.6, 2.0
"""The part of a change of the tracks in one step of a walk that its derivatives may miss, and how
much of chi^2 (as a root) that is in any case too little to be seen."""

SHORTEST, LONGEST = 0.01, 0.7
"""Steps of a walk, in a free parameter."""

MOST_STEPS = 80
"""Of a walk to one side."""

NEARLY = 6.0
"""Optima whose losses differ by less than this are both reported: chi^2 differs by 12, more than
chance makes of some tens of places where it could."""

WORTH_A_TRY, MOST_TRIES = 15.0, 6
"""Minima of a walk that are searched from: those whose loss is within this of the lowest."""


@dataclass(frozen=True)
class Point:
    """Parameters that were looked at, after a linear fit of all but the one walked along.

    Attributes:
        free: (p,) free parameters.
        loss: there, as the derivatives predict it.
    """

    free: Free
    loss: float


@dataclass(frozen=True)
class Exploration:
    """What is known of the loss before any simulation to the end.

    Attributes:
        optima: lowest first.
        held: (p,) which parameters hardly matter, and are held at their start.
        spread: (p,) how far a factor of five of those moves the others.
        points: of all walks.
        minima: number of minima of the loss along the walks.
        walked: (p,) which parameters were walked along.
        limits: (p, 2) how far; NaN for others.
    """

    optima: tuple[Optimum, ...]
    held: tuple[bool, ...]
    spread: Free
    points: tuple[Point, ...]
    minima: int
    walked: tuple[bool, ...]
    limits: Float[np.ndarray, "p 2"]

    def accepted(self, rise: float) -> list[Free]:
        """(p,) parameters of walks whose loss is at most so much above the lowest known.

        Among many minima that are made by noise the lowest is lower by the logarithm of their
        number than one of them alone would be; so much more is allowed.
        """
        rise += np.log(max(1, self.minima))
        lowest = min([self.optima[0].loss, *(p.loss for p in self.points)])
        return [point.free for point in self.points if point.loss <= lowest + rise]


def explore(
    evaluate: Evaluate[T],
    start: Free,
    *,
    on_iteration: Callable[[Iteration], None] = lambda iteration: None,
) -> Exploration | None:
    """Optima of a cheap model, those included that cannot be reached downhill from the start.

    Args:
        evaluate: the model at a free vector; None where it cannot be computed.
        start: (p,) free vector.
        on_iteration: called after every iteration of the first search.

    Returns:
        None if the model cannot be computed at the start. After Ctrl-C there is one optimum,
        whose status is "interrupted". If the loss is lowest where a search ran away, the status of
        the first is "diverged".

    Raises:
        KeyboardInterrupt: before the model at the start was known.
    """
    first = _downhill(evaluate, start, 12, start, on_iteration)
    if first is None:
        return None
    search = _Search(evaluate, start, [first])
    if first.status != "interrupted":
        with contextlib.suppress(KeyboardInterrupt):
            search.hold()
            search.turn_back()
            if not search.gone(search.best).any():
                for k in np.flatnonzero(~search.held):
                    search.look_along(int(k))
            return search.outcome(distinct(search.optima))
    best = search.best
    stopped = Optimum(best.free, best.trial, "interrupted", best.history)
    return search.outcome((stopped,))


class _Search:
    """What an exploration has found so far."""

    def __init__(self, evaluate: Evaluate, start: Free, optima: list[Optimum]) -> None:
        self.start, self.optima = start, optima
        self.held = np.zeros(len(start), bool)
        self.spread = np.zeros(len(start))
        self.walked = np.zeros(len(start), bool)
        self.limits = np.full((len(start), 2), np.nan)
        self.points: list[Point] = []
        self.minima = 0
        self._evaluate = evaluate

    @property
    def best(self) -> Optimum:
        """The lowest optimum known."""
        return min(self.optima, key=lambda o: o.loss)

    def evaluate(self, free: Free) -> Evaluation | None:
        """The model, without derivatives along parameters that are held."""
        trial = self._evaluate(free)
        return None if trial is None else without(trial, self.held)

    def gone(self, optimum: Optimum) -> np.ndarray:
        """(p,) with which parameters a search ran away."""
        return runaway(optimum.trial.residuals, optimum.free - self.start)

    def hold(self) -> None:
        """Hold the parameters that hardly matter."""
        for k in range(len(self.start)):
            best = self.best
            if not _hardly_matters(best.trial.residuals, k, self.held):
                continue
            before = self.held.copy()
            self.held[k] = True
            free = best.free.copy()
            free[k] = self.start[k]
            found = None if self.held.all() else _downhill(self.evaluate, free, 8, self.start)
            if found is not None and found.status == "interrupted":
                self.held = before
                raise KeyboardInterrupt
            spread = None
            if found is not None and found.loss < best.loss + HARDLY_WORSE:
                spread = self._spread(found, k)
            if found is None or spread is None or spread.max() > HARDLY_COUPLED:
                self.held = before
            else:
                self.optima, self.spread = [found], np.hypot(self.spread, spread)

    def _spread(self, found: Optimum, k: int) -> Free | None:
        """(p,) how far the others go with parameter k a factor of five off; None if it matters."""
        most = np.zeros(len(found.free))
        for side in (-FACTOR, FACTOR):
            free = found.free.copy()
            free[k] += side
            trial = self.evaluate(free)
            if trial is None:
                return None
            change = damped_step(trial.residuals)
            if shifted(trial.residuals, change).loss() > found.loss + HARDLY_WORSE:
                return None
            most = np.maximum(most, np.abs(change))
        return most

    def turn_back(self) -> None:
        """If the best search ran away with a parameter, look along it from the start to there."""
        far = self.best
        gone = np.flatnonzero(self.gone(far)).tolist()
        begin = self.evaluate(self.start) if gone else None
        if begin is None:
            return
        for k in gone:
            back, there = self.start[k], far.free[k]
            self.limits[k] = min(back - REACH, there), max(back + REACH, there)
            path = _walk(self.evaluate, self.start, begin, k, self.limits[k], far.trial.residuals)
            end = [Point(far.free, far.loss)]
            self._search_along([*path, *end] if there > back else [*end, *path], far, k)
        if not self.gone(self.best).any():
            self.optima = [o for o in self.optima if not self.gone(o).any()]
            self.hold()

    def look_along(self, k: int) -> None:
        """See whether there are other optima along a parameter."""
        best = self.best
        if _is_simple(self.evaluate, best, k):
            return
        here = np.clip(best.free[k], self.start[k] - FARTHEST, self.start[k] + FARTHEST)
        self.limits[k] = min(self.start[k], here) - REACH, max(self.start[k], here) + REACH
        unit = best.trial.residuals
        path = _walk(self.evaluate, best.free, best.trial, k, self.limits[k], unit)
        self._search_along(path, best, k)

    def _search_along(self, path: list[Point], best: Optimum, k: int) -> None:
        """Search from the lowest points of a walk along parameter k."""
        self.walked[k] = True
        self.points += path
        self.minima += int(np.count_nonzero(_are_minima(path)))
        for point in _lowest(path, best, k):
            found = _downhill(self.evaluate, point.free, 8, self.start)
            if found is not None:
                self.optima.append(found)
                if found.status == "interrupted":
                    raise KeyboardInterrupt

    def outcome(self, optima: tuple[Optimum, ...]) -> Exploration:
        """All that is known, with some optima."""
        return Exploration(
            optima,
            tuple(self.held.tolist()),
            self.spread,
            tuple(self.points),
            self.minima,
            tuple(self.walked.tolist()),
            self.limits,
        )


def without(trial: Evaluation[T], held: np.ndarray | Sequence[bool]) -> Evaluation[T]:
    """A trial without derivatives along parameters that are held."""
    if not np.any(held):
        return trial
    return replace(trial, residuals=_only(trial.residuals, ~np.asarray(held)))


def coupling(residuals: Residuals, k: int) -> Free:
    """(p,) how all parameters change with one of them if the others follow it, per unit."""
    _, jacobian = residuals.whitened()
    others = np.arange(jacobian.shape[1]) != k
    direction = np.ones(jacobian.shape[1])
    if others.any():
        direction[others] = -np.linalg.lstsq(jacobian[:, others], jacobian[:, k], rcond=1e-6)[0]
    return direction


def _hardly_matters(residuals: Residuals, k: int, held: np.ndarray) -> bool:
    """Whether neither the tracks nor the other parameters depend much on parameter k."""
    direction = coupling(residuals, k)
    others = np.arange(len(direction)) != k
    _, jacobian = residuals.whitened()
    information = np.linalg.norm(jacobian @ direction)
    coupled = np.abs(direction[others & ~held]).max(initial=0.0)
    return bool(information < 1.0 / HARDLY and FACTOR * coupled < HARDLY_COUPLED)


def distinct(optima: Sequence[Optimum]) -> tuple[Optimum, ...]:
    """Optima, lowest first, without those that are where a lower one is."""
    kept: list[Optimum] = []
    for optimum in sorted(optima, key=lambda o: o.loss):
        if not any(_same(other, optimum) for other in kept):
            kept.append(optimum)
    return tuple(kept)


def _same(one: Optimum, other: Optimum) -> bool:
    """Whether two searches have ended at one place, or in one flat valley."""
    change = other.free - one.free
    if np.abs(change).max() < 0.02:
        return True
    residuals = one.trial.residuals
    predicted = shifted(residuals, change)
    rise = predicted.loss() - residuals.loss()
    return bool(rise < 0.5 and _gap(predicted, other.trial.residuals, residuals) < 1.0)


def _gap(one: Residuals, other: Residuals, unit: Residuals) -> float:
    """How far apart residuals are, in units of the noise of `unit`."""
    return float(np.linalg.norm((one.value - other.value) / np.sqrt(unit.variances())))


def _downhill(
    evaluate: Evaluate[T],
    free: Free,
    most: int,
    start: Free,
    on_iteration: Callable[[Iteration], None] = lambda iteration: None,
) -> Optimum[T] | None:
    """The optimum downhill from some parameters, unless they run away from the start."""
    return minimise(
        evaluate,
        free,
        max_iterations=most,
        step_tolerance=1e-3,
        gain_tolerance=0.05,
        is_lost=lambda free, residuals: bool(runaway(residuals, free - start).any()),
        on_iteration=on_iteration,
    )


def _only(residuals: Residuals, chosen: np.ndarray) -> Residuals:
    """With the derivatives with respect to some parameters set to zero."""
    return replace(residuals, jacobian=residuals.jacobian * np.asarray(chosen, float))


def _follow(residuals: Residuals, k: int) -> Free:
    """`coupling`, within what a step of a walk may be."""
    direction = np.clip(coupling(residuals, k), -2.0, 2.0)
    direction[k] = 1.0
    return direction


def _settled(free: Free, trial: Evaluation, k: int) -> tuple[Free, Point]:
    """The step of the others to their optimum beside parameter k, and the point there."""
    others = np.arange(len(free)) != k
    if not others.any():
        return np.zeros_like(free), Point(free, trial.residuals.loss())
    step = np.where(others, damped_step(_only(trial.residuals, others)), 0.0)
    return step, Point(free + step, shifted(trial.residuals, step).loss())


def _is_simple(evaluate: Evaluate[T], best: Optimum[T], k: int) -> bool:
    """Whether the loss rises at both sides of an optimum as its derivatives say."""
    residuals, loss = best.trial.residuals, best.loss
    direction = _follow(residuals, k)
    for side in (-ASIDE, ASIDE):
        promised = shifted(residuals, side * direction).loss() - loss
        if promised < STEEP:
            return False
        trial = evaluate(best.free + side * direction)
        if trial is None:
            continue
        _, point = _settled(best.free + side * direction, trial, k)
        if point.loss - loss < max(AS_PROMISED * promised, STEEP):
            return False
    return True


def _walk(
    evaluate: Evaluate[T],
    start: Free,
    begin: Evaluation[T],
    k: int,
    ends: Float[np.ndarray, "2"],
    unit: Residuals,
) -> list[Point]:
    """Points along parameter k, in order, from one end to the other.

    Args:
        evaluate: the model.
        start: (p,) where the walks to both sides begin.
        begin: the model there.
        k: the parameter.
        ends: of the walks.
        unit: residuals whose noise is that of the tracks.
    """
    sides = []
    for sign, end in zip((-1.0, 1.0), ends, strict=True):
        free, trial, length = start, begin, 0.15
        settling, _ = _settled(free, trial, k)
        path: list[Point] = []
        while len(path) < MOST_STEPS and sign * (end - free[k]) > SHORTEST:
            length = min(length, abs(end - free[k]))
            step = settling + sign * length * _follow(trial.residuals, k)
            new = evaluate(free + step)
            if new is None:
                break
            predicted = shifted(trial.residuals, step)
            missed = _gap(predicted, new.residuals, unit)
            moved = _gap(predicted, trial.residuals, unit)
            grow = 2.0
            if missed > UNSEEN:
                grow = float(np.clip(NONLINEAR * moved / missed, 0.4, 2.0))
            if grow < 0.5 and length > 2 * SHORTEST:
                length *= grow
                continue
            length = float(np.clip(grow * length, SHORTEST, LONGEST))
            free, trial = free + step, new
            settling, point = _settled(free, trial, k)
            path.append(point)
        sides.append(path)
    return [*reversed(sides[0]), Point(start, begin.residuals.loss()), *sides[1]]


def _lowest(path: Sequence[Point], best: Optimum, k: int) -> list[Point]:
    """The minima of a walk that are worth a search of their own."""
    losses = np.array([point.loss for point in path])
    near = losses <= losses.min() + WORTH_A_TRY
    chosen = [
        path[i]
        for i in np.flatnonzero(_are_minima(path) & near).tolist()
        if abs(path[i].free[k] - best.free[k]) > SHORTEST
    ]
    return sorted(chosen, key=lambda point: point.loss)[:MOST_TRIES]


def _are_minima(path: Sequence[Point]) -> np.ndarray:
    """Which points of a walk are no higher than their neighbours."""
    losses = np.array([point.loss for point in path])
    padded = np.pad(losses, 1, constant_values=np.inf)
    return (losses <= padded[:-2]) & (losses <= padded[2:])
