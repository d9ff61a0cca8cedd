"""The fit of a dataset with speeds, steady tracks, priors, or noise that is not plain."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from derjax import Scene, SolverError, State
from derjax.integrate.frames import new_stats

from ..goodness import Goodness, goodness
from ..levenberg import Iteration, Optimum
from ..noise import NoisyResiduals
from ..outcome import Estimate, Fit, Progress, RateFit, RunFit
from ..plausible import runaway, unlikely
from ..simulate import SimulatedTrack
from ..tracks import Dataset, robot_length
from ..uncertainty import KINDS, Residuals, Uncertainty, uncertainty
from .assemble import assemble
from .begin import beginning
from .parts import Point, RatesPart, TrackPart
from .problem import Free, Problem
from .projection import Projection, search_projected
from .unknowns import Unknown

FRAMES = 400
"""Points of a simulated track in a figure."""


@dataclass(frozen=True)
class Solved:
    """A problem with its best fit.

    Attributes:
        problem: the problem.
        optimum: of all unknowns.
        known: errors of all unknowns, in free numbers.
        held: (p,) parameters of which the data say so little that they were held at their start.
    """

    problem: Problem
    optimum: Optimum[Point]
    known: Uncertainty
    held: np.ndarray

    @property
    def robot(self) -> tuple[Scene, State] | None:
        """The robot as it swims, of the first gait; None if all tracks are from rest."""
        sources = self.problem.sources
        return sources[0].source.last() if sources else None

    @property
    def residuals(self) -> NoisyResiduals:
        """At the best fit."""
        residuals = self.optimum.trial.residuals
        assert isinstance(residuals, NoisyResiduals)
        return residuals


def calibrate_jointly(
    dataset: Dataset,
    parameters: Sequence[str] = ("C_t", "C_r"),
    initial: Mapping[str, float] | None = None,
    *,
    progress: Callable[[Progress], None] = lambda progress: None,
    max_iterations: int = 30,
    tolerance: float = 1e-4,
    store: Path | None = None,
) -> tuple[Fit, Solved]:
    """Fit parameters, and what is not known besides, to tracks and speeds at once.

    Arguments are those of `calibrate`.

    Raises:
        InputError: something that cannot be estimated, or would have no effect.
        SolverError: there is no gait, or no simulation, at the start.
        KeyboardInterrupt: before there was any result.
    """
    begun = time.perf_counter()
    problem = assemble(dataset, parameters, initial or {}, store)
    start = {u.name: u.start for u in problem.unknowns.every}
    clock = _Clock(problem, progress)
    clock.stage = "compile"
    progress(Progress("compile", said=problem.said))
    clock.stage = "begin"
    problem.on_evaluation = clock.tick
    free = beginning(problem)
    if free is None:
        raise SolverError(f"{problem.failure} Or start from other parameters.")
    begins = problem.evaluations
    clock.stage = "fit"
    optimum, held = _found(problem, free, max_iterations, tolerance, clock.on_iteration)
    if optimum is None:
        raise SolverError(f"{problem.failure} Or start from other parameters.")
    solved = Solved(problem, optimum, errors(problem, optimum, held), held)
    wall = time.perf_counter() - begun
    return _outcome(solved, start, begins, wall), solved


def search(
    problem: Problem,
    free: Free,
    max_iterations: int = 30,
    tolerance: float = 1e-4,
    on_iteration: Callable[[Iteration], None] = lambda iteration: None,
    held: np.ndarray | None = None,
) -> Optimum[Point] | None:
    """Downhill with previews of what is simulated from rest, and then with whole simulations.

    Args:
        problem: the problem.
        free: (p,) where to begin.
        max_iterations: of each of both.
        tolerance: as of `minimise`.
        on_iteration: called after every iteration.
        held: (p,) which numbers stay as they are.
    """
    fixed = np.zeros(len(free), bool) if held is None else held
    start, fitted = problem.unknowns.start(), problem.unknowns.fitted

    def is_lost(free: Free, residuals: Residuals) -> bool:
        return bool((runaway(residuals, free - start) & fitted & ~fixed).any())

    def down(whole: bool, free: Free) -> Optimum[Point] | None:
        return search_projected(
            Projection(problem, free, fixed, whole),
            max_iterations=max_iterations,
            tolerance=tolerance,
            is_lost=is_lost,
            on_iteration=on_iteration,
        )

    found = down(False, free)
    if found is None or not problem.rest or found.status in ("interrupted", "diverged"):
        return found
    whole = down(True, found.free)
    return found if whole is None else whole


def _found(
    problem: Problem,
    free: Free,
    max_iterations: int,
    tolerance: float,
    on_iteration: Callable[[Iteration], None],
) -> tuple[Optimum[Point] | None, np.ndarray]:
    """The best fit, and which parameters were held as a search ran away with them."""
    start, fitted = problem.unknowns.start(), problem.unknowns.fitted
    held = np.zeros(len(free), bool)
    while True:
        found = search(problem, free, max_iterations, tolerance, on_iteration, held)
        if found is None or found.status != "diverged":
            return found, held
        gone = runaway(found.trial.residuals, found.free - start) & fitted & ~held
        held |= gone
        free = np.where(held, start, free)
        if held[fitted].all():
            return found, held


def errors(problem: Problem, optimum: Optimum[Point], held: np.ndarray) -> Uncertainty:
    """Errors of all unknowns; warnings are about those that were asked for.

    Those that were held have none, and those of the others are for these values.

    What is left of the derivatives once all others have followed says whether these are
    determined.
    """
    residuals, fitted = optimum.trial.residuals, problem.unknowns.fitted & ~held
    names = np.array(problem.unknowns.names)
    every = uncertainty(residuals, names.tolist())
    _, jacobian = residuals.standardised()
    others = jacobian[:, ~fitted]
    if others.shape[1]:
        scale = np.maximum(np.linalg.norm(others, axis=0), np.finfo(float).tiny)
        base = others / scale
        left = (
            jacobian[:, fitted] - base @ np.linalg.lstsq(base, jacobian[:, fitted], rcond=1e-9)[0]
        )
    else:
        left = jacobian
    size = np.linalg.norm(jacobian[:, fitted], axis=0)
    left = np.where(np.linalg.norm(left, axis=0) < 1e-7 * size, 0.0, left)
    count = len(left)
    unit = Residuals(np.zeros(count), left, np.zeros(count, int), np.ones(count), np.zeros(count))
    seen = uncertainty(unit, names[fitted].tolist())
    std = every.std.copy()
    std[fitted] = seen.std
    std[held] = np.inf
    return Uncertainty(std, every.quantile, every.correlation, seen.warnings)


def estimate(unknown: Unknown, free: float, std: float, quantile: float) -> Estimate:
    """A number with its error and interval, from those of its free number."""
    value = float(unknown.transform.value(jnp.asarray(free)))
    if not np.isfinite(std):
        return Estimate(value, np.inf, (-np.inf, np.inf))

    def at(z: float) -> float:
        return float(unknown.transform.value(jnp.asarray(z)))

    size = max(value - at(free - std), at(free + std) - value)
    return Estimate(value, size, (at(free - quantile * std), at(free + quantile * std)))


def _outcome(solved: Solved, start: dict[str, float], begins: int, wall: float) -> Fit:
    problem, optimum, known = solved.problem, solved.optimum, solved.known
    unknowns = problem.unknowns
    judged = judge(solved)
    every = {
        u.name: estimate(u, z, float(s) * judged.inflation, known.quantile)
        for u, z, s in zip(unknowns.every, optimum.free, known.std, strict=True)
    }
    fitted = unknowns.fitted
    names = [u.name for u in unknowns.every if u.fitted]
    residuals = solved.residuals
    return Fit(
        status=optimum.status,
        estimates={name: every[name] for name in names},
        correlation=known.correlation[np.ix_(fitted, fitted)],
        goodness=judged,
        causes=(),
        alternatives=(),
        warnings=tuple(_warnings(solved, judged, every, names)),
        loss=optimum.loss,
        noise=residuals.by_kind(residuals.variances()),
        start={name: start[name] for name in names},
        history=optimum.history,
        iterations=len(optimum.history) - 1,
        previews=begins,
        simulations=problem.evaluations - begins,
        runs=tuple(_runs(solved)),
        dataset=problem.dataset,
        wall_time=wall,
        rates=tuple(_rates(solved)),
        nuisances={name: one for name, one in every.items() if name not in names},
        units={u.name: u.unit for u in unknowns.every},
        memory=_memory(residuals),
        said=problem.said,
    )


def _memory(residuals: NoisyResiduals) -> dict[str, float]:
    """Correlations from frame to frame that were estimated, by kind."""
    return {KINDS[k]: level.rho for k, level in residuals.levels.items() if residuals.correlated}


def judge(solved: Solved) -> Goodness:
    """What the residuals say of the fit: of what is new in every frame, in units of the noise."""
    problem, residuals = solved.problem, solved.residuals.observed
    size = np.sqrt(residuals.variances())
    new = residuals.new() * size
    runs, values, place = [], [], 0
    for number, part in enumerate(problem.parts):
        count = len(part.rows(solved.optimum.trial.model, number).value)
        if isinstance(part, TrackPart):
            runs.append(part.run)
            values.append(part.table(new[place : place + count]))
        place += count
    lost = max(
        0, len(problem.unknowns.every) - sum(u.std is not None for u in problem.unknowns.every)
    )
    plain = replace(residuals, value=new, jacobian=residuals.jacobian[:, :lost], correlated=False)
    return goodness(plain, runs, values, robot_length(problem.dataset.scene))


def _warnings(
    solved: Solved, judged: Goodness, every: Mapping[str, Estimate], names: Sequence[str]
) -> list[str]:
    said = [] if judged.good else [judged.sentence() + "."]
    said += unlikely({n: every[n].value for n in names if np.isfinite(every[n].std)})
    if said:
        said.append("The error bars above assume that the model is right; do not rely on them.")
    if remark := judged.remark():
        said.append(remark)
    for unknown, held in zip(solved.problem.unknowns.every, solved.held, strict=True):
        if held:
            said.append(
                f"{unknown.name} is not determined by these data: the loss hardly changes however "
                f"far it goes. It was held at its start, {unknown.start:.4g}; the others are for "
                "that value."
            )
        if unknown.std is None or unknown.mean is None:
            continue
        off = (every[unknown.name].value - unknown.mean) / unknown.std
        if abs(off) > 3.0:
            said.append(
                f"{unknown.name} = {every[unknown.name].value:.4g} is {abs(off):.1f} standard "
                f"deviations from what was known of it ({unknown.mean:.4g} +- {unknown.std:.2g}): "
                "data and prior contradict each other."
            )
    return [*said, *solved.known.warnings]


def _runs(solved: Solved) -> list[RunFit]:
    """What has become of every track."""
    found, point = [], solved.optimum.trial.model
    stats = new_stats()
    for number, part in enumerate(solved.problem.parts):
        if not isinstance(part, TrackPart):
            continue
        rows = part.rows(point, number)
        run, time_ = part.run, part.run.time
        if part.source is not None:
            time_ = np.linspace(run.time[0], run.time[-1], max(FRAMES, 2))
        observed, _ = part.predicted(point, number, time_)
        count = len(time_)
        after = SimulatedTrack(
            time_,
            observed,
            np.zeros((count, 4, 0)),
            np.broadcast_to(np.eye(3), (count, 3, 3)),
            np.zeros((count, 3, 3, 0)),
            stats,
        )
        left = part.table(rows.value)
        rms = {
            kind: float(np.sqrt(np.mean(left[:, chosen] ** 2)))
            for kind, chosen in (("position", ~run.is_angle), ("head_angle", run.is_angle))
            if chosen.any()
        }
        drift = {
            label: float(point.values[place])
            for one, places in _placed(part)
            if one == "drift"
            for label, place in places
        }
        found.append(RunFit(run, None, after, left, rms, drift))
    return found


def _placed(part: TrackPart) -> list[tuple[str, list[tuple[str, int]]]]:
    places, found = iter(part.mapped), []
    for one in part.maps:
        found.append((one.name, [(label, next(places)) for label in one.labels]))
    return found


def _rates(solved: Solved) -> list[RateFit]:
    """What has become of all speeds."""
    found, point = [], solved.optimum.trial.model
    for part in solved.problem.parts:
        if isinstance(part, RatesPart):
            value, _ = part.predicted(point)
            data, std = part.data()
            found.append(RateFit(part.name, part.rates.motor_rpm, data, std, value))
    return found


class _Clock:
    """Says how far a fit is."""

    def __init__(self, problem: Problem, progress: Callable[[Progress], None]) -> None:
        self.problem, self.progress, self.stage = problem, progress, "compile"
        self.count = -1

    def tick(self) -> None:
        """An evaluation is done."""
        self.progress(Progress(self.stage, max(0, self.count)))

    def on_iteration(self, latest: Iteration) -> None:
        self.count += 1
        values = self.problem.unknowns.values(latest.free)
        fitted = {
            u.name: float(v)
            for u, v in zip(self.problem.unknowns.every, values, strict=True)
            if u.fitted
        }
        self.progress(Progress(self.stage, self.count, 1.0, latest=latest, values=fitted))
