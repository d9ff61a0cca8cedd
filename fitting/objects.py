"""Tables of several objects: which rows are of the one that is followed."""

from collections import Counter

from derjax import InputError
from derjax.io.tables import TextTable, same

TRACK_COLUMNS = frozenset(
    ("track_id", "track id", "tid", "track", "track no", "particle", "individual", "object")
)
"""Names of columns by which programs tell objects apart, in small letters."""

NO_OBJECT = frozenset(("", "\N{LATIN SMALL LETTER O WITH STROKE}", "nan", "none"))
"""What stands in such a column for what belongs to no object, in small letters."""

MOST_VALUES = 8
"""Objects that a message lists at most."""

Where = tuple[str, tuple[str, ...]]
"""A column, and the values that its rows have."""


def track_column(table: TextTable) -> str | None:
    """The column that tells objects apart, if one has a name of such."""
    for row in (table.names, *table.format.header):
        for place, name in enumerate(row):
            if name.lower() in TRACK_COLUMNS:
                return table.names[place]
    return None


def counts(table: TextTable, column: str) -> dict[str, int]:
    """How often each value stands in a column, in order of appearance."""
    return dict(Counter(table.text(column)))


def objects(found: dict[str, int]) -> list[str]:
    """The values that stand for an object."""
    return [value for value in found if value.lower() not in NO_OBJECT]


def choose(table: TextTable, column: str | None, wanted: tuple[str, ...]) -> Where:
    """The rows of the objects that are wanted.

    Raises:
        InputError: it is not clear which column is meant, or there are none of these.
    """
    if column is None:
        raise InputError(
            f"{table.path}: track_id is given, but it is not clear which column it is of; set "
            f"track_column to one of {', '.join(map(repr, table.names))}"
        )
    values = list(counts(table, column))
    for one in wanted:
        if not any(same(value, one) for value in values):
            raise InputError(
                f"{table.path}: track_id = {one}: column {column!r} has {listed(values)}"
            )
    return column, wanted


def listed(values: list[str]) -> str:
    """Values as a message lists them."""
    shown = ", ".join(value or "nothing" for value in values[:MOST_VALUES])
    return shown if len(values) <= MOST_VALUES else f"{shown}, ..."
