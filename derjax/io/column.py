"""Numbers and clock times from the cells of one column of a table."""

import math
import re
from array import array
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from .sniffing import is_missing

DAY = 86400.0
"""Seconds after which a clock begins anew."""

_CLOCK = re.compile(r"(?:(\d+):)?(\d+):(\d{1,2}(?:[.,]\d*)?)")
_WITH_FRAMES = re.compile(r"\d+:\d+:\d+[:;]\d+")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")


class Column:
    """One column while it is read.

    Args:
        path: of the file, for messages.
        name: as the column was asked for.
        decimal: the decimal sign.
        clock: whether it may hold clock times, as 00:00:07.5.
    """

    def __init__(self, path: Path, name: str, decimal: str, clock: bool) -> None:
        self._path, self._name, self._may_be_clock = path, name, clock
        self._comma, self.clocks = decimal == ",", 0
        self._values = array("d")
        self._thousands, self._fractions, self._whole = 0, 0, 0

    def add(self, cell: str, line: int, row: int) -> None:
        """Enters a cell."""
        value = self._number(cell)
        if value is None and self._may_be_clock and (match := _CLOCK.fullmatch(cell)):
            hours, minutes, seconds = match.groups(default="0")
            value = 3600.0 * int(hours) + 60.0 * int(minutes) + float(seconds.replace(",", "."))
            self.clocks += 1
        if value is None:
            raise InputError(
                f"{self._path}: line {line} (row {row}), column {self._name!r}: "
                f"not a number: {self._said(cell)}"
            )
        self._values.append(value)

    def _number(self, cell: str) -> float | None:
        """The number in a cell, NaN for none, None for something else."""
        if is_missing(cell):
            return math.nan
        text = cell.replace("\N{MINUS SIGN}", "-").strip()
        if self._comma:
            if "." in text:
                return None
            self._count(text)
            text = text.replace(",", ".", 1)
        try:
            value = float(text)
        except ValueError:
            return None
        return value if math.isfinite(value) and "_" not in text else None

    def _count(self, text: str) -> None:
        """Keeps account of what commas may stand for."""
        if _THOUSANDS.fullmatch(text):
            self._thousands += 1
        elif "," in text:
            self._fractions += 1
        elif text.strip("+-0"):
            self._whole += 1

    def _said(self, cell: str) -> str:
        """A cell that cannot be read, with what may be the matter."""
        shown = repr(cell)
        if _WITH_FRAMES.fullmatch(cell):
            return (
                f"{shown} seems to be hours:minutes:seconds:frames; give the column with the "
                "numbers of the frames, and how many there are in a second"
            )
        if _CLOCK.fullmatch(cell):
            return f"{shown} is a time of a clock"
        other, sign = (".", "commas") if self._comma else (",", "points")
        if other in cell and re.fullmatch(r"[+-]?[\d.,]+(e[+-]?\d+)?", cell, re.IGNORECASE):
            return f"{shown}; the decimal signs of this table are {sign}"
        return shown

    def finished(self) -> Float[np.ndarray, " r"]:
        """All values.

        Raises:
            InputError: commas separate thousands, or numbers and clock times are mixed.
        """
        path, name = self._path, self._name
        if self._thousands and self._whole and not self._fractions:
            raise InputError(
                f"{path}: column {name!r}: commas seem to separate thousands; "
                "export the numbers without them"
            )
        values = np.array(self._values)
        if not self.clocks:
            return values
        if self.clocks < np.isfinite(values).sum():
            raise InputError(f"{path}: column {name!r}: has times of a clock and plain numbers")
        known = np.isfinite(values)
        steps = np.diff(values[known], prepend=values[known][:1])
        values[known] += DAY * np.cumsum(steps < -0.5 * DAY)
        return values
