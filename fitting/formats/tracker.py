"""Tables of Tracker (Physlets): a line with names of tracks, then t, x, y, ... of each.

Delimiter and decimal sign are those of the locale, every line ends with a delimiter, and points
that were not found are empty. y points upwards; there is no unit.
"""

from .layout import Choice, Format, Layout, Place, Sample


def is_tracks(sample: Sample) -> bool:
    """Whether a table has the names of tracks above t, x, y."""
    if not {"t", "x", "y"} <= sample.names:
        return False
    header = sample.table.format.header
    last = [cell.lower() for row in header[-1:] for cell in row]
    multi = sample.head[0].lstrip("\ufeff").lower().startswith("#multi")
    named = len(header) == 2 and header[0][0] != "" and "t" not in map(str.lower, header[0])
    return last[0] == "t" and (multi or named)


def tracks(sample: Sample) -> Layout:
    """What stands where: the columns of each track side by side."""
    table = sample.table
    *above, last = table.format.header
    names = table.names
    titles = above[0] if above else ("",) * len(names)
    found: dict[str, dict[str, str]] = {}
    title = ""
    for k, cell in enumerate(last):
        title = titles[k] or title
        if cell.lower() in ("x", "y"):
            found.setdefault(title, {})[cell.lower()] = names[k]
    several = len(found) > 1
    places = {
        Choice(track=title if several else ""): Place(columns.get("x"), columns.get("y"))
        for title, columns in found.items()
    }
    said = [] if several else [f"the track is {title!r}"] * bool(title)
    return Layout(table, places, time=names[0], said=tuple(said))


FORMATS = (Format("tracker", "Tracker (Physlets)", is_tracks, tracks),)
