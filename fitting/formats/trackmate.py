"""Tables of TrackMate: spots, with up to four header rows, and older statistics with one."""

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


def is_spots(sample: Sample) -> bool:
    """Whether a table is of spots."""
    return {"position_x", "position_y"} <= sample.names


def spots(sample: Sample) -> Layout:
    """What stands where in a table of spots."""
    table = sample.table
    time, frames = first(table, "POSITION_T"), first(table, "FRAME")
    said = []
    if time is not None and _is_frame(sample, time, frames):
        said.append(f"{time} counts frames: the film had no frame interval")
        frames, time = frames or time, None
    return Layout(
        table,
        {Choice(): Place("POSITION_X", "POSITION_Y")},
        time=time,
        frames=frames,
        unit=unit_in_header(table, "POSITION_X"),
        time_unit=(time and time_unit_in_header(table, time)) or "s",
        y_down=True,
        track_column=first(table, "TRACK_ID"),
        said=tuple(said),
    )


def _is_frame(sample: Sample, time: str, frames: str | None) -> bool:
    """Whether times are numbers of frames: the unit says so, or they are the same."""
    table = sample.table
    cells = [row[table.column(time)].lower() for row in table.format.header]
    if any(cell in ("(frame)", "frame") for cell in cells):
        return True
    if frames is None or time_unit_in_header(table, time) is not None:
        return False
    both = table.numbers([time, frames]).values
    return bool((both[:, 0] == both[:, 1]).all())


FORMATS = (Format("trackmate", "spots of TrackMate", is_spots, spots),)
