"""When the rows of a track are of: from times, clocks or numbers of frames to seconds."""

from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from derjax import InputError
from derjax.io.fields import TIME_UNITS
from derjax.io.tables import Numbers, seconds

from .datasetfile import RunFile

ROUNDING = 1e-9
"""Part of the largest time by which numbers may be off."""

MOST_STEPS = 20.0
"""Usual times between frames beyond which a longer one may be a mistake."""

MOST_PARTS = 3
"""Recordings that a file may seem to hold one below the other."""

Times = Float[np.ndarray, " r"]
Lines = Int[np.ndarray, " r"]


def times(path: Path, keys: RunFile, found: Numbers) -> Times:
    """The times of rows since the motor started, s; they stand in the first column."""
    raw = found.values[:, 0]
    if keys.fps is None:
        return seconds(raw, keys.time_unit, keys.time_offset, found.is_clock)
    if len(broken := np.flatnonzero(raw % 1)) or found.is_clock:
        value = "times of a clock" if found.is_clock else f"{raw[broken[0]]:g}"
        raise InputError(
            f"{path}: column {_name(keys)!r} does not hold numbers of frames but {value}; "
            "leave out fps"
        )
    first = raw.min() if keys.first_frame is None else keys.first_frame
    return (raw - first) / keys.fps + keys.time_offset * TIME_UNITS[keys.time_unit]


def selected(keys: RunFile, time: Times) -> Bool[np.ndarray, " r"]:
    """Which frames lie between `t_start` and `t_end`."""
    unit = TIME_UNITS[keys.time_unit]
    start = -np.inf if keys.t_start is None else (keys.t_start + keys.time_offset) * unit
    end = np.inf if keys.t_end is None else (keys.t_end + keys.time_offset) * unit
    slack = ROUNDING * np.abs(time).max(initial=0.0)
    return (time >= start - slack) & (time <= end + slack)


def check_distinct(path: Path, keys: RunFile, time: Times, lines: Lines) -> None:
    """`InputError` if two frames are of one time."""
    if len(again := np.flatnonzero(np.diff(time) == 0)):
        one, other = sorted(lines[again[0] : again[0] + 2])
        raise InputError(
            f"{path}: line {other}, column {_name(keys)!r}: the time of line {one} is "
            "repeated; if there are several objects in the table, say with track_column which "
            "column tells them apart and with track_id which one to follow, or with several "
            'which one of each frame ("nearest", "largest"), or keep the rows of one only'
        )


def check_one_recording(path: Path, keys: RunFile, time: Times, lines: Lines) -> None:
    """`InputError` if two recordings stand one below the other, as if they were one.

    Args:
        path: of the file.
        keys: how it is read.
        time: s, in increasing order.
        lines: of the file.
    """
    order = np.argsort(lines, kind="stable")
    steps = np.diff(time[order])
    if not len(steps):
        return
    back = np.flatnonzero(steps < -MOST_PARTS * np.median(np.abs(steps)))
    if not 0 < len(back) < MOST_PARTS or np.sum(steps < 0) > len(back):
        return
    parts = np.split(time[order], back + 1)
    for k, (before, after) in enumerate(pairwise(parts)):
        if after[0] < before[-1] and after[-1] > before[0]:
            line = lines[order][back[k] + 1]
            raise InputError(
                f"{path}: line {line}, column {_name(keys)!r}: the time falls from "
                f"{_as_written(keys, before[-1])} to {_as_written(keys, after[0])}, as if another "
                "recording began there; put each into a file, and a [[runs]], of its own"
            )


def check_no_jump(path: Path, keys: RunFile, time: Times, lines: Lines) -> None:
    """`InputError` if two frames are farther apart than `max_gap`, or than can be meant."""
    steps = np.diff(time)
    if not len(steps):
        return
    longest = int(np.argmax(steps))
    unit = TIME_UNITS[keys.time_unit]
    if keys.max_gap is not None:
        if steps[longest] <= keys.max_gap * unit * (1 + ROUNDING):
            return
        why = f"longer than max_gap = {keys.max_gap:g}"
    else:
        rest = np.sum(steps) - steps[longest]
        if steps[longest] <= max(rest, MOST_STEPS * np.median(steps)):
            return
        why = f"longer than all the other frames take, {rest:.4g} s"
    before, after = (_as_written(keys, one) for one in time[longest : longest + 2])
    gap = steps[longest] / unit
    raise InputError(
        f"{path}: line {lines[longest + 1]}, column {_name(keys)!r}: the time jumps by {gap:.6g} "
        f"{keys.time_unit}, {why}; take one part with t_end = {before} or t_start = {after}, or, "
        f"if that is right, say max_gap = {np.ceil(gap):g}"
    )


def _as_written(keys: RunFile, time: float) -> str:
    """A time in the unit and since the instant of `t_start` and `t_end`."""
    return f"{time / TIME_UNITS[keys.time_unit] - keys.time_offset:.10g}"


def _name(keys: RunFile) -> str | None:
    return None if keys.columns is None else keys.columns.t
