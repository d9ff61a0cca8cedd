"""Tables of numbers as text, as trackers, spreadsheets and motor controllers write them.

    table = read_table(path)
    found = table.numbers(["POSITION_T", "POSITION_X"], clock="POSITION_T")

What varies from one program to the next is found out: the encoding, what separates the columns
(commas, semicolons, tabs or runs of spaces), the decimal sign, and how many rows the header has.
Lines that are blank or begin with # do not count. A table is read line by line whenever columns
are asked for, so that files of any size fit into memory.
"""

import csv
import unicodedata
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ..core.errors import InputError
from .column import Column
from .fields import TIME_UNITS
from .sniffing import DELIMITERS, Format, sniff
from .textfile import LEGACY, encoding_of

COUNTS = {2: "two", 3: "three"}

SAMPLE = 200
"""Lines by which the format of a table is found out."""

MOST_NAMES = 40
"""Columns that a message lists at most."""


@dataclass(frozen=True)
class Numbers:
    """Columns of a table.

    Attributes:
        values: (r, c), NaN where there is none.
        lines: (r,) the line of the file that each row is from.
        is_clock: whether the column of times has clock times, which are in s whatever the unit
            of the other times may be.
    """

    values: Float[np.ndarray, "r c"]
    lines: Int[np.ndarray, " r"]
    is_clock: bool = False


@dataclass(frozen=True)
class TextTable:
    """A table in a text file, and how it is written.

    Attributes:
        path: of the file.
        encoding: of the file, as `open` calls it.
        format: how lines become cells.
    """

    path: Path
    encoding: str
    format: Format

    @cached_property
    def names(self) -> tuple[str, ...]:
        """A name for every column: that of a header row, or of several together.

        A column without a name has its number, counted from 1.
        """
        width = self.format.width
        if not self.format.header:
            return _or_position([""] * width)
        known = [row for row in self.format.header if row.count("") <= 1 and _all_differ(row)]
        return _or_position(min(known, key=lambda row: row.count(""), default=self._joined))

    @cached_property
    def _joined(self) -> list[str]:
        """Names from all header rows that tell columns apart, as "head x"."""
        *upper, last = self.format.header
        telling = [row for row in map(_filled, upper) if len(set(row[1:])) > 1]
        columns = zip(*telling, last, strict=True)
        return [" ".join(dict.fromkeys(name for name in column if name)) for column in columns]

    def find(self, name: str) -> int | None:
        """The number of a column (from 0), None if there is none of that name.

        Every name that a header row gives a column will do, and that of `names`.

        Raises:
            InputError: several columns have that name.
        """
        wanted = normalised(name)
        known = [*self.format.header, self.names]
        if self.format.header:
            known.append(tuple(self._joined))
        several: list[int] = []
        for row in known:
            places = [k for k, given in enumerate(row) if given == wanted]
            if len(places) == 1:
                return places[0]
            several = several or places
        if several:
            apart = sorted({self.names[k] for k in several})
            hint = f": {_quoted(apart)}" if len(apart) > 1 else ""
            raise InputError(
                f"{self.path}: line {self.format.header_line}: "
                f"{COUNTS.get(len(several), len(several))} columns have the name {name!r}{hint}"
            )
        return None

    def column(self, name: str) -> int:
        """The number of a column (from 0).

        Raises:
            InputError: none or several columns have that name; the message lists those that
                there are.
        """
        place = self.find(name)
        if place is not None:
            return place
        said = f"{self.path}: no column {name!r}; the columns are {_quoted(self.names)}"
        if not self.format.header:
            said += " (there is no header: columns are called by their numbers)"
        if len(self.names) == 1:
            said += f" ({self.describe()}; does something else separate the columns?)"
        if self.encoding in LEGACY and not name.isascii():
            said += f" (read as {self.encoding}; save the file as UTF-8)"
        raise InputError(said)

    def describe(self) -> str:
        """How the table is written, in words."""
        kind = self.format
        words = [
            f"columns separated by {DELIMITERS[kind.delimiter]}",
            "decimal commas" if kind.decimal == "," else "decimal points",
            f"{len(kind.header)} header rows" if kind.header else "no header",
        ]
        return ", ".join([*words, self.encoding])

    def text(self, name: str) -> list[str]:
        """The cells of one column as they stand in the file.

        Raises:
            InputError: there is no such column, or a row has too few or too many fields.
        """
        place = self.column(name)
        return [row[place] for _, row in self.rows()]

    def numbers(
        self,
        names: Sequence[str],
        clock: str | None = None,
        where: tuple[str, Sequence[str]] | None = None,
    ) -> Numbers:
        """Some columns as numbers.

        Args:
            names: of the columns.
            clock: the one of them that may hold clock times, as 00:00:07.5. They become seconds;
                where such a clock passes midnight it goes on counting.
            where: a column, and the values of the rows that are wanted.

        Raises:
            InputError: there is no such column, or a cell is neither a number nor empty; the
                message names line and column.
        """
        places = [self.column(name) for name in names]
        decimal = self.format.decimal
        readers = [Column(self.path, name, decimal, name == clock) for name in names]
        chosen, wanted = (self.column(where[0]), where[1]) if where is not None else (0, None)
        lines = array("q")
        for number, (line, row) in enumerate(self.rows(), 1):
            if wanted is not None and not any(same(row[chosen], value) for value in wanted):
                continue
            lines.append(line)
            for reader, place in zip(readers, places, strict=True):
                reader.add(row[place], line, number)
        columns = [reader.finished() for reader in readers]
        return Numbers(
            np.stack(columns, axis=-1) if columns else np.empty((len(lines), 0)),
            np.array(lines),
            any(reader.clocks for reader in readers),
        )

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """The rows below the header, with the lines that they are from."""
        kind, lines = self.format, _Lines(self.path, self.encoding)
        reader = csv.reader(lines, delimiter=kind.delimiter, skipinitialspace=True)
        taken = 0
        try:
            for row in reader:
                line = lines.number
                if reader.line_num > (taken := taken + 1):
                    raise InputError(
                        f"{self.path}: line {line}: a quotation mark is not closed there or above"
                    )
                if line < kind.first_line:
                    continue
                if len(row) < kind.width or any(cell.strip() for cell in row[kind.width :]):
                    raise InputError(self._ragged(line, row))
                yield line, row
        except csv.Error as error:
            raise InputError(f"{self.path}: line {lines.number}: {error}") from None

    def _ragged(self, line: int, row: list[str]) -> str:
        first = "the header has" if self.format.header else "there are columns:"
        said = f"{self.path}: line {line}: {len(row)} fields, but {first} {self.format.width}"
        if self.format.delimiter == "," and len(row) > self.format.width:
            said += "; if there are decimal commas, semicolons or tabs must separate the columns"
        return said


def read_table(path: Path) -> TextTable:
    """Find out how a table is written; its numbers are read when they are asked for.

    Raises:
        InputError: there is no such file, it is not a table, or has no rows.
    """
    encoding = encoding_of(path)
    lines = _Lines(path, encoding)
    sample: list[str] = []
    numbers: list[int] = []
    comment = ""
    for line in lines:
        comment = comment if sample else lines.comment
        sample.append(line)
        numbers.append(lines.number)
        if len(sample) == SAMPLE:
            break
    if not sample:
        raise InputError(f"{path}: the file is empty")
    try:
        found = sniff(sample, numbers, comment)
    except (ValueError, csv.Error) as error:
        raise InputError(f"{path}: {error}") from None
    header = tuple(tuple(map(normalised, row)) for row in found.header)
    return TextTable(path, encoding, found._replace(header=header))


class _Lines:
    """The lines of a text file that are not blank and no comments.

    Attributes:
        number: of the last line that was asked for, in the file.
        comment: the last comment before it, without its mark.
    """

    def __init__(self, path: Path, encoding: str) -> None:
        self._path, self._encoding = path, encoding
        self.number, self.comment = 0, ""

    def __iter__(self) -> Iterator[str]:
        try:
            with self._path.open(encoding=self._encoding) as stream:
                for self.number, line in enumerate(stream, 1):
                    if line.lstrip().startswith("#"):
                        self.comment = line.lstrip(" \t#").rstrip("\r\n")
                    elif line.strip():
                        yield line
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{self._path}: cannot be read: {error}") from None


def seconds(
    time: Float[np.ndarray, " r"], unit: str, offset: float, is_clock: bool
) -> Float[np.ndarray, " r"]:
    """Times of a table in s: given in some unit, or from a clock, with an offset in that unit."""
    if is_clock:
        return time + offset * TIME_UNITS[unit]
    return (time + offset) * TIME_UNITS[unit]


def normalised(name: str) -> str:
    """A name as it is compared: what looks the same is the same, as are all kinds of space."""
    return " ".join(unicodedata.normalize("NFKC", name).split())


def same(cell: str, wanted: str) -> bool:
    """Whether a cell holds a value: the same number, or the same text."""
    try:
        return float(cell.replace(",", ".")) == float(wanted)
    except ValueError:
        return normalised(cell) == normalised(wanted)


def _filled(row: Sequence[str]) -> tuple[str, ...]:
    """A row of a header whose names stand above the first of several columns."""
    names, last = [], ""
    for name in row:
        last = name or last
        names.append(last)
    return tuple(names)


def _all_differ(row: Sequence[str]) -> bool:
    named = [name for name in row if name]
    return len(set(named)) == len(named)


def _or_position(names: Sequence[str]) -> tuple[str, ...]:
    """Names, and for columns without one their number."""
    return tuple(name or str(k) for k, name in enumerate(names, 1))


def _quoted(names: Sequence[str]) -> str:
    """Names as a message lists them."""
    shown = ", ".join(repr(name) for name in names[:MOST_NAMES])
    return shown if len(names) <= MOST_NAMES else f"{shown}, ..."
