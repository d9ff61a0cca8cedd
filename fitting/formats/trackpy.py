"""Tables of trackpy, as pandas saves them: y before x, frame and particle."""

from .layout import Choice, Format, Layout, Place, Sample, first

FEATURES = frozenset(("mass", "size", "ecc", "signal", "raw_mass", "ep"))
"""What trackpy measures of every feature."""


def is_features(sample: Sample) -> bool:
    """Whether a table is of features."""
    names = sample.names
    return {"x", "y", "frame"} <= names and len(names & FEATURES) >= 2


def features(sample: Sample) -> Layout:
    """What stands where in a table of features."""
    table = sample.table
    return Layout(
        table,
        {Choice(): Place("x", "y")},
        frames="frame",
        unit="px",
        y_down=True,
        track_column=first(table, "particle"),
        area=first(table, "mass"),
    )


FORMATS = (Format("trackpy", "trackpy", is_features, features),)
