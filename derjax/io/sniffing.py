"""Finding out how a table is written, from its first lines."""

import csv
import re
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

DELIMITERS = {"\t": "tabs", ";": "semicolons", ",": "commas", " ": "spaces"}
"""What may separate columns, in words."""

MOST_HEADER_ROWS = 4
MOST_PREAMBLE = 8
"""Lines above the header that are looked at, where programs write about the recording."""

MISSING = frozenset({"", "nan", "null", "none", "na", "n/a", "#n/a", "-", "--"})
"""What stands where there is no number, in small letters."""

FOREIGN = 3.0
"""What a cell with a tab or a semicolon in it weighs against what separates the columns else."""

_NUMBER = re.compile(r"[+\-\u2212]?(\d+\.?\d*|\d+,\d+|[.,]\d+)(e[+\-]?\d+)?", re.IGNORECASE)
_CLOCK = re.compile(r"\d+(:\d+){1,3}([.,;]\d*)?")

Row = list[str]


class Format(NamedTuple):
    """How lines become cells.

    Attributes:
        delimiter: what separates columns; a space stands for any number of them.
        decimal: the decimal sign.
        width: how many columns there are.
        header: rows with the names of the columns, each with `width` cells; none if there is
            no header.
        first_line: the line of the file with the first row of numbers.
        header_line: the line of the file with the first row of the header, if there is one.
    """

    delimiter: str
    decimal: str
    width: int
    header: tuple[tuple[str, ...], ...]
    first_line: int
    header_line: int


def fields(lines: Sequence[str], delimiter: str) -> list[Row]:
    """The cells of some lines."""
    return list(csv.reader(lines, delimiter=delimiter, skipinitialspace=True))


def is_missing(cell: str) -> bool:
    """Whether a cell says that there is no number."""
    return cell.strip().lower() in MISSING


def sniff(lines: Sequence[str], numbers: Sequence[int], comment: str = "") -> Format:
    """The format of a table.

    Args:
        lines: its first ones, without comments and blank lines; at least one.
        numbers: of these lines in the file.
        comment: the last one above them, which may hold names of the columns.

    Raises:
        ValueError: there are no rows of numbers.
    """
    delimiter = _delimiter(lines)
    rows = fields(lines, delimiter)
    usual = _usual_width(rows)
    start = _preamble(rows, usual)
    count = next((k for k, row in enumerate(rows[start:]) if _is_data(row)), len(rows) - start)
    if start + count == len(rows):
        raise ValueError(_without_numbers(rows))
    if count > MOST_HEADER_ROWS:
        raise ValueError(
            f"the first {count} lines hold no numbers; a header may have {MOST_HEADER_ROWS} rows"
        )
    header, data = rows[start : start + count], rows[start + count :]
    if not header and _are_numbers_of_columns(data[0]):
        header, data = data[:1], data[1:]
    if not data:
        raise ValueError("has a header but no rows")
    header_line = numbers[start] if header else numbers[0] - 1
    width = _width(header, data)
    header = [row for row in header if len(_trimmed(row)) <= width]
    if not header and comment:
        (names,) = fields([comment], delimiter)
        header = [_trimmed(names)] * (len(_trimmed(names)) == width)
    first_line = numbers[len(rows) - len(data)]
    padded = tuple(tuple((row + [""] * width)[:width]) for row in header)
    return Format(delimiter, _decimal(data), width, padded, first_line, header_line)


def _without_numbers(rows: Sequence[Row]) -> str:
    """What to say about a table that has none."""
    if len(rows) > 1 and _usual_width(rows) == 1:
        return f"no columns in {rows[0][0]!r}: {', '.join(DELIMITERS.values())} separate them"
    if len(rows) > MOST_HEADER_ROWS:
        return f"the first {len(rows)} lines hold no numbers; is it a table?"
    return "has a header but no rows"


def _delimiter(lines: Sequence[str]) -> str:
    """What separates columns: it makes rows of one width, and cells that are numbers."""
    if sum("\t" in line for line in lines) > 0.5 * len(lines):
        return "\t"
    scores = {mark: _score(fields(lines, mark)) for mark in (";", ",", " ")}
    if any(scores.values()):
        return max(scores, key=lambda mark: scores[mark])
    present = [mark for mark in DELIMITERS if mark in lines[0].strip()]
    return present[0] if present else ","


def _score(rows: Sequence[Row]) -> float:
    """How well a delimiter serves: the part of the cells that are numbers, in rows alike."""
    usual = _usual_width(rows)
    if usual < 2:
        return 0.0
    alike = [row for row in rows if len(row) == usual]
    cells = [cell for row in alike for cell in row if not is_missing(cell)]
    numbers = sum(_is_number(cell) for cell in cells)
    foreign = sum(";" in cell or "\t" in cell for cell in cells)
    weight = len(cells) + FOREIGN * foreign
    return numbers / weight * len(alike) / len(rows) if weight else 0.0


def _usual_width(rows: Sequence[Row]) -> int:
    return Counter(len(row) for row in rows).most_common(1)[0][0]


def _preamble(rows: Sequence[Row], usual: int) -> int:
    """How many rows above the header tell of the recording: numbers, but not in columns."""
    for k, row in enumerate(rows[1 : MOST_PREAMBLE + 1], 1):
        named = len(row) == usual and sum(bool(cell) for cell in row) > 1 and not _is_data(row)
        above = [one for one in rows[:k] if _is_data(one)]
        if named and above and all(len(one) != usual for one in above):
            return k
    return 0


def _width(header: Sequence[Row], data: Sequence[Row]) -> int:
    """How many columns there are; empty cells at the end of all rows are none."""
    usual = _usual_width(data)
    named = [len(_trimmed(row)) for row in header]
    fitting = [width for width in named if width <= usual]
    if max(fitting, default=0) > 1 or (named and usual == 1):
        return max(fitting)
    return max(named, default=0) or max(len(_trimmed(row)) for row in data if len(row) == usual)


def _trimmed(row: Row) -> Row:
    """A row without the empty cells at its end."""
    size = next((k for k in range(len(row), 0, -1) if row[k - 1].strip()), 0)
    return row[:size]


def _is_number(cell: str) -> bool:
    cell = cell.strip()
    return bool(_NUMBER.fullmatch(cell) or _CLOCK.fullmatch(cell))


def _is_data(row: Row) -> bool:
    return any(map(_is_number, row))


def _are_numbers_of_columns(row: Row) -> bool:
    """Whether a row is the header of a table whose columns are numbered: empty, 0, 1, 2, ..."""
    return len(row) > 2 and row == ["", *map(str, range(len(row) - 1))]


def _decimal(rows: Sequence[Row]) -> str:
    """The decimal sign of most numbers that have one."""
    cells = [cell.strip() for row in rows for cell in row]
    numbers = [cell for cell in cells if _NUMBER.fullmatch(cell)]
    commas, points = (sum(sign in cell for cell in numbers) for sign in ",.")
    return "," if commas > points else "."
