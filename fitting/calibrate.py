"""Calibration: the parameters of a scene for which the simulation follows the tracks."""

import contextlib
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from derjax import InputError, SolverError

from .levenberg import Iteration, Optimum, Trial, minimise
from .observe import interpolation
from .simulate import Simulated, Simulator, motor_rate, steps_per_call
from .tracks import Dataset, Run
from .transforms import Parameters, choose
from .uncertainty import Residuals, uncertainty

RESOLUTION = 1e-6
"""Noise is never estimated below this fraction of the range of a track."""

COARSE = 1 / 8
"""Part of the tracks' duration that the first, coarse fit goes by."""

COARSE_FRAMES = 4
"""Frames that a coarse fit needs of every run."""

EXPECTED = {"coarse": 7, "fit": 3, "compare": 1}
"""Simulations of all runs that a fit usually takes, to tell how long it will last."""


@dataclass(frozen=True)
class Estimate:
    """A fitted parameter, in its own unit: value, standard error, 95 % interval."""

    value: float
    std: float
    ci95: tuple[float, float]


@dataclass(frozen=True)
class RunFit:
    """A run at the start and at the end of the fit.

    Attributes:
        run: the track; after an interruption, the part of it that the fit went by.
        before: the simulation with the parameters of the start; None if there is none.
        after: with the fitted ones.
        residuals: (f, c) simulation minus track, m and rad.
        rms: root mean square of the residuals (m, rad) of every kind tracked.
    """

    run: Run
    before: Simulated | None
    after: Simulated
    residuals: Float[np.ndarray, "f c"]
    rms: dict[str, float]


@dataclass(frozen=True)
class Fit:
    """The outcome of a calibration.

    Attributes:
        status: "converged", "max_iterations", "stalled" or "interrupted".
        estimates: by name of the parameter.
        correlation: (p, p) of the estimates, in the order of `estimates`.
        warnings: sentences on parameters that the tracks do not determine.
        loss: negative log likelihood up to a constant; see `Residuals.loss`.
        noise: m, rad: standard deviation of every kind of observation, given or estimated.
        start: parameters at the start.
        history: evaluations of the coarse fit (which has losses of its own), then of the fit.
        iterations: steps tried.
        runs: in the order of the dataset.
        dataset: what was fitted.
        wall_time: s.
    """

    status: str
    estimates: dict[str, Estimate]
    correlation: Float[np.ndarray, "p p"]
    warnings: tuple[str, ...]
    loss: float
    noise: dict[str, float]
    start: dict[str, float]
    history: tuple[Iteration, ...]
    iterations: int
    runs: tuple[RunFit, ...]
    dataset: Dataset
    wall_time: float

    @property
    def values(self) -> dict[str, float]:
        """The fitted parameters by name, in the units of the scene."""
        return {name: estimate.value for name, estimate in self.estimates.items()}


@dataclass(frozen=True)
class Progress:
    """How far a calibration is.

    Attributes:
        stage: "compile"; "coarse", the fit to the beginning of the tracks; "fit"; "compare",
            the simulation with the parameters of the start.
        iteration: number of this evaluation.
        done: fraction of it that has been simulated.
        seconds_left: of the calibration, estimated; NaN if not known.
        rate: time steps per second; NaN if not known.
        latest: the iteration just completed; None in between.
        values: parameters after that iteration, by name.
    """

    stage: str
    iteration: int = 0
    done: float = 0.0
    seconds_left: float = float("nan")
    rate: float = float("nan")
    latest: Iteration | None = None
    values: dict[str, float] = field(default_factory=dict)


def calibrate(
    dataset: Dataset,
    parameters: Sequence[str] = ("C_t", "C_r"),
    initial: Mapping[str, float] | None = None,
    *,
    progress: Callable[[Progress], None] = lambda progress: None,
    coarse: bool = True,
    compare: bool = True,
    max_iterations: int = 30,
    tolerance: float = 1e-4,
) -> Fit:
    """Fit parameters of the scene to the tracks by least squares.

    Levenberg-Marquardt with exact sensitivities, first on the beginning of the tracks, which
    costs little and comes close, then on the whole of them. Parameters are positive by
    construction. Ctrl-C ends the search and returns the best parameters so far.

    Args:
        dataset: tracks and scene.
        parameters: names, keys of `SceneFile.parameters`.
        initial: where to start; by default the values of the scene.
        progress: called often, from the threads that simulate.
        coarse: whether to begin with a part of the tracks.
        compare: whether to simulate with the parameters of the start as well, for figures.
        max_iterations: of the coarse fit, and of the fit.
        tolerance: the fit has converged when the next step would change no parameter by more
            than this fraction, or by a change that the noise would hide.

    Raises:
        InputError: a parameter that does not exist or a start outside of its range.
        SolverError: the simulation fails with the parameters of the start.
        KeyboardInterrupt: before there was any result.
    """
    begun = time.perf_counter()
    known = dataset.scene.parameters
    chosen = choose(parameters, known)
    for name in initial or {}:
        if name not in chosen.names:
            raise InputError(f"a start is given for {name}, which is not among the parameters")
    start = {name: float({**known, **(initial or {})}[name]) for name in chosen.names}
    free = chosen.free(start)
    calibration = _Calibration(dataset, chosen, progress)
    calibration.compile(free)

    history: list[Iteration] = []
    iterations = 0
    optimum: Optimum[list[Simulated]] | None = None
    fitted = dataset.runs
    beginning = beginning_of(dataset.runs, COARSE)
    stages = [("coarse", beginning)] if coarse and beginning is not None else []
    for stage, runs in [*stages, ("fit", dataset.runs)]:
        here = free if optimum is None else optimum.free
        try:
            found = calibration.search(stage, runs, here, max_iterations, tolerance)
        except KeyboardInterrupt:
            if optimum is None:
                raise
            optimum = replace(optimum, status="interrupted")
            break
        optimum, fitted = found, runs
        history += optimum.history
        iterations += len(optimum.history) - 1
        if optimum.status == "interrupted":
            break
    assert optimum is not None
    before = None
    if compare and optimum.status != "interrupted":
        with contextlib.suppress(KeyboardInterrupt):
            before = calibration.simulate("compare", dataset.runs, free)
    return _summary(calibration, fitted, optimum, start, before, history, iterations, begun)


def beginning_of(runs: Sequence[Run], part: float) -> tuple[Run, ...] | None:
    """The runs up to a common time, `part` of the longest; None if they would be too short."""
    end = part * max(run.time[-1] for run in runs)
    end = max(end, *(run.time[min(COARSE_FRAMES, run.time.size) - 1] for run in runs))
    if end > 0.5 * max(run.time[-1] for run in runs):
        return None
    cut = []
    for run in runs:
        chosen = run.time <= end
        cut.append(replace(run, time=run.time[chosen], values=run.values[chosen]))
    return tuple(cut)


def residuals(runs: Sequence[Run], simulated: Sequence[Simulated], step: float) -> Residuals:
    """Simulation minus tracks, frame by frame, of all runs (m, rad).

    Args:
        runs: tracks.
        simulated: the same motions, simulated.
        step: time step of the simulation, s.
    """
    parts = [_run_residuals(run, sim, step) for run, sim in zip(runs, simulated, strict=True)]
    return Residuals(
        value=np.concatenate([part.value for part in parts]),
        jacobian=np.concatenate([part.jacobian for part in parts]),
        kind=np.concatenate([part.kind for part in parts]),
        sigma=np.concatenate([part.sigma for part in parts]),
        resolution=np.concatenate([part.resolution for part in parts]),
        origins=sum(part.origins for part in parts),
    )


def _run_residuals(run: Run, simulated: Simulated, step: float) -> Residuals:
    at_frames = interpolation(run.time, step)
    channels = list(run.channels)
    value = at_frames(simulated.observed)[:, channels] - run.values
    jacobian = at_frames(simulated.sensitivity)[:, channels]
    place = ~run.is_angle
    if run.free_origin:
        # The best origin for any parameters is the one that makes the mean residual vanish.
        value[:, place] -= value[:, place].mean(axis=0)
        jacobian[:, place] -= jacobian[:, place].mean(axis=0)
    span = np.where(run.is_angle, 1.0, np.ptp(run.values, axis=0).max(where=place, initial=0.0))
    noise = np.where(run.is_angle, run.sigma_angle or np.nan, run.sigma or np.nan)
    frames = (len(run.time), 1)
    return Residuals(
        value=value.ravel(),
        jacobian=jacobian.reshape(value.size, -1),
        kind=np.tile(run.is_angle.astype(int), frames).ravel(),
        sigma=np.tile(noise, frames).ravel(),
        resolution=np.tile(RESOLUTION * span, frames).ravel(),
        origins=int(place.sum()) if run.free_origin else 0,
    )


class _Calibration:
    """The simulator of a dataset, and the clock that says how long it still takes."""

    def __init__(
        self, dataset: Dataset, parameters: Parameters, progress: Callable[[Progress], None]
    ) -> None:
        self.dataset, self.parameters = dataset, parameters
        self.step = dataset.scene.step
        self.rates = [motor_rate(dataset.scene, run) for run in dataset.runs]
        whole = [interpolation(run.time, self.step).n_steps for run in dataset.runs]
        self.whole = sum(whole)
        length = steps_per_call(max(whole))
        self.simulator = Simulator(dataset.scene, parameters, length)
        self.progress = progress
        self.lock = threading.Lock()
        self.steps, self.seconds = 0, 0.0
        self.failure = ""

    def compile(self, free: Float[np.ndarray, " p"]) -> None:
        """Compile the program that all runs share."""
        self.progress(Progress("compile"))
        self.simulator.compile(free, self.rates[0])

    def simulate(
        self, stage: str, runs: Sequence[Run], free: Float[np.ndarray, " p"], iteration: int = 0
    ) -> list[Simulated] | None:
        """All runs, up to their last frames; None if a step fails (`failure` says how)."""
        wanted = [interpolation(run.time, self.step).n_steps for run in runs]
        begun, done = time.perf_counter(), 0

        def on_steps(steps: int) -> None:
            nonlocal done
            with self.lock:
                done += steps
                rate = (self.steps + done) / (self.seconds + time.perf_counter() - begun)
            ahead = max(0, sum(wanted) - done) + self.still_to_come(stage, iteration, sum(wanted))
            part = min(1.0, done / sum(wanted))
            self.progress(Progress(stage, iteration, part, ahead / rate, rate))

        simulated = self.simulator.runs(free, self.rates, wanted, on_steps)
        self.seconds += time.perf_counter() - begun
        self.steps += done
        for run, one in zip(runs, simulated, strict=True):
            if not one.report.ok:
                self.failure = f"run {run.name!r}: {one.report.message()}"
                return None
        return simulated

    def still_to_come(self, stage: str, iteration: int, steps: int) -> float:
        """Steps in the evaluations that usually follow this one, which has so many steps."""
        later = {"coarse": EXPECTED["fit"] + EXPECTED["compare"], "fit": EXPECTED["compare"]}
        more = max(0, EXPECTED[stage] - 1 - iteration)
        return more * steps + later.get(stage, 0) * self.whole

    def search(
        self,
        stage: str,
        runs: Sequence[Run],
        free: Float[np.ndarray, " p"],
        max_iterations: int,
        tolerance: float,
    ) -> Optimum[list[Simulated]]:
        """The best parameters for some runs; `SolverError` if they cannot be simulated."""
        evaluations = 0

        def evaluate(free: Float[np.ndarray, " p"]) -> Trial[list[Simulated]] | None:
            nonlocal evaluations
            simulated = self.simulate(stage, runs, free, evaluations)
            evaluations += 1
            if simulated is None:
                return None
            return Trial(residuals(runs, simulated, self.step), simulated)

        def on_iteration(latest: Iteration) -> None:
            values = self.values(latest.free)
            rate = self.steps / self.seconds
            steps = sum(interpolation(run.time, self.step).n_steps for run in runs)
            left = self.still_to_come(stage, evaluations - 1, steps) / rate
            self.progress(
                Progress(stage, evaluations - 1, 1.0, left, rate, latest=latest, values=values)
            )

        # The coarse fit only has to come close: its optimum is not that of the whole tracks.
        coarse = stage == "coarse"
        optimum = minimise(
            evaluate,
            free,
            max_iterations=max_iterations,
            step_tolerance=max(tolerance, 1e-2) if coarse else tolerance,
            gain_tolerance=0.1 if coarse else 1e-3,
            on_iteration=on_iteration,
        )
        if optimum is None:
            values = ", ".join(f"{k} = {v:.6g}" for k, v in self.values(free).items())
            raise SolverError(f"with {values}: {self.failure} Or start from other parameters.")
        return optimum

    def values(self, free: Float[np.ndarray, " p"]) -> dict[str, float]:
        """The parameters by name."""
        named = self.parameters.values(jnp.asarray(free))
        return {name: float(value) for name, value in named.items()}


def _summary(
    calibration: _Calibration,
    runs: Sequence[Run],
    optimum: Optimum[list[Simulated]],
    start: dict[str, float],
    before: list[Simulated] | None,
    history: list[Iteration],
    iterations: int,
    begun: float,
) -> Fit:
    parameters, fitted = calibration.parameters, optimum.trial.residuals
    known = uncertainty(fitted, parameters.names)
    slopes = parameters.slopes(optimum.free)
    spread = known.quantile * known.std
    with np.errstate(over="ignore"):
        ends = [calibration.values(optimum.free + sign * spread) for sign in (-1, 1)]
    values = calibration.values(optimum.free)
    estimates = {
        name: Estimate(
            values[name], float(slopes[i] * known.std[i]), (ends[0][name], ends[1][name])
        )
        for i, name in enumerate(parameters.names)
    }
    run_fits = []
    for i, (run, after) in enumerate(zip(runs, optimum.trial.model, strict=True)):
        own = _run_residuals(run, after, calibration.step)
        earlier = None if before is None else before[i]
        run_fits.append(RunFit(run, earlier, after, own.value.reshape(run.values.shape), own.rms()))
    return Fit(
        status=optimum.status,
        estimates=estimates,
        correlation=known.correlation,
        warnings=known.warnings,
        loss=fitted.loss(),
        noise=fitted.by_kind(fitted.variances()),
        start=start,
        history=tuple(history),
        iterations=iterations,
        runs=tuple(run_fits),
        dataset=calibration.dataset,
        wall_time=time.perf_counter() - begun,
    )
