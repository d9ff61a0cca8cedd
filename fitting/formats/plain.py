"""Tables whose columns have plain names: t, x, y, z, angle, or those with a unit behind them."""

import re

from derjax.io.tables import TextTable

from .layout import (
    FRAME_COLUMNS,
    Choice,
    Format,
    Layout,
    Place,
    Sample,
    time_unit_in_header,
    unit_in_header,
)

_BEHIND = r"(?:\s*[_\[( ]\s*[^\d]*)?"
_TIME = re.compile(rf"(t|time|timestamp|elapsed|elapsed time){_BEHIND}", re.IGNORECASE)
_ANGLE = re.compile(rf"(head_?angle|angle|theta|th|phi|rotation){_BEHIND}", re.IGNORECASE)
_DEGREES = re.compile(r".*[\[(_ ](deg|degrees|\N{DEGREE SIGN})[\])]?", re.IGNORECASE)


def is_any(sample: Sample) -> bool:
    """Every table may be one."""
    return bool(sample.table.format.width)


def plain(sample: Sample) -> Layout:
    """What the names of the columns say; nothing if there is no header."""
    table = sample.table
    if not table.format.header:
        return Layout(table, {Choice(): Place()})
    x, y, z = (_named(table, _axis(axis)) for axis in "xyz")
    time = _named(table, _TIME)
    angle = _named(table, _ANGLE)
    degrees = angle is not None and bool(_DEGREES.fullmatch(angle))
    frames = next((name for name in table.names if name.lower() in FRAME_COLUMNS), None)
    return Layout(
        table,
        {Choice(): Place(x, y, z)},
        time=time,
        frames=frames,
        unit=next((unit_in_header(table, name) for name in (x, y, z) if name), None),
        time_unit=(time and time_unit_in_header(table, time)) or "s",
        head_angle=angle,
        angle_unit="deg" if degrees else "rad",
    )


def _axis(axis: str) -> re.Pattern[str]:
    """What columns of one coordinate are called."""
    name = rf"(?:head|pos|position)?[_ ]?{axis}|{axis}[_ ]?(?:pos|position|head)|h{axis}"
    return re.compile(rf"(?:{name}){_BEHIND}", re.IGNORECASE)


def _named(table: TextTable, pattern: re.Pattern[str]) -> str | None:
    """The only column that has such a name."""
    found = [name for name in table.names if pattern.fullmatch(name)]
    return found[0] if len(found) == 1 else None


FORMATS = (Format("plain", "a table", is_any, plain),)
