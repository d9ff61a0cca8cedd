"""What is compared: tracks that swim steadily, tracks from rest, speeds. Each gives residuals.

A part knows its data, where its numbers stand among all unknowns, and how to predict what was seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..observe import exposed
from ..residuals import RESOLUTION
from ..tracks import Run
from ..uncertainty import KINDS
from .gait import RATES
from .maps import Map, seen, swimming
from .rates import Rates
from .sources import Known

SPEED, HEAD_RATE = KINDS.index("speed"), KINDS.index("head_rate")


@dataclass(frozen=True)
class Rows:
    """Residuals of a part.

    Attributes:
        value: (m,) simulated minus seen, series after series.
        jacobian: (m, p) by the free numbers of all unknowns.
        kind, sigma, resolution: (m,) as of `Residuals`.
        series: (m,) which channel of the part.
        gap: (m,) frames since the row before.
    """

    value: Float[np.ndarray, " m"]
    jacobian: Float[np.ndarray, "m p"]
    kind: Int[np.ndarray, " m"]
    sigma: Float[np.ndarray, " m"]
    resolution: Float[np.ndarray, " m"]
    series: Int[np.ndarray, " m"]
    gap: Float[np.ndarray, " m"]


@dataclass(frozen=True)
class Point:
    """All unknowns, at one point of a search.

    Attributes:
        values: (p,) in their units.
        slopes: (p,) derivatives by free numbers.
        gaits: by the number of a source.
        tracks: of runs from rest, by the number of the part: (f, 4), and (f, 4, k) derivatives by
            free numbers.
    """

    values: Float[np.ndarray, " p"]
    slopes: Float[np.ndarray, " p"]
    gaits: dict[int, Known]
    tracks: dict[int, tuple[np.ndarray, np.ndarray]]


class Part(Protocol):
    """Data that are compared with a simulation."""

    name: str

    def rows(self, point: Point) -> Rows: ...


@dataclass(frozen=True)
class TrackPart:
    """A track.

    Attributes:
        run: the track.
        source: number of the gait; None for a track from rest.
        varied: places of the numbers by which the gait, or the track from rest, changes.
        start: places of phase and roll; None for a track from rest, or a phase that says nothing.
        maps: from the track of the robot to what is seen.
        mapped: places of their numbers.
        averaged: which motions of the head are averaged over: in a turn of the motors, and round
            the axis; their phase cannot be told over the whole track.
    """

    run: Run
    source: int | None
    varied: tuple[int, ...]
    start: tuple[int | None, int | None]
    maps: tuple[Map, ...]
    mapped: tuple[int, ...]
    averaged: tuple[bool, bool] = (False, False)

    @property
    def name(self) -> str:
        return self.run.name

    def known(self, point: Point) -> Known:
        """The gait, without motions that are averaged over."""
        assert self.source is not None
        found = point.gaits[self.source]
        if not any(self.averaged):
            return found
        kept = kept_of(len(found.gait), self.averaged)
        return Known(found.gait * kept, found.jacobian * kept[:, None])

    def clock(self, time: np.ndarray) -> np.ndarray:
        """s, since the first frame of a track that starts steady; since the motor's start else."""
        return time if self.source is None else time - self.run.time[0]

    def base(self, point: Point, own: int, time: np.ndarray) -> tuple[Any, Any, tuple[int, ...]]:
        """The track of the robot at times (s), its derivatives by free numbers, and their places.

        Of a track from rest only that at the frames is known.
        """
        if self.source is None:
            track, columns = point.tracks[own]
            return jnp.asarray(track), jnp.asarray(columns), self.varied
        known = self.known(point)
        begin = jnp.array([0.0 if k is None else point.values[k] for k in self.start])
        gait, since = jnp.asarray(known.gait), self.clock(time)
        track, by_gait, by_start = exposed(
            lambda at: swimming(gait, jnp.asarray(at), begin), since, self.run.exposure
        )
        columns = by_gait @ (known.jacobian * point.slopes[list(self.varied)])
        places = [(k, place) for k, place in enumerate(self.start) if place is not None]
        chosen = by_start[..., [k for k, _ in places]]
        slopes = point.slopes[[place for _, place in places]]
        both = jnp.concatenate([columns, chosen * slopes], axis=-1)
        return track, both, (*self.varied, *(place for _, place in places))

    def predicted(
        self, point: Point, own: int, time: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """What is seen at the frames, or at other times (s): (f, 4), and (f, 4, p) derivatives."""
        time = self.run.time if time is None else time
        track, columns, places = self.base(point, own, time)
        numbers = jnp.asarray(point.values[list(self.mapped)])
        clock = jnp.asarray(self.clock(time))
        observed, moved, by_numbers = seen(self.maps, track, columns, clock, numbers)
        jacobian = np.zeros((len(time), 4, len(point.values)))
        for k, place in enumerate(places):
            jacobian[..., place] += np.asarray(moved)[..., k]
        slopes = point.slopes[list(self.mapped)]
        for k, place in enumerate(self.mapped):
            jacobian[..., place] += np.asarray(by_numbers)[..., k] * slopes[k]
        return np.asarray(observed), jacobian

    def rows(self, point: Point, own: int = 0) -> Rows:
        run = self.run
        observed, jacobian = self.predicted(point, own)
        channels = list(run.channels)
        value = observed[:, channels] - run.values
        place = ~run.is_angle
        span = np.where(run.is_angle, 1.0, np.ptp(run.values, axis=0).max(where=place, initial=0.0))
        sigma = np.where(run.is_angle, run.sigma_angle or np.nan, run.sigma or np.nan)
        frames, count = value.shape
        gaps = np.diff(run.time, prepend=run.time[0])
        typical = np.median(gaps[1:]) if frames > 1 else 1.0
        return Rows(
            value=value.T.ravel(),
            jacobian=jacobian[:, channels].transpose(1, 0, 2).reshape(frames * count, -1),
            kind=np.repeat(run.is_angle.astype(int), frames),
            sigma=np.repeat(sigma, frames),
            resolution=np.repeat(RESOLUTION * span, frames),
            series=np.repeat(np.arange(count), frames),
            gap=np.tile(gaps / typical, count),
        )

    def table(self, rows: np.ndarray) -> np.ndarray:
        """(f, c) of something in the order of the rows."""
        return rows.reshape(len(self.run.channels), -1).T


@dataclass(frozen=True)
class RatesPart:
    """Speeds.

    Attributes:
        rates: the speeds.
        sources: numbers of the gaits, one for each rate.
        varied: places of the numbers by which each gait changes.
        discrepancy: places of by how much the model is off; empty if it is right.
        senses: of speed and head rate: -1 if they are given with the opposite sign, as sizes are.
    """

    rates: Rates
    sources: tuple[int, ...]
    varied: tuple[tuple[int, ...], ...]
    discrepancy: tuple[int, ...] = ()
    senses: tuple[float, float] = (1.0, 1.0)

    @property
    def name(self) -> str:
        return self.rates.name

    def predicted(self, point: Point) -> tuple[np.ndarray, np.ndarray]:
        """(n, 2) speed and head rate, and (n, 2, p) derivatives by free numbers."""
        count = len(self.sources)
        value = np.zeros((count, 2))
        jacobian = np.zeros((count, 2, len(point.values)))
        off = point.values[list(self.discrepancy)] if self.discrepancy else np.zeros(2)
        for k, (source, varied) in enumerate(zip(self.sources, self.varied, strict=True)):
            known = point.gaits[source]
            two = np.array([0, RATES - 2])
            plain = known.gait[two] * np.array(self.senses)
            value[k] = (1 + off) * plain
            by = known.jacobian[two] * (np.array(self.senses) * (1 + off))[:, None]
            jacobian[k][:, list(varied)] += by * point.slopes[list(varied)]
            for channel, place in enumerate(self.discrepancy):
                jacobian[k, channel, place] += plain[channel] * point.slopes[place]
        return value, jacobian

    def data(self) -> tuple[np.ndarray, np.ndarray]:
        """(n, 2) speed and head rate that were seen, and their noise."""
        rates = self.rates
        seen_ = np.stack([rates.speed, rates.head_rate], axis=1)
        return seen_, np.stack([rates.speed_std, rates.head_rate_std], axis=1)

    def rows(self, point: Point, own: int = 0) -> Rows:
        value, jacobian = self.predicted(point)
        data, sigma = self.data()
        there = np.isfinite(data).T.ravel()
        count = len(self.sources)
        kind = np.repeat([SPEED, HEAD_RATE], count)
        size = np.repeat(np.nanmax(np.abs(np.where(np.isfinite(data), data, 0.0)), axis=0), count)
        return Rows(
            value=(value - data).T.ravel()[there],
            jacobian=jacobian.transpose(1, 0, 2).reshape(2 * count, -1)[there],
            kind=kind[there],
            sigma=sigma.T.ravel()[there],
            resolution=(RESOLUTION * size)[there],
            series=np.arange(2 * count)[there],
            gap=np.ones(int(there.sum())),
        )


def kept_of(size: int, averaged: tuple[bool, bool]) -> np.ndarray:
    """(g,) 1 for numbers of a gait that count, 0 for those of motions that are averaged over."""
    path = np.ones(((size - RATES) // 4, 4))
    if averaged[0]:
        path[1:] = 0.0
    if averaged[1]:
        path[:, 1:3] = 0.0
    return np.concatenate([np.ones(RATES), path.ravel()])


def joined(parts: Sequence[Rows]) -> Rows:
    """Rows of all parts, each with series of its own."""
    series, first = [], 0
    for part in parts:
        series.append(part.series + first)
        first += int(part.series.max(initial=-1)) + 1
    names = ("value", "jacobian", "kind", "sigma", "resolution", "gap")
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return Rows(series=np.concatenate(series), **arrays)
