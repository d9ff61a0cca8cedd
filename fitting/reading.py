"""Reading tracks: from the rows of a table to times and positions in SI units."""

import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from derjax import InputError
from derjax.core.errors import InputWarning
from derjax.io.fields import TIME_UNITS
from derjax.io.tables import Numbers, TextTable, read_table, same, seconds

from .datasetfile import ANGLE_UNITS, RunFile

MIN_FRAMES = 10

ROUNDING = 1e-9
"""Part of the largest time, or of a turn, by which numbers may be off."""

Times = Float[np.ndarray, " r"]
Values = Float[np.ndarray, "r c"]
Lines = Int[np.ndarray, " r"]

TRACK_COLUMNS = frozenset(
    ("track_id", "track id", "tid", "track", "track no", "particle", "individual", "object")
)
"""Names of columns by which programs tell objects apart, in small letters."""

FRAME_COLUMNS = frozenset(
    ("frame", "frames", "frame_idx", "frame_number", "frame number", "slice", "image", "coords")
)
"""Names of columns with the numbers of frames, in small letters."""

MOST_VALUES = 8
"""Objects that a message lists at most."""

_UNIT = re.compile(r".*[\[(_ ](m|cm|mm|um|\N{GREEK SMALL LETTER MU}m|micron|px|pixel)s?[\])]?")
_SAME_UNIT = {"\N{GREEK SMALL LETTER MU}m": "um", "micron": "um", "pixel": "px"}


@dataclass(frozen=True)
class Track:
    """The frames of a track that are to be compared, in order.

    Attributes:
        time: (f,) s since the motor started, increasing.
        values: (f, c) m and rad, of the channels that `RunFile.columns` names.
        dropped: how many frames are left out as something in them was not tracked.
    """

    time: Float[np.ndarray, " f"]
    values: Float[np.ndarray, "f c"]
    dropped: int


def read_track(path: Path, run: RunFile) -> Track:
    """The track in a table, read as a run of a dataset says.

    Raises:
        InputError: there is no such file, it is not a table, a column is missing, a cell is not a
            number, there are several objects in it, or too few frames.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file (named as a track by the dataset)")
    table = read_table(path)
    tracked = run.columns.tracked
    names, senses = zip(*(_column(table, name) for name in tracked.values()), strict=True)
    _check_units(table, run, dict(zip(tracked, names, strict=True)))
    found = table.numbers([run.columns.t, *names], run.columns.t, _where(table, run))
    found = _with_times(path, found, [run.columns.t, *names])
    time, values, lines = _sorted(_times(table, run, found), found)
    seen = np.asarray(np.isfinite(values).all(axis=1))
    _check_distinct(table, run, time[seen], lines[seen])
    within = _selected(run, time)
    chosen = within & seen
    _check_frames(path, run, time, lines, chosen, seen)
    is_angle = np.array([channel == "head_angle" for channel in tracked])
    if is_angle.any():
        angle = values[chosen][:, is_angle][:, 0] * ANGLE_UNITS[run.angle_unit]
        _check_unwrapped(path, angle, lines[chosen])
    unit = np.where(is_angle, ANGLE_UNITS[run.angle_unit], run.length)
    return Track(time[chosen], values[chosen] * unit * senses, int((within & ~seen).sum()))


def _column(table: TextTable, name: str) -> tuple[str, float]:
    """A column and its sense: what the name says, or what stands behind a minus."""
    if table.find(name) is None and name.startswith("-") and table.find(name[1:]) is not None:
        return name[1:], -1.0
    return name, 1.0


def _where(table: TextTable, run: RunFile) -> tuple[str, tuple[str, ...]] | None:
    """Which rows are of the object that the run is about: a column, and its values there."""
    column = run.track_column or _track_column(table)
    if run.track_id is None:
        if column is not None and len(values := _values(table, column)) > 1:
            raise InputError(
                f"{table.path}: column {column!r} tells of several objects: {_listed(values)}; "
                "choose with track_id which one to follow, or give a list of them"
            )
        return None
    if column is None:
        raise InputError(
            f"{table.path}: track_id is given, but it is not clear which column it is of; set "
            f"track_column to one of {', '.join(map(repr, table.names))}"
        )
    values = _values(table, column)
    for wanted in run.tracks:
        if not any(same(value, wanted) for value in values):
            raise InputError(
                f"{table.path}: track_id = {wanted}: column {column!r} has {_listed(values)}"
            )
    return column, run.tracks


def _track_column(table: TextTable) -> str | None:
    """The column that tells objects apart, if one has a name of such."""
    for row in (table.names, *table.format.header):
        for place, name in enumerate(row):
            if name.lower() in TRACK_COLUMNS:
                return table.names[place]
    return None


def _values(table: TextTable, column: str) -> list[str]:
    """What stands in a column, every value once."""
    return list(dict.fromkeys(table.text(column)))


def _listed(values: list[str]) -> str:
    shown = ", ".join(value or "nothing" for value in values[:MOST_VALUES])
    return shown if len(values) <= MOST_VALUES else f"{shown}, ..."


def _with_times(path: Path, found: Numbers, names: list[str]) -> Numbers:
    """The rows that have a time.

    Raises:
        InputError: a row has a position but no time, or a column has no number at all.
    """
    missing = np.isnan(found.values)
    for k in np.flatnonzero(missing.all(axis=0)):
        raise InputError(f"{path}: column {names[k]!r} has no numbers; leave it out of columns")
    timed = ~missing[:, 0]
    if len(lost := np.flatnonzero(missing[:, 0] & ~missing[:, 1:].all(axis=1))):
        raise InputError(f"{path}: line {found.lines[lost[0]]}, column {names[0]!r}: has no time")
    return replace(found, values=found.values[timed], lines=found.lines[timed])


def _times(table: TextTable, run: RunFile, found: Numbers) -> Times:
    """The times of rows since the motor started, s."""
    path, raw, name = table.path, found.values[:, 0], run.columns.t
    if run.fps is None:
        if _are_frames(table, name):
            warnings.warn(
                f"{path}: column {name!r} seems to hold numbers of frames, which are taken for "
                f"times in {run.time_unit}; fps says how many frames there are in a second",
                InputWarning,
                stacklevel=2,
            )
        return seconds(raw, run.time_unit, run.time_offset, found.is_clock)
    if len(broken := np.flatnonzero(raw % 1)) or found.is_clock:
        value = "times of a clock" if found.is_clock else f"{raw[broken[0]]:g}"
        raise InputError(
            f"{path}: column {name!r} does not hold numbers of frames but {value}; leave out fps"
        )
    first = raw.min() if run.first_frame is None else run.first_frame
    return (raw - first) / run.fps + run.time_offset * TIME_UNITS[run.time_unit]


def _are_frames(table: TextTable, name: str) -> bool:
    """Whether the header says that a column holds numbers of frames."""
    cells = [row[table.column(name)] for row in table.format.header]
    return any(cell.lower().strip("()[]") in FRAME_COLUMNS for cell in cells)


def _sorted(time: Times, found: Numbers) -> tuple[Times, Values, Lines]:
    """Times, other columns and lines in the order of time."""
    order = np.argsort(time, kind="stable")
    return time[order], found.values[order, 1:], found.lines[order]


def _check_distinct(table: TextTable, run: RunFile, time: Times, lines: Lines) -> None:
    """`InputError` if two frames are of one time."""
    if len(again := np.flatnonzero(np.diff(time) == 0)):
        one, other = sorted(lines[again[0] : again[0] + 2])
        raise InputError(
            f"{table.path}: line {other}, column {run.columns.t!r}: the time of line {one} is "
            "repeated; if there are several objects in the table, say with track_column which "
            "column tells them apart and with track_id which one to follow, or keep the rows of "
            "one only"
        )


def _selected(run: RunFile, time: Times) -> Bool[np.ndarray, " r"]:
    """Which frames lie between `t_start` and `t_end`."""
    unit = TIME_UNITS[run.time_unit]
    start = -np.inf if run.t_start is None else (run.t_start + run.time_offset) * unit
    end = np.inf if run.t_end is None else (run.t_end + run.time_offset) * unit
    slack = ROUNDING * np.abs(time).max()
    return (time >= start - slack) & (time <= end + slack)


def _check_frames(
    path: Path,
    run: RunFile,
    time: Times,
    lines: Lines,
    chosen: Bool[np.ndarray, " r"],
    seen: Bool[np.ndarray, " r"],
) -> None:
    """`InputError` if frames are from before the start of the motor, or too few."""
    slack = ROUNDING * np.abs(time).max()
    if len(early := np.flatnonzero(chosen & (time < -slack))):
        i = early[0]
        raise InputError(
            f"{path}: line {lines[i]}, column {run.columns.t!r}: the frame is from "
            f"{-time[i]:g} s before the motor starts; leave such frames out with "
            f"t_start = {0.0 - run.time_offset:.15g}, or change time_offset"
        )
    if (n := int(chosen.sum())) < MIN_FRAMES:
        said = f"{path}: {n} frames"
        if n < int(seen.sum()):
            said += f" of {int(seen.sum())} lie between t_start and t_end"
        raise InputError(f"{said}; at least {MIN_FRAMES} are needed")


def _check_unwrapped(path: Path, angle: Float[np.ndarray, " f"], lines: Lines) -> None:
    """Angles given within one turn jump where they leave it; a simulation's do not."""
    jumps = np.abs(np.diff(angle))
    if np.ptp(angle) <= 2 * np.pi * (1 + ROUNDING) and jumps.max() > np.pi:
        line = lines[int(np.argmax(jumps)) + 1]
        raise InputError(
            f"{path}: line {line}: the head angle jumps by {jumps.max():.3g} rad: it seems to "
            "be given within one turn; add whole turns so that it is continuous"
        )


def _check_units(table: TextTable, run: RunFile, channels: dict[str, str]) -> None:
    """Warns of positions whose header says another unit than the dataset."""
    given = "px" if run.pixel_size is not None else run.length_unit
    units = {name: _unit_of(table, name) for channel, name in channels.items() if channel in "xyz"}
    said = {unit for unit in units.values() if unit is not None}
    if said - {given}:
        names = ", ".join(name for name, unit in units.items() if unit is not None)
        meant = "in pixels (pixel_size)" if given == "px" else f"length_unit = {given!r}"
        warnings.warn(
            f"{table.path}: columns {names}: the header says {', '.join(sorted(said))}, "
            f"the dataset {meant}",
            InputWarning,
            stacklevel=2,
        )


def _unit_of(table: TextTable, name: str) -> str | None:
    """The unit of length that the header says a column has, if it does."""
    place = table.column(name)
    for row in table.format.header:
        if match := _UNIT.fullmatch(row[place].lower()):
            return _SAME_UNIT.get(match[1], match[1])
    return None
