"""What a calibration gives."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from .causes import Cause
from .goodness import Goodness
from .levenberg import Iteration
from .simulate import SimulatedTrack
from .tracks import Dataset, Run


@dataclass(frozen=True)
class Estimate:
    """A fitted parameter, in its own unit.

    Attributes:
        value: at the best optimum.
        std: standard error; infinite for a parameter that the tracks do not determine.
        ci95: 95 % interval.
        widened: whether the interval is wider than the curvature at the optimum would make it,
            since values that are further away fit about as well.
    """

    value: float
    std: float
    ci95: tuple[float, float]
    widened: bool = False


@dataclass(frozen=True)
class Alternative:
    """Another optimum that fits nearly as well as the best.

    Attributes:
        values: parameters by name.
        excess: by which its loss is larger.
        implausible: parameters with values that no robot is expected to have, and why not.
    """

    values: dict[str, float]
    excess: float
    implausible: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class RunFit:
    """A run at the start and at the end of the fit.

    Attributes:
        run: the track.
        before: the simulation with the parameters of the start; None if there is none.
        after: with the fitted ones.
        residuals: (f, c) simulation minus track, m and rad, less origin and drift.
        rms: root mean square of the residuals (m, rad) of every kind tracked.
        drift: m/s, fitted, by coordinate; empty if there is none.
    """

    run: Run
    before: SimulatedTrack | None
    after: SimulatedTrack
    residuals: Float[np.ndarray, "f c"]
    rms: dict[str, float]
    drift: dict[str, float]


@dataclass(frozen=True)
class RateFit:
    """Speeds over the rate of the motors, and what the fit makes of them.

    Attributes:
        name: of the table.
        motor_rpm: (n,)
        data: (n, 2) speed (m/s) and head rate (rad/s) that were seen; NaN where there is none.
        std: (n, 2) their noise; NaN where it was estimated.
        fitted: (n, 2) those of the robot with the fitted parameters.
    """

    name: str
    motor_rpm: Float[np.ndarray, " n"]
    data: Float[np.ndarray, "n 2"]
    std: Float[np.ndarray, "n 2"]
    fitted: Float[np.ndarray, "n 2"]

    @property
    def rms(self) -> dict[str, float]:
        """Root mean square of the residuals (m/s, rad/s) of every kind there is."""
        squares = (self.fitted - self.data) ** 2
        names = ("speed", "head_rate")
        return {
            name: float(np.sqrt(np.nanmean(column)))
            for name, column in zip(names, squares.T, strict=True)
            if np.isfinite(column).any()
        }


@dataclass(frozen=True)
class Fit:
    """The outcome of a calibration.

    Attributes:
        status: "converged"; "max_iterations"; "stalled"; "diverged", if the loss falls for ever
            with a parameter and the fit is bad; "interrupted".
        estimates: by name of the parameter.
        correlation: (p, p) of the estimates, in the order of `estimates`.
        goodness: whether the simulation describes the tracks.
        causes: likely reasons if it does not, most likely first.
        alternatives: other optima that fit nearly as well, best first.
        warnings: sentences on all that speaks against taking the estimates as they stand.
        loss: negative log likelihood up to a constant; see `Residuals.loss`.
        noise: m, rad: standard deviation of every kind of observation, given or estimated.
        start: parameters at the start.
        history: evaluations of the fit to whole simulations.
        iterations: steps tried in it.
        previews: simulations of all runs that were cut short, to look for the optimum.
        simulations: of all runs to their ends, to fit them.
        runs: in the order of the dataset.
        dataset: what was fitted.
        wall_time: s.
        rates: speeds, in the order of the dataset.
        nuisances: what else was estimated, by name.
        units: of parameters and nuisances, by name; those of the scene where there are none.
        memory: correlations from frame to frame that were estimated, by kind of observation.
        said: what was decided, in words.
    """

    status: str
    estimates: dict[str, Estimate]
    correlation: Float[np.ndarray, "p p"]
    goodness: Goodness
    causes: tuple[Cause, ...]
    alternatives: tuple[Alternative, ...]
    warnings: tuple[str, ...]
    loss: float
    noise: dict[str, float]
    start: dict[str, float]
    history: tuple[Iteration, ...]
    iterations: int
    previews: int
    simulations: int
    runs: tuple[RunFit, ...]
    dataset: Dataset
    wall_time: float
    rates: tuple[RateFit, ...] = ()
    nuisances: dict[str, Estimate] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    memory: dict[str, float] = field(default_factory=dict)
    said: tuple[str, ...] = ()

    @property
    def values(self) -> dict[str, float]:
        """The fitted parameters by name, in the units of the scene."""
        return {name: estimate.value for name, estimate in self.estimates.items()}


@dataclass(frozen=True)
class Progress:
    """How far a calibration is.

    Attributes:
        stage: "compile"; "explore", the search with previews; "fit", to whole simulations;
            "check", why the fit is bad; "compare", the simulation with the parameters of the start.
        iteration: number of this evaluation within its stage.
        done: fraction of it that has been simulated.
        seconds_left: of the calibration, estimated; NaN if not known.
        rate: time steps per second; NaN if not known.
        latest: the iteration just completed; None in between.
        values: parameters after that iteration, by name.
        said: what was decided before the first of them, in words.
    """

    stage: str
    iteration: int = 0
    done: float = 0.0
    seconds_left: float = float("nan")
    rate: float = float("nan")
    latest: Iteration | None = None
    values: dict[str, float] = field(default_factory=dict)
    said: tuple[str, ...] = ()
