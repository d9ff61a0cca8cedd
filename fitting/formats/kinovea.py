"""Tables of Kinovea: quoted cells, "Track 1/0/X", and in older ones times like 0:00:00:03."""

import re
from collections.abc import Iterator, Sequence

import numpy as np

from derjax import InputError
from derjax.io.tables import TextTable

from .layout import Choice, Format, Layout, Place, Sample, time_unit_in_header
from .made import with_columns

_POINT = re.compile(r"(.*)/(\d+)/([xy])", re.IGNORECASE)
_CLOCK = re.compile(r"(\d+):(\d+):(\d+):(\d+)")

SECONDS = "Time in s"
"""Name of the column with times that were a clock's."""

HUNDREDTHS = 1.5
"""By how many hundredths (or thousandths) of a second steps in time are rounded, at most."""


def is_tracks(sample: Sample) -> bool:
    """Whether a table has columns of points of tracks."""
    return any(map(_POINT.fullmatch, sample.names)) and any(
        name.startswith("time") for name in sample.names
    )


def tracks(sample: Sample) -> Layout:
    """What stands where: the columns of each track side by side."""
    table = sample.table
    found: dict[tuple[str, str], dict[str, str]] = {}
    for name in table.names:
        if match := _POINT.fullmatch(name):
            found.setdefault((match[1], match[2]), {})[match[3].lower()] = name
    tracks, points = (len({key[k] for key in found}) for k in (0, 1))
    places = {
        Choice(track if tracks > 1 else "", point if points > 1 else ""): Place(
            columns.get("x"), columns.get("y")
        )
        for (track, point), columns in found.items()
    }
    time = next(name for name in table.names if name.lower().startswith("time"))
    unit = time_unit_in_header(table, time) or "s"
    said: tuple[str, ...] = ()
    cells = table.text(time)
    if any(map(_CLOCK.fullmatch, cells)):
        table, said = _with_seconds(table, time, cells)
        time = SECONDS
    return Layout(table, places, time=time, time_unit=unit, said=said)


def _with_seconds(
    table: TextTable, time: str, cells: Sequence[str]
) -> tuple[TextTable, tuple[str, ...]]:
    """The table with times in s, if what follows the last colon is a part of a second."""
    place = table.column(time)
    matches = [match for match in map(_CLOCK.fullmatch, cells) if match]
    parts = 10.0 ** max(2, *(len(match[4]) for match in matches))

    def seconds(cell: str) -> float:
        match = _CLOCK.fullmatch(cell.strip())
        if match is None:
            raise InputError(f"{table.path}: column {time!r}: not a time of a clock: {cell!r}")
        hours, minutes, whole, rest = map(int, match.groups())
        return 3600.0 * hours + 60.0 * minutes + whole + rest / parts

    steps = np.diff([seconds(match[0]) for match in matches])
    usual = float(np.median(steps)) if len(steps) else 0.0
    off = np.abs(steps - usual * np.round(steps / usual)) * parts if usual > 0 else [np.inf]
    if np.max(off) > HUNDREDTHS:
        raise InputError(
            f"{table.path}: column {time!r}: after the last colon of {cells[-1]!r} seem to stand "
            "frames, not parts of a second; export times in seconds"
        )

    def compute(rows: Iterator[tuple[int, list[str]]]) -> Iterator[Sequence[str]]:
        return ((repr(seconds(row[place])),) for _, row in rows)

    name = "hundredths" if parts == 100 else "thousandths"
    said = f"times like {cells[-1]} are hours:minutes:seconds:{name}"
    kind = table.format
    made = with_columns(table, [SECONDS], compute)
    if kind.decimal == ",":
        made = with_columns(table, [SECONDS], lambda rows: _commas(compute(rows)))
    return made, (said,)


def _commas(rows: Iterator[Sequence[str]]) -> Iterator[Sequence[str]]:
    """Cells with decimal commas, as the others of their table."""
    return ([cell.replace(".", ",") for cell in row] for row in rows)


FORMATS = (Format("kinovea", "Kinovea", is_tracks, tracks),)
