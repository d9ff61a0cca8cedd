"""Design files: TOML that names a scene and says what may change, and what is to be good.

scene = "scene.toml"            # relative to this file

[vary]
pitch = { low = 0.02, high = 0.08 }

[objective]
maximise = "speed"

[constraints]
torque = { max = 2e-4 }
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from derjax import InputError, InputWarning, SceneFile, build, load_scene
from derjax.io.fields import Count, Finite, NonNegative, Positive, Switch, Table
from derjax.scenes.load import read_toml
from derjax.scenes.messages import check
from derjax.scenes.motortable import RateTable

from .evaluate import Through
from .outcome import Bounds, Objective, problem_of
from .problem import Problem
from .quantities import from_file
from .search import Method, Search
from .uncertain import Uncertain, from_fit, together

Entries = Annotated[int, Field(strict=True, ge=2)]


class Range(Table):
    """Between which bounds a parameter may change, in the scene's units.

    `entries` is for `rpm`: that many rates at equal times, linear in between, in place of a
    constant one.
    """

    low: Finite
    high: Finite
    entries: Entries | None = None


class ObjectiveTable(Table):
    """[objective] What is to be good: a quantity by name, or "FILE.py:FUNCTION".

    `at` is the torque (N m) or the power (W) that the motor has whatever the design.
    """

    maximise: str | None = None
    minimise: str | None = None
    direction: Annotated[tuple[Finite, ...], Field(min_length=3, max_length=3)] | None = None
    at: dict[Literal["torque", "power"], Positive] = Field(default_factory=dict, max_length=1)


class Kept(Table):
    """The smallest and the largest that a quantity may be, in its SI unit."""

    min: Finite | None = None
    max: Finite | None = None


class SearchTable(Table):
    """[search] How the best design is looked for."""

    method: Method = "slsqp"
    starts: Count = 4
    iterations: Count = 60
    tolerance: Positive = 1e-8
    seed: Annotated[int, Field(strict=True, ge=0)] = 0


class UncertainTable(Table):
    """[uncertain] Parameters that are known with an uncertainty.

    Those that `fit`, a fit.json, has found, and others with a standard deviation, `std`, about the
    value that they have in the scene. The objective is its mean over them, or a quantile.
    """

    fit: str | None = None
    std: dict[str, Positive] = Field(default_factory=dict)
    quantile: Annotated[Finite, Field(gt=0, lt=1)] | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if self.fit is None and not self.std:
            raise ValueError("fit: must be given, or std")
        return self


class OutputTable(Table):
    """[output] What is drawn: points of the landscape along each variable, and a film."""

    landscape: Annotated[int, Field(strict=True, ge=0, le=101)] | None = None
    film: Switch = True


class DesignTable(Table):
    """What a design file holds."""

    scene: str
    through: Through | None = None
    begin: NonNegative = 0.0
    vary: Annotated[dict[str, Range], Field(min_length=1)]
    objective: ObjectiveTable
    constraints: dict[str, Kept] = Field(default_factory=dict)
    search: SearchTable = SearchTable()
    uncertain: UncertainTable | None = None
    output: OutputTable = OutputTable()


@dataclass(frozen=True)
class DesignFile:
    """A design file, read.

    Attributes:
        path: of the file.
        problem: that it states.
        search: how to solve it.
        landscape: points along each variable.
        film: whether there is to be one.
        content: all that the outcome depends on, as JSON data.
    """

    path: Path
    problem: Problem
    search: Search
    landscape: int
    film: bool
    content: dict


LANDSCAPE, RUN_LANDSCAPE = 21, 0
"""Points along each variable unless the file says how many: runs take long."""


def load_design(path: str | Path) -> DesignFile:
    """Read and check a design file, with its scene.

    Raises:
        InputError: something is wrong with one of them; the message names file and key.
    """
    path = Path(path)
    table = check(DesignTable, read_toml(path), path)
    scene_path = path.parent / table.scene
    try:
        file = load_scene(scene_path)
    except InputError as error:
        raise InputError(f"{path}: scene = {table.scene!r}: {error}") from None
    try:
        return _understood(path, table, _with_programme(file, table.vary))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _understood(path: Path, table: DesignTable, file: SceneFile) -> DesignFile:
    through = table.through or ("steady" if file.robot.count == 1 and _constant(file) else "run")
    if table.begin and through != "run":
        warnings.warn(f"{path}: begin is for through = 'run': no effect", InputWarning, 2)
    folder = path.parent
    uncertain, fitted = _uncertain(table.uncertain, file, folder)
    scene = build(file, fitted)

    def quantity(text: str) -> Objective:
        return from_file(text, folder) if ":" in text else text

    objective = table.objective
    limits: list[tuple[Objective, Bounds]] = [
        (quantity(name), (kept.min, kept.max)) for name, kept in table.constraints.items()
    ]
    problem = problem_of(
        scene,
        {name: (bounds.low, bounds.high) for name, bounds in table.vary.items()},
        quantity(objective.maximise) if objective.maximise else None,
        quantity(objective.minimise) if objective.minimise else None,
        limits,
        through,
        table.begin,
        objective.direction,  # pyright: ignore[reportArgumentType]  (three numbers)
        next(iter(objective.at.items()), None),
        uncertain,
    )
    search = table.search
    usual = RUN_LANDSCAPE if through == "run" else LANDSCAPE
    content = {
        "scene": file.model_dump(mode="json"),
        "design": table.model_dump(mode="json", exclude={"output"}),
        "uncertain": None if uncertain is None else uncertain.covariance.tolist(),
        "means": {name: np.asarray(value).tolist() for name, value in scene.parameters.items()},
    }
    return DesignFile(
        path,
        problem,
        Search(search.method, search.starts, search.iterations, search.tolerance, search.seed),
        usual if table.output.landscape is None else table.output.landscape,
        table.output.film,
        content,
    )


def _constant(file: SceneFile) -> bool:
    return file.motor_table is None


def _with_programme(file: SceneFile, vary: Mapping[str, Range]) -> SceneFile:
    """With a table of rates of the motor, if these are to change in time."""
    for name, bounds in vary.items():
        if bounds.entries is None:
            continue
        if name != "rpm":
            raise InputError(f"[vary] {name}: entries is for rpm, which may change in time")
        if file.motor_table is not None:
            raise InputError("[vary] rpm: entries has no effect on a scene with a motor table")
        table = RateTable(
            time=tuple(np.linspace(0.0, file.time.end, bounds.entries).tolist()),
            rpm=(file.motor.rpm,) * bounds.entries,
        )
        return file.model_copy(update={"motor_table": table})
    return file


def _uncertain(
    table: UncertainTable | None, file: SceneFile, folder: Path
) -> tuple[Uncertain | None, dict[str, float]]:
    """Parameters that are uncertain, and the values that a fit has found."""
    if table is None:
        return None, {}
    fitted = None if table.fit is None else from_fit(folder / table.fit)
    values = {} if fitted is None else fitted[0]
    known = file.single_numbers
    for name in (*values, *table.std):
        if name not in known:
            raise InputError(f"[uncertain] {name}: the scene has no such parameter")
    given = {name: (known[name], std) for name, std in table.std.items()}
    return together(fitted, given, table.quantile), dict(values)
