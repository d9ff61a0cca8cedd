"""How a program writes tracks, as far as one of its files tells.

A format looks at a `Sample` of a file, and if it is one of its own, says in a `Layout` what stands
where. What a file does not tell is None there, and a key of the dataset has to say it.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from derjax import InputError
from derjax.io.tables import TextTable, read_table
from derjax.io.textfile import encoding_of

HEAD_LINES = 40
"""Lines from the beginning of a file by which its format is recognised."""

FRAME_COLUMNS = frozenset(
    ("frame", "frames", "frame_idx", "frame_number", "frame number", "slice", "image", "coords")
)
"""Names of columns with the numbers of frames, in small letters."""

_MU = "\N{GREEK SMALL LETTER MU}m"
_UNIT = re.compile(rf".*[\[(_ ](m|cm|mm|um|{_MU}|micron|px|pixel)s?[\])]?")
_SAME_UNIT = {_MU: "um", "micron": "um", "pixel": "px"}
_TIME = re.compile(r".*[\[(_ ](s|sec|second|ms|msec|us|min)s?[\])]?")
_SAME_TIME = {"sec": "s", "second": "s", "msec": "ms"}


class Sample:
    """A text file of which the format is asked.

    Attributes:
        path: of the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def encoding(self) -> str:
        """Of the file, as `open` calls it."""
        return encoding_of(self.path)

    @cached_property
    def head(self) -> list[str]:
        """Its first lines."""
        try:
            with self.path.open(encoding=self.encoding) as stream:
                return [line for _, line in zip(range(HEAD_LINES), stream, strict=False)]
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{self.path}: cannot be read: {error}") from None

    @cached_property
    def table(self) -> TextTable:
        """The file as a table.

        Raises:
            InputError: it is none.
        """
        return read_table(self.path)

    @cached_property
    def names(self) -> frozenset[str]:
        """All names of columns, in small letters; none if the file is no table."""
        try:
            header = self.table.format.header
        except InputError:
            return frozenset()
        return frozenset(cell.lower() for row in header for cell in row)


@dataclass(frozen=True)
class Place:
    """The columns that say where one point of one object is.

    Attributes:
        x, y, z: names of columns: to the right, up (or down) and towards the camera.
        likelihood: how sure the tracker was of the point, or was of the whole object.
        angles: columns with the angle about an axis that points to the right, up, and towards the
            camera in the first frame.
    """

    x: str | None = None
    y: str | None = None
    z: str | None = None
    likelihood: str | None = None
    angles: tuple[str, str, str] | None = None


class Choice(NamedTuple):
    """Which of several tracks that stand side by side: of which object, of which of its points."""

    track: str = ""
    node: str = ""


@dataclass(frozen=True)
class Layout:
    """What stands where in a file with tracks.

    Attributes:
        table: the file as a table, perhaps with columns that were computed from others.
        places: where the positions stand, of each object and point that has columns of its own.
        time: the column with times.
        frames: the column with numbers of frames.
        unit: of positions: a unit of length, "px", or None if the file does not tell.
        time_unit: of `time`.
        fps: frames in a second, if the file tells.
        y_down: whether y points downwards, as in images.
        head_angle: the column with the angle of the head about its axis.
        angle_unit: of the latter.
        track_column: the column that tells objects apart, if they stand one below the other.
        area: the column with the size of what was seen.
        least_likelihood: below which a point is usually taken for lost.
        said: what was found out, as sentences.
    """

    table: TextTable
    places: dict[Choice, Place]
    time: str | None = None
    frames: str | None = None
    unit: str | None = None
    time_unit: str = "s"
    fps: float | None = None
    y_down: bool = False
    head_angle: str | None = None
    angle_unit: str = "rad"
    track_column: str | None = None
    area: str | None = None
    least_likelihood: float | None = None
    said: tuple[str, ...] = ()


class Format(NamedTuple):
    """A way in which a program writes tracks.

    Attributes:
        name: as the key `format` calls it.
        title: what it is, in words.
        recognise: whether a file is of this kind.
        layout: what stands where in such a file; may raise `InputError`.
    """

    name: str
    title: str
    recognise: Callable[[Sample], bool]
    layout: Callable[[Sample], Layout]


def signed(table: TextTable, name: str) -> tuple[str, float]:
    """A column and its sense: what the name says, or what stands behind a minus."""
    if table.find(name) is None and name.startswith("-") and table.find(name[1:]) is not None:
        return name[1:], -1.0
    return name, 1.0


def unit_in_header(table: TextTable, name: str) -> str | None:
    """The unit of length, or "px", that the header says a column is in, if it does."""
    return _in_header(table, name, _UNIT, _SAME_UNIT)


def time_unit_in_header(table: TextTable, name: str) -> str | None:
    """The unit of time that the header says a column is in, if it does."""
    return _in_header(table, name, _TIME, _SAME_TIME)


def _in_header(
    table: TextTable, name: str, pattern: re.Pattern[str], same: dict[str, str]
) -> str | None:
    place = table.column(name)
    for row in table.format.header:
        if match := pattern.fullmatch(row[place].lower()):
            return same.get(match[1], match[1])
    return None


def are_frames(table: TextTable, name: str) -> bool:
    """Whether the header says that a column holds numbers of frames."""
    cells = [row[table.column(name)] for row in table.format.header]
    return any(cell.lower().strip("()[]") in FRAME_COLUMNS for cell in cells)


def first(table: TextTable, *names: str) -> str | None:
    """The first of some names that a column has, in any case of letters."""
    known = {cell.lower(): cell for row in table.format.header for cell in row if cell}
    return next((known[name.lower()] for name in names if name.lower() in known), None)
