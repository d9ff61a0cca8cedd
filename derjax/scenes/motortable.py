"""What motors are told to do over time: tables of rates, and logs of motor controllers."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Float, Int
from pydantic import model_validator

from ..core.errors import InputError, InputWarning
from ..io.fields import TIME_UNITS, Finite, Table
from ..io.tables import Numbers, TextTable, read_table, seconds
from .ingredients.motor import FASTEST_RPM, MotorTable

ROUNDING = 1e-9
"""Part of the run by which a table may end too early."""

HELD = 0.1
"""The largest part of the run for which a log is held at its first or last value."""

MOST_SPARE = 10.0
"""How many times longer than the run a log may be, in the unit that its times are likely in."""

Times = Float[np.ndarray, " r"]
Rates = Float[np.ndarray, "r m"]


class RateTable(Table):
    """A motor's rate over time: s and revolutions per minute, linear in between.

    A time that stands there twice is a jump.
    """

    time: tuple[Finite, ...]
    rpm: tuple[Finite | tuple[Finite, ...], ...]

    @model_validator(mode="after")
    def _possible(self) -> Self:
        rates = np.asarray(self.rpm).reshape(len(self.rpm), -1)
        if len(rates) != len(self.time):
            raise ValueError(f"rpm: {len(rates)} rates given for {len(self.time)} times")
        if rates.size and abs(rates).max() > FASTEST_RPM:
            raise ValueError(f"rpm = {abs(rates).max():g}: beyond any motor")
        return self


def read_motor_table(path: Path, motor: MotorTable, end: float, n_motors: int = 1) -> RateTable:
    """The rates in the table of a motor, which must cover the run from 0 to `end` (s).

    A log whose first or last sample is less than its longest sampling interval (and less than
    a tenth of the run) inside the run is held there. Counts of an encoder become the mean rate
    between two samples, so that the motor has turned by what was counted at each of them.

    Args:
        path: of the table.
        motor: how it is to be read.
        end: of the run.
        n_motors: how many motors there are.

    Raises:
        InputError: no such file, a missing column, a cell that is not a number, times that do
            not increase, or a table that does not cover the run; with keys that would help.
    """
    table = read_table(path)
    names = _columns(table, motor, n_motors)
    found = table.numbers([motor.columns.time, *names], clock=motor.columns.time)
    _check_complete(path, found, [motor.columns.time, *names])
    time = seconds(found.values[:, 0], motor.time_unit, motor.time_offset, found.is_clock)
    if len(bad := np.flatnonzero(np.diff(time) <= 0)):
        raise InputError(f"{path}: line {found.lines[bad[0] + 1]}: times must increase")
    if not covers(time, end):
        raise InputError(f"{path}: {_uncovered(motor, found, time, end)}")
    if motor.time_unit == "s" and not found.is_clock:
        _check_seconds(path, time, end)
    rpm, lines = found.values[:, 1:], found.lines
    if motor.counts_per_turn is not None:
        if len(time) < 2:
            raise InputError(f"{path}: two samples of an encoder are needed at least")
        time, rpm, lines = _rates(time, rpm / motor.counts_per_turn, lines)
    if len(bad := np.flatnonzero((abs(rpm) > FASTEST_RPM).any(axis=1))):
        worst = abs(rpm[bad[0]]).max()
        raise InputError(f"{path}: line {lines[bad[0]]}: rpm = {worst:g}: beyond any motor")
    rates = rpm[:, 0].tolist() if len(names) == 1 else [tuple(row) for row in rpm.tolist()]
    return RateTable(time=tuple(time.tolist()), rpm=tuple(rates))


def _columns(table: TextTable, motor: MotorTable, n_motors: int) -> tuple[str, ...]:
    """The names of the columns that say how motors turn: one for all, or one for each."""
    names = motor.columns.driven
    if not names:
        single = n_motors == 1 or table.find("rpm") is not None
        names = ("rpm",) if single else tuple(f"rpm_{k + 1}" for k in range(n_motors))
    if len(names) not in (1, n_motors):
        raise InputError(f"{len(names)} columns are given, but motors there are {n_motors}")
    missing = [name for name in (motor.columns.time, *names) if table.find(name) is None]
    if missing:
        raise InputError(
            f"{table.path}: no column {' or '.join(map(repr, missing))}; the columns are "
            f"{', '.join(map(repr, table.names))}; say which with {_guess(table.names)}"
        )
    return names


def _guess(names: Sequence[str]) -> str:
    """The key `columns` as it might be for a table with columns of these names."""

    def like(*words: str) -> list[str]:
        return [name for name in names if any(word in name.lower() for word in words)]

    rates, counts = like("rpm", "speed", "rate"), like("encoder", "count", "ticks")
    time = next(iter([*like("time"), *(n for n in names if n.lower() in ("t", "ms"))]), "...")
    key, chosen = ("counts", counts) if counts and not rates else ("rpm", rates)
    turns = " and counts_per_turn" if key == "counts" else ""
    which = " or ".join(map(repr, chosen or ["..."]))
    return f"[motor] columns = {{ time = {time!r}, {key} = {which} }}{turns}"


def _check_complete(path: Path, found: Numbers, names: Sequence[str]) -> None:
    """`InputError` if there is a cell without a number."""
    if len(bad := np.argwhere(np.isnan(found.values))):
        row, column = bad[0]
        raise InputError(
            f"{path}: line {found.lines[row]}, column {names[column]!r}: has no number; "
            "leave out rows that were not measured"
        )


def covers(time: Times, end: float) -> bool:
    """Whether a table covers the run from 0 to `end`, but for what may be held."""
    interval = float(np.diff(time).max()) if len(time) > 1 else 0.0
    held = min(interval, HELD * end) * (1 + ROUNDING) + ROUNDING * end
    return bool(time[0] <= held and time[-1] >= end - held)


def _uncovered(motor: MotorTable, found: Numbers, time: Times, end: float) -> str:
    """What is wrong with a table that does not cover the run, and which keys would help."""
    said = (
        f"the motor table covers {time[0]:.10g} to {time[-1]:.10g} s, "
        f"but the run lasts from 0 to {end:g} s ([time] end)"
    )
    raw = found.values[:, 0]
    helpful: dict[str, tuple[float, float]] = {}
    for name, unit in TIME_UNITS.items():
        scale = 1.0 if found.is_clock else unit
        for offset in (motor.time_offset, -raw[0] * scale / unit):
            if covers(seconds(raw, name, offset, found.is_clock), end):
                helpful.setdefault(name, (float(np.ptp(raw)) * scale, offset))
    if found.is_clock:
        helpful = {name: it for name, it in helpful.items() if name == motor.time_unit}
    if not helpful:
        return said
    best = min(helpful, key=lambda name: (helpful[name][0], name != motor.time_unit))
    offset = helpful[best][1]
    keys = [f"time_unit = '{best}'"] if best != motor.time_unit else []
    keys += [f"time_offset = {offset:.15g}"] if offset != motor.time_offset else []
    return f"{said}; did you mean [motor] {' and '.join(keys)}?"


def _check_seconds(path: Path, time: Times, end: float) -> None:
    """Warns of times, taken for seconds, of which the run takes up next to nothing."""
    lasts = float(np.ptp(time))
    for unit in ("ms", "us"):
        if (1 - HELD) * end <= lasts * TIME_UNITS[unit] <= MOST_SPARE * end:
            warnings.warn(
                f"{path}: the motor table lasts {lasts:g} s, the run {end:g} s; if its times are "
                f"in {unit}, set [motor] time_unit = '{unit}'",
                InputWarning,
                stacklevel=2,
            )


def _rates(
    time: Times, turns: Rates, lines: Int[np.ndarray, " r"]
) -> tuple[Times, Rates, Int[np.ndarray, " r"]]:
    """Rates (rpm) that are constant between samples of the angle; samples become jumps."""
    rates = 60 * np.diff(turns, axis=0) / np.diff(time)[:, None]
    return np.repeat(time, 2)[1:-1], np.repeat(rates, 2, axis=0), np.repeat(lines, 2)[2:]
