"""Tables of ImageJ and Fiji: Results of measurements, Manual Tracking, MTrackJ.

Results have a column without a name for the numbers of the rows, commas or tabs, no unit, y
downwards, and one row for each particle, so that dust gives several in a slice.
"""

import re
from collections.abc import Iterator, Sequence

from derjax import InputError
from derjax.io.tables import TextTable

from .layout import (
    Choice,
    Format,
    Layout,
    Place,
    Sample,
    first,
    time_unit_in_header,
    unit_in_header,
)
from .made import numbered, with_columns

MEASURED = frozenset(("area", "mean", "min", "max", "xm", "x", "slice", "label", "frame", "angle"))
ENOUGH = 3
"""Names of measurements by which a table without numbers of rows is known."""

_LABEL = re.compile(r".*?:0*(\d+)(?:/\d+)?(?::.*)?")
LABEL_FRAME = "frame of Label"
"""Name of the column with the numbers of slices that labels hold."""


def is_results(sample: Sample) -> bool:
    """Whether a table is of measurements in ImageJ."""
    names = sample.names
    if not names & {"x", "xm"}:
        return False
    unnamed = sample.table.format.header[0][0] == ""
    return len(names & MEASURED) >= (2 if unnamed else ENOUGH)


def results(sample: Sample) -> Layout:
    """What stands where in Results."""
    table = sample.table
    x, y = ("X", "Y") if "x" in sample.names else ("XM", "YM")
    said = [f"positions are {'centroids' if x == 'X' else 'centres of mass'} ({x}, {y})"]
    frames = first(table, "Slice", "Frame")
    if frames is not None and first(table, "Frame") and len(set(table.text(frames))) == 1:
        frames = first(table, "Frame")
    if frames is None and (label := first(table, "Label")) is not None:
        table, frames = _with_frames_of_labels(table, label)
        said.append(f"frames are the numbers in {label!r}")
    if frames is None:
        table, frames = numbered(table, "row"), "row"
        said.append("frames are the rows, as there is no column Slice, Frame or Label")
    if "angle" in sample.names:
        said.append(
            "Angle is not taken: it is that of an ellipse, modulo 180 degrees; if the camera looks "
            "along the robot's axis, say columns.head_angle with angle_unit and angle_period"
        )
    area = first(table, "Area")
    if area is not None and len(set(table.text(area))) < 2:
        area = None
    return Layout(
        table, {Choice(): Place(x, y)}, frames=frames, y_down=True, area=area, said=tuple(said)
    )


def _with_frames_of_labels(table: TextTable, label: str) -> tuple[TextTable, str]:
    place = table.column(label)

    def numbers(rows: Iterator[tuple[int, list[str]]]) -> Iterator[Sequence[str]]:
        for line, row in rows:
            if (match := _LABEL.fullmatch(row[place].strip())) is None:
                raise InputError(
                    f"{table.path}: line {line}, column {label!r}: no number of a slice in "
                    f"{row[place]!r}, like film.avi:0001; name the column of frames or times "
                    'with columns = { t = "..." }'
                )
            yield (match[1],)

    return with_columns(table, [LABEL_FRAME], numbers), LABEL_FRAME


def is_manual(sample: Sample) -> bool:
    """Whether a table is of the plugin Manual Tracking."""
    starts = {name[:7] for name in sample.names}
    return {"track n", "slice n"} <= starts and "pixel value" in sample.names


def manual(sample: Sample) -> Layout:
    """What stands where in tables of Manual Tracking: positions in pixels."""
    table = sample.table
    header = table.format.header[-1]
    track, frames = (
        next(name for name in header if name.lower().startswith(start))
        for start in ("track n", "slice n")
    )
    return Layout(
        table,
        {Choice(): Place("X", "Y")},
        frames=frames,
        unit="px",
        y_down=True,
        track_column=track,
        said=("Manual Tracking writes X and Y in pixels",),
    )


def is_mtrackj(sample: Sample) -> bool:
    """Whether a table is of the plugin MTrackJ."""
    return {"tid", "pid"} <= sample.names and any(n.startswith("x [") for n in sample.names)


def mtrackj(sample: Sample) -> Layout:
    """What stands where in tables of MTrackJ: with units in brackets."""
    table = sample.table
    header = table.format.header[-1]
    x, y, t = (next((n for n in header if n.startswith(f"{c} [")), None) for c in "xyt")
    if x is None or y is None:
        raise InputError(f"{table.path}: line {table.format.header_line}: no columns x and y")
    return Layout(
        table,
        {Choice(): Place(x, y)},
        time=t,
        frames=None if t is not None else "PID",
        unit=unit_in_header(table, x),
        time_unit=(t and time_unit_in_header(table, t)) or "s",
        y_down=True,
        track_column="TID",
    )


FORMATS = (
    Format("manual-tracking", "Manual Tracking (ImageJ, Fiji)", is_manual, manual),
    Format("mtrackj", "MTrackJ (ImageJ, Fiji)", is_mtrackj, mtrackj),
    Format("imagej", "Results (ImageJ, Fiji)", is_results, results),
)
