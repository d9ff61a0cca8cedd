"""What the keys of a dataset leave open about a track, settled by what its file tells.

`settle` returns keys that say everything, the sentences on what was decided, and what has to be
asked for. Where `columns` are given the file is read as they say, as metres and seconds if no key
says otherwise; where they are left out the format says what the columns are, and units are asked
for if the file has none.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from derjax.io.fields import TIME_UNITS
from derjax.io.tables import TextTable

from .datasetfile import LENGTH_UNITS, Columns, RunFile
from .formats import Choice, Format, Layout, Place, Sample, recognised
from .formats.layout import are_frames, signed, unit_in_header
from .formats.made import numbered
from .formats.motive import ABOUT
from .objects import MOST_VALUES, Where, choose, counts, listed, objects, track_column
from .trackkeys import Axes

ROW = "row"
"""What the column t is called for tables that count nothing: the number of the row, from 1."""


@dataclass(frozen=True)
class Question:
    """What a file does not tell: the key that says it, and a sentence."""

    key: str
    sentence: str


@dataclass(frozen=True)
class Settled:
    """How a track is read.

    Attributes:
        format: that the file was recognised as.
        layout: what the file tells.
        table: to read.
        keys: with nothing left open. Where something is asked for they hold a stand-in: pixels are
            taken for the unit of length, frames for that of time, and the longest track is taken.
        where: the rows to take.
        objects: the tracks that there are, with their rows; empty where there is only one.
        likelihood: the column of the likelihood by which rows count.
        area: the column with sizes.
        said: what was decided, as sentences.
        asked: what has to be given.
    """

    format: Format
    layout: Layout
    table: TextTable
    keys: RunFile
    where: Where | None
    objects: dict[str, int]
    likelihood: str | None
    area: str | None
    said: tuple[str, ...]
    asked: tuple[Question, ...]


class _Open:
    """What is being settled: keys as they are found, sentences, questions."""

    def __init__(self, path: Path, run: RunFile) -> None:
        self.path, self.run = path, run
        self.found: dict[str, Any] = {}
        self.said: list[str] = []
        self.asked: list[Question] = []

    def given(self, *keys: str) -> bool:
        """Whether the dataset says one of these."""
        return any(
            key in self.run.model_fields_set and getattr(self.run, key) is not None for key in keys
        )

    def ask(self, key: str, sentence: str) -> None:
        self.asked.append(Question(key, f"{self.path}: {sentence}"))

    def get(self, key: str) -> Any:
        return self.found.get(key, getattr(self.run, key))


def settle(path: Path, run: RunFile) -> Settled:
    """All keys of a track, and what has to be asked for.

    Raises:
        InputError: the file is no text with tracks, or contradicts the keys.
    """
    sample = Sample(path)
    form = recognised(sample, run.format)
    layout = form.layout(sample)
    now = _Open(path, run)
    now.said.append(f"{form.title}: {layout.table.describe()}")
    free = run.columns is None
    choice, where, found = _object(now, layout)
    place = layout.places.get(choice, Place()) if free else Place()
    table = layout.table
    if free:
        now.said += layout.said
        _columns(now, layout, place)
    else:
        assert run.columns is not None
        now.found["columns"] = run.columns
    table = _clock(now, layout, table)
    _lengths(now, layout)
    _sense(now, layout)
    likelihood = _likelihood(now, layout, layout.places.get(choice))
    _said_of_columns(now)
    columns = [one for one in now.asked if one.key == "columns"]  # the others depend on these
    return Settled(
        form,
        layout,
        table,
        run.model_copy(update=now.found),
        where,
        found,
        likelihood,
        layout.area or _area(table),
        tuple(now.said),
        tuple(columns or now.asked),
    )


def _object(now: _Open, layout: Layout) -> tuple[Choice, Where | None, dict[str, int]]:
    """Which of several tracks is followed: columns, or rows."""
    run = now.run
    beside = list(dict.fromkeys(choice.track for choice in layout.places))
    if run.columns is None and len(beside) > 1:
        track = _wanted(now, "track_id", run.tracks[0] if run.tracks else None, beside, "tracks")
        node = _node(now, layout, track)
        return Choice(track, node), None, {one: 0 for one in beside}
    node = _node(now, layout, beside[0]) if run.columns is None else ""
    where, found = _rows(now, layout)
    return Choice(beside[0], node), where, found


def _node(now: _Open, layout: Layout, track: str) -> str:
    """Which point of an object is followed."""
    nodes = [choice.node for choice in layout.places if choice.track == track]
    if nodes == [""]:
        return ""
    wanted = now.run.node
    if wanted is None:
        heads = [node for node in nodes if node.lower() == "head"]
        if len(nodes) > 1 and heads:
            now.said.append(f"of the points {listed(nodes)} {heads[0]!r} is taken (key node)")
            return heads[0]
    return _wanted(now, "node", wanted, nodes, "points")


def _wanted(now: _Open, key: str, wanted: str | None, known: list[str], what: str) -> str:
    """One of several names: the one that is wanted, or the only one."""
    if wanted is not None and wanted in known:
        return wanted
    if wanted is not None:
        now.ask(key, f"{key} = {wanted!r}: there are {listed(known)}")
    elif len(known) > 1:
        now.ask(key, f"there are several {what}: {listed(known)}; choose one with {key}")
    return known[0]


def _rows(now: _Open, layout: Layout) -> tuple[Where | None, dict[str, int]]:
    """Which rows are of the object that is followed."""
    run, table = now.run, layout.table
    column = run.track_column or layout.track_column or track_column(table)
    if run.track_id is not None:
        return choose(table, column, run.tracks), counts(table, column) if column else {}
    if column is None or len(found := counts(table, column)) < 2:
        return None, {}
    known = objects(found)
    if len(known) == 1:
        now.said.append(
            f"the only track is {known[0]!r}; {sum(found.values()) - found[known[0]]} rows without "
            f"one in {column!r} are left out"
        )
        return (column, (known[0],)), found
    now.ask(
        "track_id",
        f"column {column!r} tells of several objects: {listed(list(found))}; "
        "choose with track_id which one to follow, or give a list of them",
    )
    longest = max(known, key=lambda one: found[one])
    return (column, (longest,)), found


def _columns(now: _Open, layout: Layout, place: Place) -> None:
    """The columns of what was tracked, as the format says."""
    angle = layout.head_angle
    if place.angles is not None:
        angle = _about(now.run.axes, place.angles)
        now.said.append(
            "head_angle is the spin, from the quaternions, about the axis that is the robot's x "
            "in the first frame (key axes), counted from there"
        )
    channels = {"x": place.x, "y": place.y, "z": place.z, "head_angle": angle}
    if angle is not None and not now.given("angle_unit"):
        now.found["angle_unit"] = layout.angle_unit
    if not any(channels.values()):
        now.ask(
            "columns",
            "it is not clear which columns hold what; say columns = "
            '{ t = "...", x = "...", y = "..." } with names of these: '
            + ", ".join(map(repr, layout.table.names[:MOST_VALUES]))
            + ("" if layout.table.format.header else " (there is no header: numbers of columns)"),
        )
        channels = {"x": layout.table.names[-1]}
    now.found["columns"] = Columns(**channels)


def _about(axes: Axes | None, names: tuple[str, str, str]) -> str:
    """The column with the angle about the robot's x axis."""
    assert len(names) == len(ABOUT)
    along = [1.0, 0.0, 0.0] if axes is None else axes.matrix[0].tolist()
    k = next(k for k in range(3) if along[k])
    return names[k] if along[k] > 0 else f"-{names[k]}"


def _clock(now: _Open, layout: Layout, table: TextTable) -> TextTable:
    """When a row is of: the column, its unit, frames in a second."""
    run, columns = now.run, now.found["columns"]
    if columns.t is not None:
        if run.fps is None and are_frames(table, columns.t) and not now.given("time_unit"):
            _fps(now, layout, columns.t)
        return _with_rows(table, columns.t)
    time, frames = layout.time, layout.frames
    if time is not None and run.fps is not None and frames is None:
        frames, time = time, None
    if time is not None and run.fps is None:
        now.found["columns"] = columns.model_copy(update={"t": time})
        if not now.given("time_unit"):
            now.found["time_unit"] = layout.time_unit if layout.time_unit in TIME_UNITS else "s"
        return table
    name = frames or ROW
    if frames is None:
        now.said.append("no column has times or frames: the rows count as frames")
    now.found["columns"] = columns.model_copy(update={"t": name})
    if run.fps is None:
        _fps(now, layout, name)
    return _with_rows(table, name)


def _with_rows(table: TextTable, name: str) -> TextTable:
    return numbered(table, ROW) if name == ROW and table.find(ROW) is None else table


def _fps(now: _Open, layout: Layout, column: str) -> None:
    """How many frames there are in a second, from the file, or asked for."""
    if layout.fps is not None:
        now.found["fps"] = layout.fps
        now.said.append(f"fps = {layout.fps:.6g}, as the file says")
        return
    now.found["fps"] = 1.0
    now.ask(
        "fps",
        f"column {column!r} seems to hold numbers of frames, not times in s; fps says how many "
        "frames there are in a second (fps = 1 for one a second)",
    )


def _lengths(now: _Open, layout: Layout) -> None:
    """The unit of positions."""
    run, columns = now.run, now.found["columns"]
    names = [name for channel, name in columns.tracked.items() if channel in "xyz"]
    if now.given("pixel_size") or not names:
        return
    said = layout.unit
    if run.columns is not None:
        table = layout.table
        seen = (unit_in_header(table, signed(table, name)[0]) for name in names)
        said = next((unit for unit in seen if unit), layout.unit if layout.unit == "px" else None)
    quoted = ", ".join(map(repr, names))
    if said == "px":
        now.found["pixel_size"] = 1.0
        now.ask(
            "pixel_size",
            f"columns {quoted} are in pixels; say pixel_size, the length of one in length_unit "
            '(pixel_size = 0.08 with length_unit = "mm" for 12.5 pixels in a millimetre)',
        )
    elif run.columns is None and not now.given("length_unit"):
        if said in LENGTH_UNITS:
            now.found["length_unit"] = said
            return
        now.found["pixel_size"] = 1.0
        now.ask(
            "pixel_size",
            f'the file has no unit for columns {quoted}; say length_unit ("mm"), and, if they are '
            "in pixels, pixel_size as well, the length of one in length_unit",
        )


def _sense(now: _Open, layout: Layout) -> None:
    """Whether the second coordinate points downwards."""
    if now.given("y_down"):
        return
    down = layout.y_down and now.run.columns is None
    now.found["y_down"] = down
    if down and now.found["columns"].y is not None:
        now.said.append("y points downwards, as in images, and is turned round (y_down = true)")


def _likelihood(now: _Open, layout: Layout, place: Place | None) -> str | None:
    """The column that says how sure a position is, if it counts."""
    column = None if place is None else place.likelihood
    least = now.run.likelihood
    if least is not None and column is None:
        now.ask("likelihood", "likelihood is given, but no column has one; leave it out")
        return None
    if least is None and now.run.columns is None and column is not None:
        least = layout.least_likelihood
        if least is None:
            now.said.append(f"{column!r} is not asked how sure a point is (key likelihood)")
            return None
        now.found["likelihood"] = least
        now.said.append(f"points with a likelihood below {least:g} count as lost (key likelihood)")
    return column if least is not None else None


def _area(table: TextTable) -> str | None:
    return next((name for name in table.names if name.lower() in ("area", "size", "mass")), None)


def _said_of_columns(now: _Open) -> None:
    """The columns, and what they are in, in words."""
    if now.run.columns is not None:
        return
    columns = now.found["columns"]
    parts = [f"t = {columns.t!r}", *(f"{c} = {n!r}" for c, n in columns.tracked.items())]
    now.said.append("columns: " + ", ".join(parts))
