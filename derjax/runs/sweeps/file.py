"""Sweep files: which keys of a scene file vary, and over what.

    scene = "scene.toml"

    [vary]
    rpm = { from = 20, to = 100, count = 9 }
    C_t = [4.0, 4.8, 5.6]

Keys of `[vary]` are the parameters of the scene (`SceneFile.parameters`), or any key of the scene
file by table and name, such as `"robot.n_flagella"`.
"""

import contextlib
import difflib
import itertools
import math
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Field, create_model

from ...core.errors import InputError, InputWarning
from ...io.fields import Count, Finite, Switch, Table
from ...scenes.effects import idle_keys
from ...scenes.extensions import extension_names
from ...scenes.file import SceneFile
from ...scenes.load import read_toml, with_motor_table
from ...scenes.messages import check
from ...scenes.parameters import EACH, PLACES, index_of, place_of

MOST_POINTS = 1_000_000

LOOKED_AT = 16
"""Points at which it is seen whether keys have an effect."""

Range = create_model(
    "Range",
    __base__=Table,
    __doc__="Numbers from one to another, evenly spaced, or with scale = 'log' their logarithms.",
    **{  # "from" cannot be written as the name of a field
        "from": (Finite, ...),
        "to": (Finite, ...),
        "count": (Count, ...),
        "scale": (Literal["linear", "log"], "linear"),
    },  # pyright: ignore[reportArgumentType, reportCallIssue]
)


class SweepTable(Table):
    """What a sweep file holds.

    Attributes:
        scene: path of the scene file, relative to the sweep file.
        mode: "grid", every value with every other, or "together", the first values of all
            keys, then the second ones, and so on.
        trajectories: keep the trajectory of every point.
        vary: keys, and lists of values or tables as of `Range`.
    """

    scene: str
    mode: Literal["grid", "together"] = "grid"
    trajectories: Switch = False
    vary: dict[str, Any] = Field(min_length=1)


@dataclass(frozen=True)
class Sweep:
    """A sweep file, checked, with all that it refers to.

    Attributes:
        path: of the file.
        scene_path: of the scene file.
        scene: contents of the scene file.
        names: the varied keys as the file has them.
        keys: the same by table and name.
        points: for every point a value for each key.
        mode: as in `SweepTable`.
        trajectories: whether to keep them.
        usual: what parameters with a value for each flagellum are without being varied.
        count: number of flagella.
    """

    path: Path
    scene_path: Path
    scene: Mapping[str, Any]
    names: tuple[str, ...]
    keys: tuple[str, ...]
    points: tuple[tuple[Any, ...], ...]
    mode: str
    trajectories: bool
    usual: Mapping[str, Any]
    count: int

    def varied(self, number: int) -> dict[str, Any]:
        """The values of a point, by the names that the sweep file has for them."""
        return dict(zip(self.names, self.points[number], strict=True))

    def file(self, number: int) -> SceneFile:
        """The scene of a point, as if its values stood in the scene file.

        Raises:
            InputError: the values do not make a scene.
        """
        content = self.content(number)
        return with_motor_table(check(SceneFile, content, self.scene_path), self.scene_path)

    def content(self, number: int) -> dict[str, Any]:
        """The tables of the scene file of a point."""
        content = {k: dict(v) if isinstance(v, Mapping) else v for k, v in self.scene.items()}
        for key, value in zip(self.keys, self.points[number], strict=True):
            table, name = key.split(".")
            base, place = index_of(name)
            tables = content.setdefault(table, {})
            if place is None:
                tables[base] = value
            else:
                one = tables.get(base, self.usual[base])
                every = list(one) if isinstance(one, list | tuple) else [one] * self.count
                tables[base] = [*every[:place], value, *every[place + 1 :]]
        return content


def load_sweep(path: str | Path) -> Sweep:
    """Read and check a sweep file and its scene.

    Whether each point makes a scene is found when it is asked for. Warns with an `InputWarning` for
    keys that have no effect at any point that is looked at.

    Raises:
        InputError: one of the files is missing or wrong; the message names file and key.
    """
    path = Path(path)
    table = check(SweepTable, read_toml(path), path)
    scene_path = path.parent / table.scene
    try:
        content = read_toml(scene_path)
        scene = with_motor_table(check(SceneFile, content, scene_path), scene_path)
    except InputError as error:
        raise InputError(f"{path}: scene = {table.scene!r}: {error}") from None
    vary = _flat(table.vary)
    keys = tuple(_key(path, name, scene) for name in vary)
    if len(set(keys)) < len(keys):
        twice = next(k for k in keys if keys.count(k) > 1)
        raise InputError(f"{path}: [vary]: {twice} is given twice, by two names")
    values = {name: _values(path, name, given) for name, given in vary.items()}
    known = scene.parameters
    usual = {name: np.asarray(known[name]).tolist() for name in EACH if name in known}
    sweep = Sweep(
        path=path,
        scene_path=scene_path,
        scene=content,
        names=tuple(vary),
        keys=keys,
        points=tuple(_points(path, table.mode, values)),
        mode=table.mode,
        trajectories=table.trajectories,
        usual=usual,
        count=scene.robot.count,
    )
    for sentence in _idle(sweep):
        warnings.warn(sentence, InputWarning, stacklevel=2)
    return sweep


def _idle(sweep: Sweep) -> list[str]:
    """What to say about keys that have no effect at some points, or at all if there are few."""
    found: list[dict[str, str]] = []
    for number in range(0, len(sweep.points), -(-len(sweep.points) // LOOKED_AT)):
        with warnings.catch_warnings(), contextlib.suppress(InputError):
            warnings.simplefilter("ignore", InputWarning)
            found.append(idle_keys(sweep.file(number), sweep.content(number)))
    if not found:
        return []
    return [
        f"{sweep.path if name in sweep.keys else sweep.scene_path}: {sentence}"
        for name, sentence in found[0].items()
        if all(name in others for others in found)
    ]


def _flat(vary: Mapping[str, Any]) -> dict[str, Any]:
    """With `robot.pitch = [...]`, which is a table within a table, under the key "robot.pitch"."""
    flat = {}
    for name, given in vary.items():
        is_table = name in SceneFile.model_fields or name in extension_names()
        if is_table and isinstance(given, Mapping):
            flat |= {f"{name}.{key}": value for key, value in given.items()}
        else:
            flat[name] = given
    return flat


def _points(path: Path, mode: str, values: Mapping[str, list[Any]]) -> Iterator[tuple[Any, ...]]:
    lengths = {name: len(of_one) for name, of_one in values.items()}
    if mode == "grid":
        if (count := math.prod(lengths.values())) > MOST_POINTS:
            raise InputError(f"{path}: [vary]: {count} points are too many")
        return itertools.product(*values.values())
    if len(set(lengths.values())) > 1:
        given = ", ".join(f"{count} of {name}" for name, count in lengths.items())
        raise InputError(
            f"{path}: [vary]: with mode = 'together' all have equally many values, not {given}"
        )
    return zip(*values.values(), strict=True)


def _key(path: Path, name: str, scene: SceneFile) -> str:
    """Where a varied key stands in the scene file."""
    known = scene.parameters
    if index_of(name)[1] is not None:
        try:
            scene.check_names([name])
        except KeyError as error:
            raise InputError(f"{path}: [vary] {name}: {error.args[0]}") from None
        return ".".join(place_of(name)) + name.removeprefix(index_of(name)[0])
    if name in known:
        if name == "rpm" and scene.motor_table is not None:
            raise InputError(
                f"{path}: [vary] rpm: the scene has a motor table; vary 'motor.table' instead"
            )
        return ".".join(place_of(name))
    if name in PLACES:
        raise InputError(
            f"{path}: [vary] {name}: this scene has no such parameter; "
            f"if some points have it, vary {PLACES[name]!r}"
        )
    tables = {
        key: field.annotation for key, field in SceneFile.model_fields.items() if not field.exclude
    }
    dotted = [f"{table}.{key}" for table, kind in tables.items() for key in _fields(kind)]
    if name in dotted:
        return name
    close = difflib.get_close_matches(name, [*known, *dotted], n=1)
    tail = [key for key in dotted if key.split(".")[1] == name]
    guess = (tail or close or [None])[0]
    hint = f" Did you mean {guess!r}?" if guess else ""
    raise InputError(
        f"{path}: [vary] {name}: unknown key.{hint} Parameters of the scene: {', '.join(known)}; "
        "other keys by table and name, such as 'fluid.hydrodynamics'"
    )


def _fields(kind: Any) -> list[str]:
    """The keys of a table of the scene file."""
    kinds = [kind, *getattr(kind, "__args__", ())]
    models = [k for k in kinds if isinstance(k, type) and issubclass(k, BaseModel)]
    return [name for model in models for name in model.model_fields]


def _values(path: Path, name: str, given: Any) -> list[Any]:
    """The values of a varied key."""
    where = f"{path}: [vary] {name}"
    if isinstance(given, list):
        if not given:
            raise InputError(f"{where}: no values are given")
        return given
    if not isinstance(given, Mapping):
        raise InputError(f"{where} = {given}: should be a list, or a table {{ from, to, count }}")
    numbers = check(Range, dict(given), Path(where)).model_dump()
    low, high, count = numbers["from"], numbers["to"], numbers["count"]
    if count > MOST_POINTS:
        raise InputError(f"{where}: count = {count}: {count} points are too many")
    if numbers["scale"] == "linear":
        values = np.linspace(low, high, count)
        whole = all(isinstance(given[end], int) for end in ("from", "to"))
        return (values.astype(int) if whole and (values % 1 == 0).all() else values).tolist()
    if min(low, high) <= 0:
        raise InputError(f"{where}: scale = 'log': from and to must be more than 0")
    return np.geomspace(low, high, count).tolist()
