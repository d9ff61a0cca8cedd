"""Files that hold no track as text: what they are, and what to export instead."""

import re
from pathlib import Path

from derjax import InputError

from .layout import Sample

MOST_BYTES = 200_000_000
"""Size of files beyond which no track is looked for: one frame takes some hundred bytes."""

_KINDS = (
    (re.compile(r"\s*[{\[]\s*[\"{\[\]}]"), "JSON, not a table; export the track as a table (CSV)"),
    (re.compile(r"(?s).*<TrackMate\b"), "a session of TrackMate; export its spots as CSV, or its "
     "tracks as XML (Export tracks to XML file)"),
    (re.compile(r"(?s).*<(Kinovea|KinoveaVideoAnalysis)"), "an analysis of Kinovea; export its "
     "trajectories as CSV"),
    (re.compile(r"(?s)\s*<\?xml.*<object class=\"org\.opensourcephysics"), "a session of Tracker; "
     "copy or export the table of its points as text"),
    (re.compile(r"(?is)\s*<(!doctype html|html)"), "a web page, not a table"),
)  # fmt: skip


def check(sample: Sample) -> None:
    """Raises `InputError` if a file is too large, or text but no table."""
    path = sample.path
    size = _size(path)
    if size > MOST_BYTES:
        raise InputError(
            f"{path}: has {size / 1e6:.0f} MB: too much for the track of one robot, and more than "
            f"the {MOST_BYTES / 1e6:.0f} MB that are read; export the positions of one object only"
        )
    head = "".join(sample.head).lstrip("\ufeff")
    for pattern, kind in _KINDS:
        if pattern.match(head):
            raise InputError(f"{path}: is {kind}")
    if head.lstrip().startswith("<?xml") and "<Tracks" not in head:
        raise InputError(f"{path}: is XML, but no tracks of TrackMate; export a table (CSV)")


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
