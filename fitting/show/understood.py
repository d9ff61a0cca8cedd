"""What is understood of a track, and what is odd about it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from derjax import InputError

from ..datasetfile import ANGLE_UNITS, LENGTH_UNITS, RunFile
from ..observe import ANGLE, CHANNELS
from ..reading import Seen, Track, in_si, rows_of
from ..settle import Settled, settle

WINDOW = 3
"""Pairs of frames with which a position is compared."""

ODD = 10.0
"""Usual deviations from these neighbours beyond which a position is an outlier."""

MISSED = 1.5
"""Usual steps in time beyond which frames are missing."""

MOST_SHOWN = 5
"""Gaps and outliers that are listed at most."""

PIXELS = 100.0
"""Positive coordinates that go beyond this are pixels rather than millimetres."""


@dataclass(frozen=True)
class Understood:
    """A track, and how it was read.

    Attributes:
        path: of the file.
        run: the keys that were given.
        settled: how it is read, and what has to be asked for.
        rows: of the object that is followed.
        track: its frames.
        outliers: (f, c) values far from those around them.
    """

    path: Path
    run: RunFile
    settled: Settled
    rows: Seen
    track: Track
    outliers: Bool[np.ndarray, "f c"]

    @property
    def keys(self) -> RunFile:
        """How the track is read, with stand-ins for what is asked for."""
        return self.settled.keys

    @property
    def asked(self) -> set[str]:
        """Keys that have to be given."""
        return {one.key for one in self.settled.asked}

    @property
    def length_unit(self) -> str:
        """The unit in which positions are shown."""
        return "px" if "pixel_size" in self.asked else self.keys.length_unit

    @property
    def time_unit(self) -> str:
        """The unit in which times are shown."""
        return "frames" if "fps" in self.asked else "s"

    def shown(self, column: int) -> Float[np.ndarray, " f"]:
        """A channel as it is shown: in `length_unit`, or in rad."""
        values = self.track.values[:, column]
        if self.track.channels[column] == ANGLE:
            return values
        return values / (
            self.keys.length if self.length_unit == "px" else LENGTH_UNITS[self.length_unit]
        )

    @property
    def gaps(self) -> list[tuple[float, float, int]]:
        """Between which times frames are missing, and how many."""
        steps = np.diff(self.track.time)
        usual = self.usual_step
        long = np.flatnonzero(steps > MISSED * usual)
        return [
            (float(self.track.time[k]), float(self.track.time[k + 1]), round(steps[k] / usual) - 1)
            for k in long
        ]

    @property
    def usual_step(self) -> float:
        """Between frames, s."""
        return float(np.median(np.diff(self.track.time)))


def understand(path: Path, run: RunFile) -> Understood:
    """Read a track as far as it says how.

    Raises:
        InputError: it cannot be read, whatever the keys are that are asked for.
    """
    settled = settle(path, run)
    if any(one.key == "columns" for one in settled.asked):
        raise InputError("\n".join(one.sentence for one in settled.asked))
    rows = rows_of(settled)
    track = in_si(settled, rows)
    return Understood(path, run, settled, rows, track, outliers(track.time, track.values))


def outliers(
    time: Float[np.ndarray, " f"], values: Float[np.ndarray, "f c"]
) -> Bool[np.ndarray, "f c"]:
    """Values that are much farther from where those around them lead to than others are.

    Where they lead to is the median of straight lines through pairs of neighbours, one to either
    side or, at the ends, both on one.
    """
    count, here = len(time), np.arange(len(time))
    lines = []
    for k in range(1, WINDOW + 1):
        before = np.where(here < k, here + k, here - k)
        after = np.where(here < k, here + 2 * k, here + k)
        last = here >= count - k
        before, after = np.where(last, here - 2 * k, before), np.where(last, here - k, after)
        part = (time - time[before]) / (time[after] - time[before])
        lines.append(values[before] + part[:, None] * (values[after] - values[before]))
    away = np.abs(values - np.median(lines, axis=0))
    usual = np.median(away, axis=0)
    least = 0.1 * np.median(np.abs(np.diff(values, axis=0)), axis=0)  # a whole step is odd
    least = np.maximum(least, 1e-6 * np.ptp(values, axis=0))
    return np.asarray(away > ODD * np.maximum(usual, least))


def table(one: Understood) -> str:
    """What was understood, one line a fact."""
    settled, keys, track = one.settled, one.keys, one.track
    lines = [("format", f"{settled.format.name}: {settled.format.title}")]
    lines.append(("written", settled.layout.table.describe()))
    lines.append(("clock", _clock(one)))
    assert keys.columns is not None
    lines += [(channel, _column(one, channel)) for channel in keys.columns.tracked]
    if len(settled.objects) > 1:
        counts = [f"{name or 'none'} ({n} rows)" * bool(n) or name
                  for name, n in settled.objects.items()]  # fmt: skip
        more = ", ..." if len(counts) > 2 * MOST_SHOWN else ""
        lines.append(("tracks", ", ".join(counts[: 2 * MOST_SHOWN]) + more))
    usual = f"{one.usual_step:.6g} {one.time_unit}"
    ends = f"{track.time[0]:.6g} to {track.time[-1]:.6g} {one.time_unit}"
    lines.append(("frames", f"{len(track.time)} from {ends}, usually {usual} apart"))
    missing = sum(count for *_, count in one.gaps)
    where = [f"{count} after {start:.6g} {one.time_unit}" for start, _, count in one.gaps]
    lines.append(("gaps", f"{missing} frames: {_some(where)}" if missing else "none"))
    odd = [
        f"{CHANNELS[track.channels[c]]} at {track.time[f]:.6g} {one.time_unit} "
        f"(line {_line(one, f)})"
        for f, c in zip(*np.nonzero(one.outliers), strict=True)
    ]
    lines.append(("outliers", f"{len(odd)}: {_some(odd)}" if odd else "none"))
    width = max(len(name) for name, _ in lines)
    shown = [f"  {name:<{width}}  {text}" for name, text in lines]
    shown += [f"  - {sentence}" for sentence in track.said[1:]]
    shown += [f"  ? {_without(one.path, question.sentence)}" for question in settled.asked]
    return "\n".join([str(one.path), *shown])


def _clock(one: Understood) -> str:
    keys = one.keys
    assert keys.columns is not None
    said = f"column {keys.columns.t!r}"
    if "fps" in one.asked:
        return f"{said}, frames; how many in a second is not known"
    return (
        f"{said}, frames, {keys.fps:.6g} in a second" if keys.fps else f"{said}, {keys.time_unit}"
    )


def _column(one: Understood, channel: str) -> str:
    """Where a channel stands, its unit, and its range there."""
    keys = one.keys
    assert keys.columns is not None
    names = list(keys.columns.tracked)
    raw = one.rows.values[one.rows.found, names.index(channel)]
    span = f"{raw.min():.6g} to {raw.max():.6g}"
    said = f"column {keys.columns.tracked[channel]!r}, {span}"
    if channel == CHANNELS[ANGLE]:
        turns = np.ptp(raw) * ANGLE_UNITS[keys.angle_unit] / (2 * np.pi)
        return f"{said} {keys.angle_unit} ({turns:.3g} turns)"
    if "pixel_size" in one.asked:
        places = one.rows.values[one.rows.found][:, [name != CHANNELS[ANGLE] for name in names]]
        pixels = places.min() >= 0 and places.max() > PIXELS
        known = one.settled.layout.unit == "px"
        return f"{said}, {'pixels' if known else 'no unit: ' + _guess(bool(pixels))}"
    if keys.pixel_size is not None:
        return f"{said} pixels of {keys.pixel_size:g} {keys.length_unit}"
    return f"{said} {keys.length_unit}"


def _guess(pixels: bool) -> str:
    return "they look like pixels" if pixels else "they do not look like pixels"


def _line(one: Understood, frame: int) -> int:
    """The line of the file that a frame of the track is from."""
    at = np.flatnonzero(one.rows.found & (one.rows.time == one.track.time[frame]))
    return int(one.rows.lines[at[0]])


def _some(items: list[str]) -> str:
    more = ", ..." if len(items) > MOST_SHOWN else ""
    return ", ".join(items[:MOST_SHOWN]) + more


def _without(path: Path, sentence: str) -> str:
    return sentence.removeprefix(f"{path}: ")
