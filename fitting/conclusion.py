"""What follows from a search for parameters: values, errors, and all that speaks against them."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from .causes import Cause
from .explore import NEARLY, Exploration
from .goodness import Goodness, goodness
from .levenberg import Optimum
from .model import Model, predict
from .outcome import Alternative, Estimate, Fit, RunFit
from .plausible import course, implausible, runaway, unlikely
from .residuals import fitted_drift, run_residuals
from .simulate import SimulatedTrack
from .tracks import robot_length
from .uncertainty import Uncertainty, uncertainty

Free = Float[np.ndarray, " p"]

BEYOND = 0.3
"""Part of an interval by which other values must lie outside of it to make it wider."""

CONTRADICTION = (
    "data and model probably contradict each other. Is an axis or the angle reversed (a minus "
    "before the name of a column), do the motors turn the other way (motor_rpm, [robot] "
    "handedness), are the units right (length_unit, pixel_size, time_unit, fps)?"
)
"""What is said of a parameter with which the loss falls for ever."""


def judge(model: Model, best: Optimum[list[SimulatedTrack]]) -> Goodness:
    """What the residuals at the best fit say of it."""
    runs = model.dataset.runs
    values = [
        run_residuals(run, predict(run, one, model.step, period)).value.reshape(run.values.shape)
        for run, one, period in zip(runs, best.trial.model, model.periods, strict=True)
    ]
    return goodness(best.trial.residuals, runs, values, robot_length(model.dataset.scene))


@dataclass(frozen=True)
class Conclusion:
    """All that is known at the end of a calibration.

    Attributes:
        model: of the fit.
        start: parameters, by name.
        exploration: the search for optima; None if there was none.
        optima: of whole simulations, best first.
        goodness: of the best.
        causes: of a bad fit; None if the search for them was interrupted.
    """

    model: Model
    start: dict[str, float]
    exploration: Exploration | None
    optima: tuple[Optimum[list[SimulatedTrack]], ...]
    goodness: Goodness
    causes: tuple[Cause, ...] | None

    @property
    def best(self) -> Optimum[list[SimulatedTrack]]:
        return self.optima[0]

    @property
    def alternatives(self) -> tuple[Alternative, ...]:
        """The other optima that fit nearly as well."""
        found = []
        for other in self.optima[1:]:
            if other.loss <= self.best.loss + NEARLY:
                values = self.model.values(other.free)
                reasons = implausible(self.model.parameters, values, self.start)
                found.append(Alternative(values, other.loss - self.best.loss, reasons))
        return tuple(found)

    def fit(
        self, before: list[SimulatedTrack] | None, previews: int, simulations: int, wall_time: float
    ) -> Fit:
        """The outcome."""
        residuals = self.best.trial.residuals
        known = self.known()
        estimates = self.estimates(known)
        return Fit(
            status=self.best.status,
            estimates=estimates,
            correlation=known.correlation,
            goodness=self.goodness,
            causes=self.causes or (),
            alternatives=self.alternatives,
            warnings=tuple(self.warnings(known, estimates)),
            loss=self.best.loss,
            noise=residuals.by_kind(residuals.variances()),
            start=self.start,
            history=self.best.history,
            iterations=len(self.best.history) - 1,
            previews=previews,
            simulations=simulations,
            runs=tuple(self.runs(before)),
            dataset=self.model.dataset,
            wall_time=wall_time,
        )

    @property
    def held(self) -> np.ndarray:
        """(p,) which parameters were held at their start."""
        count = len(self.best.free)
        return (
            np.zeros(count, bool) if self.exploration is None else np.array(self.exploration.held)
        )

    @property
    def walked(self) -> np.ndarray:
        """(p,) along which parameters all values were looked at."""
        count = len(self.best.free)
        return (
            np.zeros(count, bool) if self.exploration is None else np.array(self.exploration.walked)
        )

    @property
    def change(self) -> Free:
        """(p,) of the free parameters since the start."""
        return self.best.free - self.model.parameters.free(self.start)

    @property
    def gone(self) -> np.ndarray:
        """(p,) with which parameters the search ran away."""
        return runaway(self.best.trial.residuals, self.change) & ~self.held

    def known(self) -> Uncertainty:
        """Errors of the parameters that have an optimum; infinite for others.

        That the held ones may be off by a factor of five either way is part of the errors.
        """
        names, held = np.array(self.model.parameters.names), self.held | self.gone
        residuals = self.best.trial.residuals
        fitted = replace(residuals, jacobian=residuals.jacobian[:, ~held])
        known = uncertainty(fitted, names[~held].tolist())
        if not held.any():
            return known
        std, correlation = np.full(len(held), np.inf), np.eye(len(held))
        std[~held] = known.std
        if self.exploration is not None:
            std[~held] = np.hypot(known.std, self.exploration.spread[~held] / 2)
        correlation[np.ix_(~held, ~held)] = known.correlation
        return Uncertainty(std, known.quantile, correlation, known.warnings)

    def estimates(self, known: Uncertainty) -> dict[str, Estimate]:
        """Values, errors and intervals, as wide as other values fit about as well."""
        free, parameters = self.best.free, self.model.parameters
        std = self.goodness.inflation * known.std
        low, high = free - known.quantile * std, free + known.quantile * std
        lowest, highest, unbounded = self._reached(known.quantile)
        slack = BEYOND * known.quantile * std
        wider = (lowest < low - slack) | (highest > high + slack)
        low = np.where(wider, np.minimum(low, lowest), low)
        high = np.where(wider, np.maximum(high, highest), high)
        std = np.where(unbounded, np.inf, std)
        # Where the search ran away, there is an end at the other side alone.
        low = np.where(self.gone & self.walked & (self.change > 0), lowest, low)
        high = np.where(self.gone & self.walked & (self.change < 0), highest, high)
        values = self.model.values(free)

        def ends(low: Free, high: Free) -> dict[str, tuple[float, float]]:
            with np.errstate(over="ignore"):
                at = self.model.values(low), self.model.values(high)
            return {name: (at[0][name], at[1][name]) for name in values}

        # Where the error is a large part of the value, its two sides differ: the longer one counts.
        one, all_ = ends(free - std, free + std), ends(low, high)
        error = {n: max(values[n] - one[n][0], one[n][1] - values[n]) for n in values}
        reach = {n: max(values[n] - all_[n][0], all_[n][1] - values[n]) for n in values}
        estimates = {}
        for i, name in enumerate(parameters.names):
            size = reach[name] / known.quantile if wider[i] else error[name]
            lost = not np.isfinite(std[i])
            estimates[name] = Estimate(
                values[name], np.inf if lost else size, all_[name], bool(wider[i] or unbounded[i])
            )
        return estimates

    def _reached(self, quantile: float) -> tuple[Free, Free, np.ndarray]:
        """Ends of what fits about as well as the best, and whether a walk ended before it did."""
        free = self.best.free
        inside = [o.free for o in self.optima if o.loss <= self.best.loss + NEARLY]
        unbounded = np.zeros(len(free), bool)
        if self.exploration is not None:
            accepted = self.exploration.accepted(0.5 * quantile**2)
            inside += accepted
            for k in np.flatnonzero(self.exploration.walked):
                if len(accepted):
                    reached = np.array([point[k] for point in accepted])
                    low, high = self.exploration.limits[k]
                    unbounded[k] = reached.min() < low + 0.1 or reached.max() > high - 0.1
        return np.min(inside, axis=0), np.max(inside, axis=0), unbounded

    def warnings(self, known: Uncertainty, estimates: dict[str, Estimate]) -> list[str]:
        """Sentences on all that speaks against taking the estimates as they stand."""
        said = [] if self.goodness.good else [self.goodness.sentence() + "."]
        said += unlikely({name: e.value for name, e in estimates.items() if np.isfinite(e.std)})
        said += [f"Likely cause: {cause.sentence}." for cause in self.causes or ()]
        if self.causes is None:
            said.append("The fit was interrupted before all likely causes of this were tried.")
        if said:
            said.append("The error bars above assume that the model is right; do not rely on them.")
        if remark := self.goodness.remark():
            said.append(remark)
        said = [*self._of_runaways(estimates), *said]
        for other in self.alternatives:
            values = ", ".join(f"{name} = {value:.4g}" for name, value in other.values.items())
            but = ": the tracks hardly decide between the two"
            if other.implausible:
                but = f", but is not plausible: {' and '.join(other.implausible.values())}"
            said.append(f"{values} fits nearly as well (loss higher by {other.excess:.2g}){but}.")
        for name, held in zip(self.model.parameters.names, self.held, strict=True):
            if held:
                said.append(
                    f"{name} hardly matters for these tracks: it was held at its start, "
                    f"{estimates[name].value:.4g}. What a factor of five of it does to the others "
                    "is part of their errors."
                )
        for (name, estimate), gone in zip(estimates.items(), self.gone, strict=True):
            if gone or not estimate.widened:
                continue
            low, high = estimate.ci95
            if np.isinf(estimate.std):
                said.append(
                    f"{name} is not determined by these data: values from {low:.3g} to {high:.3g} "
                    "and beyond fit about as well."
                )
            else:
                said.append(
                    f"The interval of {name} holds all values that fit about as well, {low:.4g} to "
                    f"{high:.4g}; the curvature at the optimum alone would make it narrower."
                )
        return [*said, *known.warnings]

    def _of_runaways(self, estimates: dict[str, Estimate]) -> list[str]:
        """Sentences on parameters with which the loss falls for ever."""
        said = []
        for k in np.flatnonzero(self.gone).tolist():
            name = self.model.parameters.names[k]
            value, (low, high) = estimates[name].value, estimates[name].ci95
            path = course(self.model.parameters, k, self.change[k])
            falls = (
                f"The loss keeps falling as {name} {path}: at {value:.4g}, where the search was "
                f"stopped (it began at {self.start[name]:.4g}), it still fell"
            )
            if not self.goodness.good:
                said.append(f"{falls}. No {name} fits: {CONTRADICTION}")
                continue
            if not self.walked[k]:
                said.append(f"{falls}. The tracks do not say how far it goes.")
                continue
            end, which = (low, "at least") if self.change[k] > 0 else (high, "at most")
            but = f" That is not plausible: {CONTRADICTION}" if unlikely({name: end}) else ""
            said.append(f"{falls}. The tracks only say that {name} is {which} {end:.3g}.{but}")
        return said

    def runs(self, before: list[SimulatedTrack] | None) -> list[RunFit]:
        """What has become of every run."""
        model, fits = self.model, []
        for i, (run, after) in enumerate(
            zip(model.dataset.runs, self.best.trial.model, strict=True)
        ):
            predicted = predict(run, after, model.step, model.periods[i])
            own = run_residuals(run, predicted)
            fits.append(
                RunFit(
                    run,
                    None if before is None else before[i],
                    after,
                    own.value.reshape(run.values.shape),
                    own.rms(),
                    fitted_drift(run, predicted),
                )
            )
        return fits
