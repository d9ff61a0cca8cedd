"""A dataset file to start from: what was understood of some tracks, and what is left to say."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from derjax.io.fields import Table

from ..datasetfile import Columns, RunFile
from .understood import Understood

HEAD = """\
# Tracks, and how they are read. To fit parameters to them:
#
#     derjax fit {name} -o fit
#
# Say which robot it is (scene), how fast its motor turned in each track (motor_rpm), and what is
# marked with "needed". A line that begins with "# key =" is an option that is off. All keys:
# docs/from_film_to_parameters.md, and the dataset.toml of "derjax new".

scene = "scene.toml"       # the robot: a file as "derjax new" writes it
"""

EXAMPLES = {
    "pixel_size": ("0.08", "needed if positions are in pixels: the length of one, in length_unit"),
    "fps": ("25", "needed: frames in a second"),
    "track_id": ('"..."', "needed: the track to follow"),
    "node": ('"..."', "needed: the point to follow"),
}

FOUND = ("likelihood", "y_down", "time_unit", "fps", "angle_unit", "length_unit")
"""Keys that are written as they were settled, in this order."""

MARGIN = 27


def draft(tracks: Sequence[Understood], directory: Path, name: str) -> str:
    """The text of a dataset file in some directory."""
    return HEAD.format(name=name) + "".join(_run(one, directory) for one in tracks)


def _run(one: Understood, directory: Path) -> str:
    keys = one.keys
    lines = ["", "[[runs]]"]

    def say(key: str, value: Any, comment: str = "", on: bool = True) -> None:
        text = f"{'' if on else '# '}{key} = {value if isinstance(value, Raw) else toml(value)}"
        lines.append(f"{text:<{MARGIN - 1}} # {comment}" if comment else text)

    say("track", Path(os.path.relpath(one.path, directory)).as_posix())
    say("motor_rpm", Raw("60.0"), "needed: revolutions per minute, or a list, one a motor", False)
    assert keys.columns is not None
    if one.run.columns is None:
        say("format", one.settled.format.name, one.settled.format.title)
        say("columns", Raw(_columns(keys.columns)), "what the format says", False)
    else:
        say("columns", Raw(_columns(one.run.columns)))
    asked = one.asked
    written = {"track", "columns", "format", "motor_rpm", "origin", *asked}
    if "pixel_size" in asked:
        say("length_unit", "mm", "of pixel_size, or of positions", on=False)
        written.add("length_unit")
    for key in [key for key in EXAMPLES if key in asked]:
        value, comment = EXAMPLES[key]
        say(key, Raw(value), f"{comment}{_choices(one, key)}", on=False)
    for key in [*FOUND, *RunFile.model_fields]:
        value = getattr(keys, key)
        default = RunFile.model_fields[key].default
        if key in written or value is None or value == default:
            continue
        written.add(key)
        say(key, value, _comment(key, one.settled.layout.y_down))
    say("origin", "track", "only displacements count: the camera's origin is not the scene's")
    return "\n".join(lines) + "\n"


def _choices(one: Understood, key: str) -> str:
    if key == "track_id" and one.settled.objects:
        return ", one of " + ", ".join(map(repr, list(one.settled.objects)[:8]))
    return ""


def _comment(key: str, down: bool) -> str:
    return {
        "y_down": "images count downwards" if down else "",
        "fps": "frames in a second",
        "likelihood": "less sure positions count as not found",
    }.get(key, "")


class Raw(str):
    """A value that is TOML already."""


def _columns(columns: Columns) -> str:
    named = {"t": columns.t, **columns.tracked}
    return "{ " + ", ".join(f"{k} = {toml(v)}" for k, v in named.items() if v is not None) + " }"


def toml(value: Any) -> str:
    """A value of a key as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, tuple):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, Table):
        return toml(value.model_dump(exclude_none=True))
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {toml(v)}" for k, v in value.items()) + " }"
    return repr(value)
