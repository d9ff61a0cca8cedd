"""Tables of OptiTrack Motive: rigid bodies in space, with their orientation.

Above the columns stand some lines on the recording and on what the columns are of. y points
upwards. The angle of the head is the spin about its own axis, from the quaternions; the axis is
known by the direction in which it points in the first frame.
"""

import csv
import math
from collections.abc import Iterator, Sequence

import numpy as np

from derjax import InputError
from derjax.io.sniffing import Format as Written
from derjax.io.sniffing import is_missing
from derjax.io.tables import TextTable

from .layout import Choice, Format, Layout, Place, Sample
from .made import with_columns

UNITS = {"meters": "m", "centimeters": "cm", "millimeters": "mm"}
AXES = ("x", "y", "z", "w")
ABOUT = ("angle about right", "angle about up", "angle about towards")


def is_take(sample: Sample) -> bool:
    """Whether a file is such a table."""
    return bool(sample.head) and sample.head[0].lstrip("\ufeff").startswith("Format Version")


def take(sample: Sample) -> Layout:
    """What stands where: the bodies side by side."""
    rows = list(csv.reader(sample.head, skipinitialspace=True))
    about = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    start = next((k for k, row in enumerate(rows) if row[:1] == ["Frame"]), None)
    if start is None:
        raise InputError(f"{sample.path}: no line that begins with Frame; is the export whole?")
    names, bodies = _columns(sample, rows[1:start], rows[start])
    written = Written(",", ".", len(names), (tuple(names),), start + 2, start + 1)
    table: TextTable = TextTable(sample.path, sample.encoding, written)
    turning = about.get("Rotation Type", "") == "Quaternion"
    places = {}
    for body in bodies:
        title = f"{body} " if body else ""
        place = [f"{title}position {axis}" for axis in "xyz"]
        turn = [f"{title}rotation {axis}" for axis in AXES]
        angles = None
        if turning and set(turn) <= set(names):
            angles = (f"{title}{ABOUT[0]}", f"{title}{ABOUT[1]}", f"{title}{ABOUT[2]}")
            table = _with_angles(table, turn, angles)
        places[Choice(track=body)] = Place(*place, angles=angles)
    unit = about.get("Length Units", "")
    said = [f"Length Units {unit or 'none'}, Capture Frame Rate {about.get('Capture Frame Rate')}"]
    if not turning:
        said.append(
            f"no head_angle: Rotation Type is {about.get('Rotation Type', 'not given')}; "
            "export quaternions"
        )
    return Layout(
        table,
        places,
        time="Time (Seconds)",
        frames="Frame",
        unit=UNITS.get(unit.lower()),
        said=tuple(said),
    )


def _columns(
    sample: Sample, above: Sequence[list[str]], last: list[str]
) -> tuple[list[str], list[str]]:
    """Names of all columns, and of the bodies; one body has no name."""
    width = len(last)
    above = [row + [""] * (width - len(row)) for row in above if any(row)]
    kinds = next((row for row in above if "Rigid Body" in row), None)
    what = next((row for row in above if "Position" in row), None)
    if kinds is None or what is None:
        raise InputError(
            f"{sample.path}: no rigid body in it; define one of the markers of the head in Motive"
        )
    titles = above[above.index(kinds) + 1]
    wanted = [k for k in range(width) if kinds[k] == "Rigid Body"]
    bodies = list(dict.fromkeys(titles[k] for k in wanted))
    several = len(bodies) > 1
    names = list(last)
    for k in range(2, width):
        names[k] = f"column {k + 1}"
        if k in wanted and what[k] in ("Position", "Rotation"):
            title = f"{titles[k]} " if several else ""
            names[k] = f"{title}{what[k].lower()} {last[k].lower()}"
    return names, bodies if several else [""]


def _with_angles(table: TextTable, turn: Sequence[str], names: Sequence[str]) -> TextTable:
    """The table with the angle about each of three axes of the body in three columns."""
    places = [table.column(name) for name in turn]

    def compute(rows: Iterator[tuple[int, list[str]]]) -> Iterator[Sequence[str]]:
        first: np.ndarray | None = None
        last, angle = np.empty(4), np.zeros(3)
        for line, row in rows:
            cells = [row[place] for place in places]
            if any(map(is_missing, cells)):
                yield "", "", ""
                continue
            try:
                now = np.array([float(cell) for cell in cells])
            except ValueError:
                raise InputError(f"{table.path}: line {line}: not a rotation: {cells}") from None
            if first is None:
                first = last = now
            angle = angle + _twists(first, last, now)
            last = now
            yield tuple(repr(float(one)) for one in angle)

    return with_columns(table, names, compute)


def _twists(first: np.ndarray, last: np.ndarray, now: np.ndarray) -> np.ndarray:
    """By how much a body has spun from `last` to `now` about axes that it carries along, rad.

    In the first frame these were the axes of space. Quaternions are x, y, z, w. What the turn
    between two frames is besides the spin is the shortest turn of the axis.
    """
    moved = _product(_inverse(last), now)  # in the axes of the body
    spun = _product(_product(first, moved), _inverse(first))
    spins = [2.0 * math.atan2(spun[k], spun[3]) for k in range(3)]
    return np.array([(spin + math.pi) % (2.0 * math.pi) - math.pi for spin in spins])


def _inverse(q: np.ndarray) -> np.ndarray:
    return q * np.array([-1.0, -1.0, -1.0, 1.0])


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    vector = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
    return np.append(vector, a[3] * b[3] - a[:3] @ b[:3])


FORMATS = (Format("motive", "OptiTrack Motive", is_take, take),)
