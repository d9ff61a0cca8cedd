"""Reading tracks: from the rows of a table to times and positions in SI units."""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from derjax import InputError
from derjax.core.errors import InputWarning
from derjax.io.tables import Numbers

from .clock import ROUNDING, check_distinct, check_no_jump, check_one_recording, selected, times
from .datasetfile import ANGLE_UNITS, Columns, RunFile
from .formats.layout import signed, unit_in_header
from .gaps import lost, one_each, unwrapped
from .observe import ANGLE, CHANNELS
from .settle import Settled, settle

MIN_FRAMES = 10

Rows = Bool[np.ndarray, " r"]


@dataclass(frozen=True)
class Track:
    """The frames of a track that are to be compared, in order.

    Attributes:
        time: (f,) s since the motor started, increasing.
        values: (f, c) m and rad, in the axes of the robot.
        channels: (c,) which of `CHANNELS` they are, in order.
        dropped: how many frames are left out as something in them was not tracked.
        keys: how the table was read, with nothing left open.
        said: what was decided on the way, as sentences.
        sight: the axis along which the camera looks, of tracks of silhouettes.
    """

    time: Float[np.ndarray, " f"]
    values: Float[np.ndarray, "f c"]
    channels: tuple[int, ...]
    dropped: int
    keys: RunFile
    said: tuple[str, ...] = ()
    sight: int | None = None


@dataclass(frozen=True)
class Seen:
    """The rows of a track in the order of time, as they stand in the table.

    Attributes:
        time: (r,) s since the motor started.
        values: (r, c) of the columns that were tracked, in their own units and axes.
        lines: (r,) of the file.
        found: rows with everything in them.
        said: what was decided, as sentences.
    """

    time: Float[np.ndarray, " r"]
    values: Float[np.ndarray, "r c"]
    lines: Int[np.ndarray, " r"]
    found: Rows
    said: tuple[str, ...]


def read_track(path: Path, run: RunFile) -> Track:
    """The track in a table, read as a run of a dataset says.

    Raises:
        InputError: there is no such file, it is not a table, something about it has to be said by a
            key, a column is missing, a cell is not a number, or there are too few frames.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file (named as a track by the dataset)")
    settled = settle(path, run)
    if settled.asked:
        raise InputError("\n".join(one.sentence for one in settled.asked))
    _check_units(settled)
    return in_si(settled, rows_of(settled))


def rows_of(settled: Settled) -> Seen:
    """The rows of the object that is followed, one for each time, those with nothing marked.

    Raises:
        InputError: a cell is not a number, or a time is repeated.
    """
    table, keys = settled.table, settled.keys
    columns = columns_of(keys)
    assert columns.t is not None
    names = [signed(table, name)[0] for name in columns.tracked.values()]
    extra = [settled.likelihood, settled.area if keys.several != "nearest" else None]
    found = table.numbers(
        [columns.t, *names, *(name for name in extra if name is not None)],
        columns.t,
        settled.where,
    )
    found = _with_times(table.path, found, [columns.t, *names])
    time = times(table.path, keys, found)
    order = np.argsort(time, kind="stable")
    time, values, lines = time[order], found.values[order, 1:], found.lines[order]
    further = dict(zip((name for name in extra if name), values[:, len(names) :].T, strict=True))
    values = values[:, : len(names)]
    values, said = _without_lost(settled, values, further)
    seen = np.asarray(np.isfinite(values).all(axis=1))
    if len(time) > 1 and np.any(np.diff(time[seen]) == 0):
        time, values, lines, seen, words = _one_of_several(
            settled, time, values, lines, seen, further
        )
        said += words
    check_distinct(table.path, keys, time[seen], lines[seen])
    check_one_recording(table.path, keys, time[seen], lines[seen])
    return Seen(time, values, lines, seen, tuple(said))


def in_si(settled: Settled, rows: Seen) -> Track:
    """The frames between `t_start` and `t_end` in m and rad, in the axes of the robot.

    Raises:
        InputError: there are too few, they jump, or are from before the start of the motor.
    """
    path, keys = settled.table.path, settled.keys
    columns = columns_of(keys)
    within = selected(keys, rows.time)
    chosen = within & rows.found
    _check_frames(path, keys, rows, chosen)
    time, lines = rows.time[chosen], rows.lines[chosen]
    check_no_jump(path, keys, time, lines)
    values = rows.values[chosen]
    radians = ANGLE_UNITS[keys.angle_unit]
    channels, tracked = [], []
    matrix = np.eye(3) if keys.axes is None else keys.axes.matrix
    for k, (channel, name) in enumerate(columns.tracked.items()):
        _, sense = signed(settled.table, name)
        if channel == CHANNELS[ANGLE]:
            period = None if keys.angle_period is None else keys.angle_period * radians
            angle = unwrapped(path, values[:, k] * radians, period, radians, lines)
            channels.append(ANGLE)
            tracked.append(sense * angle)
            continue
        if channel == "y" and keys.y_down:
            if sense < 0:
                raise InputError(
                    f"{path}: y_down = true turns y round, and so does the minus before "
                    f"{name[1:]!r} in columns; keep one of them"
                )
            sense = -1.0
        along = matrix[:, "xyz".index(channel)]
        axis = int(np.argmax(np.abs(along)))
        channels.append(axis)
        tracked.append(sense * along[axis] * keys.length * values[:, k])
    order = np.argsort(channels)
    return Track(
        time,
        np.stack([tracked[k] for k in order], axis=1),
        tuple(int(channels[k]) for k in order),
        _frames_without(rows, within),
        keys,
        (*settled.said, *rows.said),
        _sight(path, keys, channels),
    )


def _sight(path: Path, keys: RunFile, channels: list[int]) -> int | None:
    """The axis along which the camera looks, if it has followed the silhouette of the robot."""
    places = set(channels) - {ANGLE}
    if keys.point == "head" or not places:
        return None
    if len(places) != 2:
        raise InputError(
            f'{path}: point = "silhouette": a camera sees two coordinates of it, but columns has '
            f"{len(places)}; name two of x, y, z (the robot's axes are said by axes)"
        )
    return ({0, 1, 2} - places).pop()


def columns_of(keys: RunFile) -> Columns:
    """The columns of keys that leave nothing open."""
    assert keys.columns is not None
    return keys.columns


def _frames_without(rows: Seen, within: Rows) -> int:
    """Times that have rows, but nothing in them."""
    return len(np.setdiff1d(rows.time[within & ~rows.found], rows.time[rows.found]))


def _with_times(path: Path, found: Numbers, names: list[str]) -> Numbers:
    """The rows that have a time.

    Raises:
        InputError: a row has a position but no time, or a column has no number at all.
    """
    missing = np.isnan(found.values[:, : len(names)])
    for k in np.flatnonzero(missing.all(axis=0)):
        raise InputError(f"{path}: column {names[k]!r} has no numbers; leave it out of columns")
    timed = ~missing[:, 0]
    if len(without := np.flatnonzero(missing[:, 0] & ~missing[:, 1:].all(axis=1))):
        line = found.lines[without[0]]
        raise InputError(f"{path}: line {line}, column {names[0]!r}: has no time")
    return replace(found, values=found.values[timed], lines=found.lines[timed])


def _without_lost(
    settled: Settled, values: Float[np.ndarray, "r c"], further: dict[str, np.ndarray]
) -> tuple[Float[np.ndarray, "r c"], list[str]]:
    """Values with NaN where nothing was found, and the sentences on that."""
    said: list[str] = []
    keys = settled.keys
    place = np.array([channel in "xyz" for channel in columns_of(keys).tracked])
    if not place.any():
        return values, said
    values = values.copy()
    rows, guessed = lost(values[:, place], keys.sentinels)
    values[np.ix_(rows, place)] = np.nan
    if guessed is not None and rows.any():
        said.append(
            f"{int(rows.sum())} rows with {guessed:g} for all coordinates count as not found "
            "(missing = [] says that they are positions)"
        )
    if settled.likelihood is not None:
        unsure = ~(further[settled.likelihood] >= (keys.likelihood or 0.0))
        values[np.ix_(unsure, place)] = np.nan
        said.append(f"{int(unsure.sum())} rows have too small a likelihood")
    return values, said


def _one_of_several(
    settled: Settled,
    time: np.ndarray,
    values: np.ndarray,
    lines: np.ndarray,
    seen: Rows,
    further: dict[str, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Rows, list[str]]:
    """One row of each time, if a key or the format says which; the others are taken out."""
    keys, path = settled.keys, settled.table.path
    how = keys.several
    by_format = settled.layout.y_down and keys.track_id is None  # tables of what a picture shows
    if how is None and by_format and settled.where is None:
        how = "nearest" if settled.area is None else "largest"
    if how is None:
        return time, values, lines, seen, []
    if how == "largest" and settled.area is None:
        raise InputError(f'{path}: several = "largest", but no column has areas; say "nearest"')
    place = [k for k, channel in enumerate(columns_of(keys).tracked) if channel in "xyz"]
    if not place and how == "nearest":
        raise InputError(f'{path}: several = "nearest" needs positions; say track_id')
    area = None if how == "nearest" else further[str(settled.area)]
    try:
        kept = one_each(time, values[:, place], seen, area)
    except ValueError as error:
        raise InputError(
            f'{path}: several = "nearest": {error}; say several = "largest", or track_id'
        ) from None
    others = seen & ~kept
    words = "the largest" if how == "largest" else "the nearest to the last"
    said = (
        f"{int(others.sum())} rows are of other things in the same frames: {words} is taken "
        f'(several = "{how}")'
    )
    rest = ~others
    return time[rest], values[rest], lines[rest], seen[rest], [said]


def _check_frames(path: Path, keys: RunFile, rows: Seen, chosen: Rows) -> None:
    """`InputError` if frames are from before the start of the motor, or too few."""
    slack = ROUNDING * np.abs(rows.time).max(initial=0.0)
    if len(early := np.flatnonzero(chosen & (rows.time < -slack))):
        i = early[0]
        raise InputError(
            f"{path}: line {rows.lines[i]}, column {columns_of(keys).t!r}: the frame is from "
            f"{-rows.time[i]:g} s before the motor starts; leave such frames out with "
            f"t_start = {0.0 - keys.time_offset:.15g}, or change time_offset"
        )
    if (n := int(chosen.sum())) < MIN_FRAMES:
        said = f"{path}: {n} frames"
        if n < int(rows.found.sum()):
            said += f" of {int(rows.found.sum())} lie between t_start and t_end"
        raise InputError(f"{said}; at least {MIN_FRAMES} are needed")


def _check_units(settled: Settled) -> None:
    """Warns of positions whose header says another unit than the dataset."""
    table, keys = settled.table, settled.keys
    given = "px" if keys.pixel_size is not None else keys.length_unit
    named = {
        name: unit_in_header(table, signed(table, name)[0])
        for channel, name in columns_of(keys).tracked.items()
        if channel in "xyz"
    }
    said = {unit for unit in named.values() if unit is not None}
    if said - {given}:
        names = ", ".join(name for name, unit in named.items() if unit is not None)
        meant = "in pixels (pixel_size)" if given == "px" else f"length_unit = {given!r}"
        warnings.warn(
            f"{table.path}: columns {names}: the header says {', '.join(sorted(said))}, "
            f"the dataset {meant}",
            InputWarning,
            stacklevel=3,
        )
