"""Tables with columns that do not stand in the file: computed from others, or from no table."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from derjax.io.sniffing import Format
from derjax.io.tables import TextTable

Row = list[str]
Rows = Callable[[], Iterator[tuple[int, Row]]]


@dataclass(frozen=True)
class MadeTable(TextTable):
    """A table whose rows come from a function.

    Attributes:
        source: gives the rows, each with the line of the file that it is from.
    """

    source: Rows = field(kw_only=True)

    def rows(self) -> Iterator[tuple[int, Row]]:
        """The rows, with the lines that they are from."""
        return self.source()


def with_columns(
    table: TextTable,
    names: Sequence[str],
    compute: Callable[[Iterator[tuple[int, Row]]], Iterator[Sequence[str]]],
) -> MadeTable:
    """A table with more columns.

    Args:
        table: the others.
        names: of the new columns.
        compute: from the rows of the table, in order, the cells of each in the new columns.
    """
    kind = table.format
    width = kind.width
    blank = ("",) * len(names)
    header = [row + blank for row in kind.header[:-1]]
    last = kind.header[-1] if kind.header else tuple(table.names)
    header.append(last + tuple(names))

    def rows() -> Iterator[tuple[int, Row]]:
        new = compute(table.rows())
        for (line, row), cells in zip(table.rows(), new, strict=True):
            yield line, [*row[:width], *cells]

    wider = kind._replace(width=width + len(names), header=tuple(header))
    return MadeTable(table.path, table.encoding, wider, source=rows)


def table_of(path: Path, encoding: str, names: Sequence[str], rows: Rows) -> MadeTable:
    """A table of rows that were made otherwise, with decimal points."""
    kind = Format(",", ".", len(names), (tuple(names),), 1, 1)
    return MadeTable(path, encoding, kind, source=rows)


def numbered(table: TextTable, name: str) -> MadeTable:
    """A table with the number of each row, from 1, in a column more."""

    def count(rows: Iterator[tuple[int, Row]]) -> Iterator[Sequence[str]]:
        return ((str(k),) for k, _ in enumerate(rows, 1))

    return with_columns(table, [name], count)
