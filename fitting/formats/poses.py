"""Tables of DeepLabCut and SLEAP: several points of each object, and how sure of each they are."""

import re

from derjax import InputError

from .layout import Choice, Format, Layout, Place, Sample, first

USUAL_LIKELIHOOD = 0.6
"""Below which DeepLabCut takes a point for lost unless it is told otherwise."""

_NODE = re.compile(r"(.*)\.(x|y|score)")


def is_deeplabcut(sample: Sample) -> bool:
    """Whether a table has the header rows of DeepLabCut."""
    return {"scorer", "bodyparts", "coords"} <= sample.names


def deeplabcut(sample: Sample) -> Layout:
    """What stands where in a table of DeepLabCut."""
    table = sample.table
    rows = {row[0].lower(): row for row in table.format.header}
    parts, coords = rows["bodyparts"], rows["coords"]
    people = rows.get("individuals", ("",) * len(parts))
    several = len(set(people[1:])) > 1
    found: dict[Choice, dict[str, str]] = {}
    for k in range(1, len(coords)):
        choice = Choice(people[k] if several else "", parts[k])
        found.setdefault(choice, {})[coords[k].lower()] = table.names[k]
    places = {
        choice: Place(columns.get("x"), columns.get("y"), likelihood=columns.get("likelihood"))
        for choice, columns in found.items()
    }
    return Layout(
        table,
        places,
        frames="coords",
        unit="px",
        y_down=True,
        least_likelihood=USUAL_LIKELIHOOD,
    )


def is_sleap(sample: Sample) -> bool:
    """Whether a table has the columns of SLEAP."""
    return {"frame_idx", "instance.score"} <= sample.names


def sleap(sample: Sample) -> Layout:
    """What stands where in a table of SLEAP."""
    table = sample.table
    found: dict[str, dict[str, str]] = {}
    for name in table.names:
        if (match := _NODE.fullmatch(name)) and match[1] != "instance":
            found.setdefault(match[1], {})[match[2]] = name
    places = {
        Choice(node=node): Place(columns["x"], columns["y"], likelihood=columns.get("score"))
        for node, columns in found.items()
        if {"x", "y"} <= columns.keys()
    }
    if not places:
        raise InputError(
            f"{table.path}: line {table.format.header_line}: no columns like head.x and head.y"
        )
    return Layout(
        table,
        places,
        frames="frame_idx",
        unit="px",
        y_down=True,
        track_column=first(table, "track"),
    )


FORMATS = (
    Format("deeplabcut", "DeepLabCut", is_deeplabcut, deeplabcut),
    Format("sleap", "SLEAP", is_sleap, sleap),
)
