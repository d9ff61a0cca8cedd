"""Calibration: the parameters of a scene for which the simulation follows the tracks."""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from derjax import InputError, SolverError

from .causes import Cause, likely_causes
from .conclusion import Conclusion, judge
from .explore import NEARLY, Exploration, distinct, explore, without
from .goodness import Goodness
from .joint.fit import calibrate_jointly
from .levenberg import Evaluation, Iteration, Optimum, minimise
from .model import Model
from .outcome import Fit, Progress
from .plausible import runaway, unlikely
from .simulate import SimulatedTrack
from .tracks import Dataset
from .transforms import Parameters, select_parameters
from .uncertainty import Residuals

Free = Float[np.ndarray, " p"]

MOST_FITS = 3
"""Optima of previews from which fits to whole simulations are made."""

EXPECTED = {"explore": 9, "fit": 3}
"""Evaluations that a stage usually takes, to tell how long a calibration will last."""

PREVIEW = 0.3
"""Part of the steps that a preview usually takes, until one is done."""


def calibrate(
    dataset: Dataset,
    parameters: Sequence[str] = ("C_t", "C_r"),
    initial: Mapping[str, float] | None = None,
    *,
    progress: Callable[[Progress], None] = lambda progress: None,
    explored: bool = True,
    compare: bool = True,
    max_iterations: int = 30,
    tolerance: float = 1e-4,
    store: Path | None = None,
) -> Fit:
    """Fit parameters of the scene to the tracks, and to speeds, by least squares.

    A cheap search on the whole of the tracks, also beyond the basin of the start (`explore`), and
    then Levenberg-Marquardt with exact sensitivities from the best optima that it found. Parameters
    are positive by construction. If the residuals say that the simulation does not describe the
    tracks, likely causes are tried (`causes`). Ctrl-C ends the search and returns the best
    parameters so far.

    Args:
        dataset: tracks and scene.
        parameters: names, keys of `SceneFile.single_numbers`.
        initial: where to start; by default the values of the scene.
        progress: called often, from the threads that simulate.
        explored: whether to look for other optima than the one that is downhill from the start.
        compare: whether to simulate with the parameters of the start as well, for figures.
        max_iterations: of the fit.
        tolerance: the fit has converged when the next step would change no parameter by more
            than this fraction, or by a change that the noise would hide.
        store: a directory for what has been simulated. A calibration that finds there what
            another one of the same dataset and start has simulated does not simulate it again.

    Raises:
        InputError: a parameter that does not exist or a start outside of its range.
        SolverError: the simulation fails with the parameters of the start.
        KeyboardInterrupt: before there was any result.
    """
    if not dataset.is_plain:
        return calibrate_jointly(
            dataset,
            parameters,
            initial,
            progress=progress,
            max_iterations=max_iterations,
            tolerance=tolerance,
            store=store,
        )[0]
    begun = time.perf_counter()
    chosen, start = beginning(dataset, parameters, initial or {})
    free = chosen.free(start)
    clock = _Clock(progress, compare)
    model = Model(dataset, chosen, clock.on_steps, store)
    clock.model = model
    progress(Progress("compile"))
    model.compile(free)

    exploration = _explored(clock, free) if explored else None
    if exploration is not None and _is_final(model, exploration):
        optima: tuple[Optimum[list[SimulatedTrack]], ...] = exploration.optima
    else:
        optima = _fits(clock, free, exploration, max_iterations, tolerance)
    judged = judge(model, optima[0])
    optima, causes = _checked(clock, free, optima, judged)
    before = None
    with contextlib.suppress(KeyboardInterrupt):
        if compare and optima[0].status != "interrupted":
            clock.begin("compare")
            trial = model.whole(free)
            before = None if trial is None else trial.model
    return Conclusion(model, start, exploration, optima, judged, causes).fit(
        before, clock.previews, clock.simulations, time.perf_counter() - begun
    )


def beginning(
    dataset: Dataset, parameters: Sequence[str], initial: Mapping[str, float]
) -> tuple[Parameters, dict[str, float]]:
    """What a calibration varies, and the values that it starts from.

    Raises:
        InputError: a parameter that does not exist or a start outside of its range.
    """
    known = dataset.scene.single_numbers
    chosen = select_parameters(parameters, known)
    for name in initial:
        if name not in chosen.names:
            raise InputError(f"a start is given for {name}, which is not among the parameters")
    start = {name: float({**known, **initial}[name]) for name in chosen.names}
    chosen.free(start)
    return chosen, start


def _explored(clock: "_Clock", free: Free) -> Exploration:
    """The optima of previews; `SolverError` if the start cannot be simulated."""
    clock.begin("explore")
    exploration = explore(clock.preview, free, on_iteration=clock.on_iteration)
    if exploration is None:
        raise _cannot(clock.model, free)
    return exploration


def _is_final(model: Model, exploration: Exploration) -> bool:
    """Whether whole simulations would tell nothing more than previews have told.

    They do where a good fit leaves a parameter open on one side: the others are to be fitted.
    """
    best = exploration.optima[0]
    ran_away = best.status == "diverged" and not judge(model, best).good
    return ran_away or best.status == "interrupted"


def _fits(
    clock: "_Clock",
    free: Free,
    exploration: Exploration | None,
    max_iterations: int,
    tolerance: float,
) -> tuple[Optimum[list[SimulatedTrack]], ...]:
    """Optima of whole simulations, best first; after Ctrl-C the best so far alone."""
    starts, fallback = [(free, np.zeros(len(free), bool))], None
    if exploration is not None:
        lowest = exploration.optima[0].loss
        near = [o for o in exploration.optima if o.loss <= lowest + NEARLY]
        starts = [
            (o.free, np.array(exploration.held) | runaway(o.trial.residuals, o.free - free))
            for o in near[:MOST_FITS]
        ]
        fallback = exploration.optima[0]
    found: list[Optimum[list[SimulatedTrack]]] = []

    clock.begin("fit")
    for start, fixed in starts:
        try:
            optimum = minimise(
                partial(_with_fixed, clock, fixed),
                start,
                max_iterations=max_iterations,
                step_tolerance=tolerance,
                is_lost=partial(_is_lost, free, fixed),
                on_iteration=clock.on_iteration,
            )
        except KeyboardInterrupt:
            best = min(found, key=lambda o: o.loss) if found else fallback
            if best is None:
                raise
            return (replace(best, status="interrupted"),)
        if optimum is None:
            if not found and start is starts[-1][0]:
                raise _cannot(clock.model, start)
            continue
        found.append(optimum)
        if optimum.status == "interrupted":
            return (optimum,)
    return distinct(found)


def _with_fixed(
    clock: "_Clock", fixed: np.ndarray, free: Free
) -> Evaluation[list[SimulatedTrack]] | None:
    """Whole simulations, without derivatives along some parameters."""
    trial = clock.whole(free)
    return None if trial is None else without(trial, fixed)


def _is_lost(start: Free, fixed: np.ndarray, free: Free, residuals: Residuals) -> bool:
    """Whether a search ran away from the start with a parameter that is not fixed."""
    return bool((runaway(residuals, free - start) & ~fixed).any())


def _checked(
    clock: "_Clock", free: Free, optima: tuple[Optimum[list[SimulatedTrack]], ...], judged: Goodness
) -> tuple[tuple[Optimum[list[SimulatedTrack]], ...], tuple[Cause, ...] | None]:
    """Likely causes of a bad fit; after Ctrl-C none, and the fit is an interrupted one.

    A search that has not come to its end may be bad for that reason alone.
    """
    best, model = optima[0], clock.model
    ended = best.status not in ("interrupted", "max_iterations")
    if not ended or (judged.good and not unlikely(model.values(best.free))):
        return optima, ()
    clock.begin("check")
    try:
        return optima, likely_causes(model, free, best)
    except KeyboardInterrupt:
        return (replace(best, status="interrupted"), *optima[1:]), None


def _cannot(model: Model, free: Free) -> SolverError:
    values = ", ".join(f"{k} = {v:.6g}" for k, v in model.values(free).items())
    return SolverError(f"with {values}: {model.failure} Or start from other parameters.")


class _Clock:
    """Counts evaluations and says how long a calibration still takes."""

    model: Model

    def __init__(self, progress: Callable[[Progress], None], compare: bool) -> None:
        self.progress, self.compare = progress, compare
        self.stage, self.iteration = "compile", -1
        self.previews = self.simulations = self.preview_steps = 0

    def begin(self, stage: str) -> None:
        """The evaluations that follow belong to this stage."""
        self.stage, self.iteration = stage, -1

    def preview(self, free: Free) -> Evaluation[list[SimulatedTrack]] | None:
        """`Model.preview`, counted."""
        self.iteration += 1
        self.previews += 1
        trial = self.model.preview(free)
        if trial is not None:
            self.preview_steps = max(len(one.time) for one in trial.model) * len(trial.model)
        return trial

    def whole(self, free: Free) -> Evaluation[list[SimulatedTrack]] | None:
        """`Model.whole`, counted."""
        self.iteration += 1
        self.simulations += 1
        return self.model.whole(free)

    def on_steps(self, done: int, whole: int) -> None:
        """So many steps of an evaluation have been taken, of `whole` if it is simulated in full."""
        wanted = whole
        if self.stage in ("explore", "check"):
            wanted = min(whole, self.preview_steps or PREVIEW * whole)
        part = min(1.0, done / wanted)
        left = (1.0 - part) * wanted + self._later(whole)
        rate = self.model.work.rate
        self.progress(Progress(self.stage, max(self.iteration, 0), part, left / rate, rate))

    def on_iteration(self, latest: Iteration) -> None:
        """An iteration of a search is done."""
        rate, whole = self.model.work.rate, sum(self.model.steps)
        self.progress(
            Progress(
                self.stage,
                self.iteration,
                1.0,
                self._later(whole) / rate,
                rate,
                latest=latest,
                values=self.model.values(latest.free),
            )
        )

    def _later(self, whole: int) -> float:
        """Steps in the evaluations that usually follow this one."""
        later = 0.0
        if self.stage == "explore":
            each = min(whole, self.preview_steps or PREVIEW * whole)
            later += max(0, EXPECTED["explore"] - 1 - self.iteration) * each
            later += EXPECTED["fit"] * whole
        if self.stage == "fit":
            later += max(0, EXPECTED["fit"] - 1 - self.iteration) * whole
        return later + whole * (self.compare and self.stage != "compare")
