"""Tracks that TrackMate exports as XML: a list of detections for each particle."""

from collections.abc import Iterator
from typing import Any
from xml.parsers import expat

from derjax import InputError

from .layout import Choice, Format, Layout, Place, Sample
from .made import Row, table_of

NAMES = ("particle", "t", "x", "y", "z")

UNITS = {"micron": "um", "\N{GREEK SMALL LETTER MU}m": "um", "\N{MICRO SIGN}m": "um", "pixel": "px"}
KNOWN = ("m", "cm", "mm", "um", "px")
SECONDS = {"sec": 1.0, "s": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3}
SECONDS |= {"min": 60.0}


def is_tracks(sample: Sample) -> bool:
    """Whether a file is such a list."""
    return any("<Tracks" in line for line in sample.head)


def tracks(sample: Sample) -> Layout:
    """What stands where: the rows are detections, and t is the number of the frame."""
    file, rows = _parsed(sample)
    unit = file.get("spaceUnits", "").strip()
    unit = UNITS.get(unit, unit)
    said = [f"{file.get('nTracks', '?')} tracks, spaceUnits {file.get('spaceUnits', 'none')!r}"]
    fps = None
    unit_of_time, interval = file.get("timeUnits", ""), file.get("frameInterval", "")
    try:
        fps = 1.0 / (float(interval) * SECONDS[unit_of_time.strip().lower()])
        said.append(f"frameInterval {interval} {unit_of_time}")
    except (ValueError, KeyError, ZeroDivisionError):
        said.append(f"frameInterval {interval or 'none'} {unit_of_time} is no time")
    return Layout(
        table_of(sample.path, sample.encoding, NAMES, lambda: iter(rows)),
        {Choice(): Place("x", "y")},
        frames="t",
        unit=unit if unit in KNOWN else None,
        fps=fps,
        y_down=True,
        track_column="particle",
        said=tuple(said),
    )


def _parsed(sample: Sample) -> tuple[dict[str, str], list[tuple[int, Row]]]:
    """What the file says of all tracks, and a row for every detection."""
    parser = expat.ParserCreate()
    file: dict[str, str] = {}
    rows: list[tuple[int, Row]] = []
    particle = -1

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal particle
        line = parser.CurrentLineNumber
        if name == "Tracks":
            file.update(attributes)
        elif name == "particle":
            particle += 1
        elif name == "detection":
            missing = [key for key in ("t", "x", "y") if key not in attributes]
            if missing:
                raise InputError(f"{sample.path}: line {line}: a detection without {missing[0]}")
            cells = [attributes.get(key, "") for key in NAMES[1:]]
            rows.append((line, [str(particle), *cells]))

    def declared(*_: Any) -> None:
        raise InputError(f"{sample.path}: declares entities, which no tracker does; not read")

    parser.StartElementHandler = start
    parser.EntityDeclHandler = declared
    try:
        for piece in _pieces(sample):
            parser.Parse(piece)
        parser.Parse(b"", True)
    except expat.ExpatError as error:
        raise InputError(f"{sample.path}: line {error.lineno}: is not whole XML: {error}") from None
    if not rows:
        raise InputError(f"{sample.path}: no detections in it; export the tracks once more")
    return file, rows


def _pieces(sample: Sample) -> Iterator[bytes]:
    try:
        with sample.path.open("rb") as stream:
            while piece := stream.read(1 << 20):
                yield piece
    except OSError as error:
        raise InputError(f"{sample.path}: cannot be read: {error.strerror or error}") from None


FORMATS = (Format("trackmate-xml", "tracks of TrackMate, as XML", is_tracks, tracks),)
