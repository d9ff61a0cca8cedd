"""A dataset as one least-squares problem: parts, unknowns, and their residuals at any point."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from derjax import SceneFile, SolverError

from ..levenberg import Evaluation
from ..model import Model, predict
from ..noise import PRIOR, NoisyResiduals
from ..tracks import Dataset, Run
from ..transforms import select_parameters
from .gaitstore import GaitStore
from .parts import Point, RatesPart, Rows, TrackPart, joined
from .sources import Known, Source
from .unknowns import Unknowns

Free = Float[np.ndarray, " p"]

OFFSET = 1e-4
"""s, change of a time offset for its derivative."""


@dataclass(frozen=True)
class FromRest:
    """Tracks from rest of one robot, which are simulated together.

    Attributes:
        model: of their runs.
        parts: their numbers.
        varied: places of the parameters that the model varies.
        offsets: places of the time offsets of the parts; None where the time is known.
    """

    model: Model
    parts: tuple[int, ...]
    varied: tuple[int, ...]
    offsets: tuple[int | None, ...]


@dataclass(frozen=True)
class Sourced:
    """A gait that is asked for.

    Attributes:
        source: what finds it.
        varied: places of its numbers.
        label: what is said of it if there is none.
    """

    source: Source
    varied: tuple[int, ...]
    label: str


class Problem:
    """Residuals of all data, as a function of all unknowns.

    Attributes:
        dataset: what is fitted.
        names: parameters that were asked for.
        unknowns: all numbers that are estimated.
        parts: what is compared.
        sources: gaits.
        rest: tracks that are simulated from rest.
        said: what was decided, in words.
        failure: why the last evaluation gave nothing.
        evaluations: so far.
        kept: gaits that have been found, for a fit that is interrupted and started again.
    """

    def __init__(
        self,
        dataset: Dataset,
        names: Sequence[str],
        unknowns: Unknowns,
        parts: Sequence[TrackPart | RatesPart],
        sources: Sequence[Sourced],
        rest: Sequence[FromRest],
        said: Sequence[str],
        store: Path | None = None,
    ) -> None:
        self.dataset, self.names, self.unknowns = dataset, tuple(names), unknowns
        self.parts, self.sources, self.rest = tuple(parts), tuple(sources), tuple(rest)
        self.said, self.failure, self.evaluations = tuple(said), "", 0
        self.on_evaluation: Callable[[], None] = lambda: None
        self.kept = GaitStore(store)
        self._last: tuple[bytes, bool, Point] | None = None

    @property
    def dear(self) -> Bool[np.ndarray, " p"]:
        """Which numbers gaits or simulations depend on."""
        mask = np.zeros(len(self.unknowns.every), bool)
        for sourced in self.sources:
            mask[list(sourced.varied)] = True
        for group in self.rest:
            mask[[*group.varied, *(place for place in group.offsets if place is not None)]] = True
        return mask

    def moved(self, point: Point, free: Free) -> Evaluation[Point]:
        """Residuals where only numbers have changed that no gait and no simulation depends on."""
        there = replace(point, values=self.unknowns.values(free), slopes=self.unknowns.slopes(free))
        return Evaluation(self.residuals(there, free), there)

    def point(self, free: Free, whole: bool = False) -> Point | None:
        """Gaits and tracks at a point; None where there are none (`failure` says why)."""
        key = np.asarray(free, float).tobytes()
        if self._last is not None and self._last[:2] == (key, whole):
            return self._last[2]
        values, slopes = self.unknowns.values(free), self.unknowns.slopes(free)
        self.evaluations += 1
        try:
            gaits = self._gaits(values)
            tracks = self._tracks(free, values, whole)
        except SolverError as error:
            self.failure = str(error)
            return None
        found = Point(values, slopes, gaits, tracks)
        self._last = key, whole, found
        self.on_evaluation()
        return found

    def _gaits(self, values: np.ndarray) -> dict[int, Known]:
        def one(sourced: Sourced) -> Known:
            chosen = values[list(sourced.varied)]
            if (kept := self.kept.get(sourced.label, chosen)) is not None:
                return kept
            try:
                found = sourced.source(chosen)
            except SolverError as error:
                raise SolverError(f"{sourced.label}: {error}") from None
            self.kept.put(sourced.label, chosen, found)
            return found

        with ThreadPoolExecutor(max(1, min(len(self.sources), os.cpu_count() or 1))) as pool:
            return dict(enumerate(pool.map(one, self.sources)))

    def _tracks(
        self, free: Free, values: np.ndarray, whole: bool
    ) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        found = {}
        for group in self.rest:
            at = free[list(group.varied)]
            trial = group.model.whole(at) if whole else group.model.preview(at)
            if trial is None:
                raise SolverError(group.model.failure)
            rows = zip(group.parts, group.offsets, trial.model, group.model.periods, strict=True)
            for number, offset, simulated, period in rows:
                part = self.parts[number]
                assert isinstance(part, TrackPart)

                def at_offset(
                    seconds: float,
                    run=part.run,
                    simulated=simulated,
                    step=group.model.step,
                    period=period,
                ) -> tuple[np.ndarray, np.ndarray]:
                    time = np.maximum(run.time + seconds, 0.0)
                    if period is None:
                        last = step * (len(simulated.time) - 3) - 0.5 * run.exposure
                        time = np.minimum(time, last)
                    seen = predict(replace(run, time=time), simulated, step, period)
                    return seen.observed, seen.sensitivity

                late = 0.0 if offset is None else float(values[offset])
                observed, columns = at_offset(late)
                if offset is not None:
                    rate = (at_offset(late + OFFSET)[0] - at_offset(late - OFFSET)[0]) / 2 / OFFSET
                    slope = float(self.unknowns.slopes(free)[offset])
                    columns = np.concatenate([columns, slope * rate[..., None]], axis=-1)
                found[number] = observed, columns
        return found

    def rows(self, point: Point) -> Rows:
        """Residuals of all parts."""
        return joined([part.rows(point, k) for k, part in enumerate(self.parts)])

    def residuals(self, point: Point, free: Free) -> NoisyResiduals:
        """Residuals of all parts and of what is known beforehand."""
        rows, priors = self.rows(point), self.priors(point)
        count = len(rows.value)
        noise = self.dataset.noise
        n = len(priors.value)
        return NoisyResiduals(
            value=np.r_[rows.value, priors.value],
            jacobian=np.concatenate([rows.jacobian, priors.jacobian]),
            kind=np.r_[rows.kind, np.full(n, PRIOR)],
            sigma=np.r_[rows.sigma, priors.sigma],
            resolution=np.r_[rows.resolution, np.zeros(n)],
            series=np.r_[rows.series, count + np.arange(n)],
            gap=np.r_[rows.gap, np.ones(n)],
            shape=noise.shape,
            correlated=noise.correlated,
        )

    def priors(self, point: Point) -> Rows:
        """Numbers minus what is known of them."""
        known = [(k, u.mean, u.std) for k, u in enumerate(self.unknowns.every) if u.std is not None]
        places = [k for k, _, _ in known]
        jacobian = np.zeros((len(known), len(point.values)))
        jacobian[np.arange(len(known)), places] = point.slopes[places]
        means = np.array([mean for _, mean, _ in known], float)
        blank = np.zeros(len(known))
        return Rows(
            point.values[places] - means,
            jacobian,
            blank.astype(int),
            np.array([std for _, _, std in known], float),
            blank,
            blank.astype(int),
            blank,
        )

    def evaluate(self, free: Free, whole: bool = False) -> Evaluation[Point] | None:
        """Residuals at a point, for a search."""
        point = self.point(free, whole)
        return None if point is None else Evaluation(self.residuals(point, free), point)


def model_from_rest(
    scene: SceneFile, runs: Sequence[Run], names: Sequence[str], store: Path | None
) -> Model:
    """A model of tracks from rest of one robot, some of which may begin later than is said."""
    chosen = select_parameters(names, scene.single_numbers)
    return Model(Dataset(scene, tuple(runs)), chosen, store=store)
