"""Why a fit is bad: what people have most often told the program wrongly, tried one by one.

Every cause is a change of the tracks, or of the sense of the motor, after which the parameters are
fitted again with the cheap model. A cause with which the fit is much better is named together with
the key of the dataset file that would say so.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Array, Float

from .levenberg import Evaluation, Optimum, minimise
from .model import Model, predict
from .observe import ANGLE, CHANNELS
from .residuals import fitted_drift
from .simulate import SimulatedTrack
from .tracks import Run
from .uncertainty import linear_fit, shifted

Free = Float[np.ndarray, " p"]

MUCH_BETTER = 10.0
"""Gain in log likelihood for which a cause is named."""

COST_OF_DRIFT = 3.0
"""Gain in log likelihood that every coordinate of a drift has to be worth."""

ABSURD = float(np.log(25.0))
"""A cause that needs a free parameter to be so far from its start is none."""

MOST_ITERATIONS = 8
"""Of the search with a cause. A search in vain need not be exact."""


@dataclass(frozen=True)
class Cause:
    """A likely reason of a bad fit.

    Attributes:
        sentence: what would make the fit better, by how much, and the key that would say so.
        gain: in log likelihood.
    """

    sentence: str
    gain: float


@dataclass(frozen=True)
class _Hypothesis:
    """What may have been said wrongly: the tracks as they would be, and the words for it."""

    what: str
    key: str
    runs: tuple[Run, ...]
    scale: float = 1.0
    reversed_motor: bool = False


def likely_causes(
    model: Model, start: Free, best: Optimum[list[SimulatedTrack]]
) -> tuple[Cause, ...]:
    """Causes with which the fit would be much better, best first.

    Args:
        model: of the fit.
        start: (p,) free parameters of the start.
        best: where the fit ended, by previews or by whole simulations.

    Raises:
        KeyboardInterrupt: before all were tried.
    """
    points = [best.free, start]
    found: list[Cause] = []
    for hypothesis in [*_of_tracks(model.dataset.runs), *_of_motor(model)]:
        here = model
        if hypothesis.reversed_motor:
            here = model.of(replace(model.dataset, runs=hypothesis.runs))
        found += _tried(here, hypothesis, points, best)
    found += _scale(model, points, best)
    found.sort(key=lambda cause: -cause.gain)
    return tuple(c for c in found if c.gain > 0.5 * found[0].gain)


def _of_tracks(runs: Sequence[Run]) -> list[_Hypothesis]:
    channels = sorted({channel for run in runs for channel in run.channels})
    places = [c for c in channels if c != ANGLE]
    hypotheses = []
    if places and not all(run.drift for run in runs):
        hypotheses.append(
            _Hypothesis(
                "a steady drift",
                "if the fluid flows or the robot rises or sinks, say drift = true in [[runs]]",
                tuple(replace(run, drift=True) for run in runs),
            )
        )
    if ANGLE in channels:
        hypotheses.append(
            _Hypothesis(
                "another zero of the head angle",
                "head_angle is counted from where the head is when the motor starts; say "
                "nuisances = { angle_origin = {} } in [[runs]] to estimate its zero with the rest, "
                "and time_offset if the film begins later",
                tuple(replace(run, free_angle=True) for run in runs),
            )
        )
    for turned in [(c,) for c in channels] + [(c, ANGLE) for c in places if ANGLE in channels]:
        names = " and ".join(CHANNELS[c] for c in turned)
        keys = ", ".join(f'{CHANNELS[c]} = "-..."' for c in turned)
        hypotheses.append(
            _Hypothesis(
                f"{names} reversed",
                f"a minus before the name of a column says so: columns = {{ {keys} }}",
                tuple(_reversed(run, turned) for run in runs),
            )
        )
    return hypotheses


def _of_motor(model: Model) -> list[_Hypothesis]:
    dataset = model.dataset
    if dataset.scene.motor_table is not None:
        return []
    runs = tuple(
        replace(run, motor_rpm=_negative(rate))
        for run, rate in zip(dataset.runs, model.rates, strict=True)
    )
    return [
        _Hypothesis(
            "the motors turning the other way",
            "change the sign of motor_rpm, or the [robot] handedness",
            runs,
            reversed_motor=True,
        )
    ]


def _negative(rate: Array) -> float | tuple[float, ...]:
    rates = -np.asarray(rate, float)
    return float(rates) if rates.ndim == 0 else tuple(rates.tolist())


def _reversed(run: Run, channels: Sequence[int]) -> Run:
    signs = np.where(np.isin(run.channels, channels), -1.0, 1.0)
    return replace(run, values=run.values * signs)


def _search(
    model: Model, runs: Sequence[Run], points: Sequence[Free]
) -> Optimum[list[SimulatedTrack]] | None:
    """The best parameters for some tracks, from the more promising of several points."""

    def evaluate(free: Free) -> Evaluation[list[SimulatedTrack]] | None:
        return model.preview(free, runs)

    promises = []
    for point in points:
        trial = evaluate(point)
        if trial is not None:
            change = np.clip(linear_fit(trial.residuals), -1.0, 1.0)
            promises.append((shifted(trial.residuals, change).loss(), len(promises), point))
    if not promises:
        return None
    found = minimise(
        evaluate,
        min(promises)[2],
        max_iterations=MOST_ITERATIONS,
        step_tolerance=1e-2,
        gain_tolerance=0.1,
    )
    if found is not None and found.status == "interrupted":
        raise KeyboardInterrupt
    return found


def _tried(
    model: Model,
    hypothesis: _Hypothesis,
    points: Sequence[Free],
    best: Optimum[list[SimulatedTrack]],
) -> list[Cause]:
    """The cause that a hypothesis is, if the fit with it is much better."""
    found = _search(model, hypothesis.runs, points)
    if found is None:
        return []
    # A track in other units has residuals, and noise, in those.
    places = sum(int((~run.is_angle).sum()) * len(run.time) for run in hypothesis.runs)
    loss = found.loss
    if any(run.sigma is None for run in hypothesis.runs):
        loss -= places * np.log(hypothesis.scale)
    drifts = sum(int((~run.is_angle).sum()) for run in hypothesis.runs if run.drift)
    gain = best.loss - loss - COST_OF_DRIFT * drifts
    if gain < MUCH_BETTER or np.abs(found.free - points[-1]).max() > ABSURD:
        return []
    drift = _drift(model, hypothesis.runs, found)
    sentence = (
        f"with {hypothesis.what}{drift} the fit would be much better (loss lower by {gain:.4g}): "
        f"{hypothesis.key}"
    )
    return [Cause(sentence, gain)]


def _drift(model: Model, runs: Sequence[Run], found: Optimum[list[SimulatedTrack]]) -> str:
    """The drift of the first run in words, if it has one."""
    drift = fitted_drift(
        runs[0], predict(runs[0], found.trial.model[0], model.step, model.periods[0])
    )
    if not drift:
        return ""
    parts = ", ".join(f"{1e3 * v:.3g} mm/s along {axis}" for axis, v in drift.items())
    return f" ({parts})"


def _scale(
    model: Model, points: Sequence[Free], best: Optimum[list[SimulatedTrack]]
) -> list[Cause]:
    """Whether the tracks are in another unit of length.

    The factor is the one that makes displacements those of the simulation with the parameters of
    the start, and then of the best fit with it, twice.
    """
    runs = model.dataset.runs
    if all(run.is_angle.all() for run in runs):
        return []
    trial = model.preview(points[-1])
    factor = 1.0
    for _ in range(3):
        if trial is None:
            return []
        factor = _factor(model, runs, trial.model)
        if not (np.isfinite(factor) and factor > 0):
            return []
        scaled = tuple(_scaled(run, factor) for run in runs)
        found = _search(model, scaled, points[-1:])
        trial = None if found is None else found.trial
    hypothesis = _Hypothesis(
        f"all positions {factor:.4g} times as large",
        f"another length_unit, or pixel_size = {factor:.3g} for a table in pixels",
        tuple(_scaled(run, factor) for run in runs),
        scale=factor,
    )
    return _tried(model, hypothesis, points[-1:], best)


def _factor(model: Model, runs: Sequence[Run], simulated: Sequence[SimulatedTrack]) -> float:
    """By what displacements of tracks are multiplied to be most like those of the simulation."""
    products = []
    for run, one, period in zip(runs, simulated, model.periods, strict=True):
        channels = [c for c in run.channels if c != ANGLE]
        seen = predict(run, one, model.step, period).observed[:, channels]
        track = run.values[:, ~run.is_angle]
        seen, track = seen - seen.mean(axis=0), track - track.mean(axis=0)
        products.append((np.sum(seen * track), np.sum(track * track)))
    both, own = np.sum(products, axis=0)
    return float(both / own) if own > 0 else float("nan")


def _scaled(run: Run, factor: float) -> Run:
    """The track with other lengths; positions relative to a scene stay so."""
    values = run.values * np.where(run.is_angle, 1.0, factor)
    sigma = None if run.sigma is None else run.sigma * factor
    return replace(run, values=values, sigma=sigma, free_origin=True)
