"""Scene files: TOML in SI units, checked key by key.

A scene file says what a robot is and how it is simulated. Every table may be left out; what
is not given has the value of the paper's table (Lim, Yadunandan & Jawed, Soft Matter 19,
2254, 2023), except for the regularization (see `Fluid`).
"""

import difflib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
import pandas as pd
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

T = TypeVar("T", bound=BaseModel)
Length = Annotated[float, Field(gt=0, le=10, description="m", allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class InputError(ValueError):
    """Something is wrong with what the user gave; the message names file, key or line."""


class Table(BaseModel):
    """A TOML table: immutable, and strict about its keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Robot(Table):
    """[robot] Shape of the robot, in metres."""

    kind: Literal["single_flagellum"] = "single_flagellum"
    helix_radius: Length = 6.4e-3
    pitch: Length = 44.5e-3
    axial_length: Length = 95.4e-3
    rod_radius: Length = 1.6e-3
    edge_length: Length = 5.0e-3
    head_radius: Length = 31.0e-3
    handedness: Literal["left", "right"] = "left"

    @model_validator(mode="after")
    def _slender(self) -> Self:
        if self.rod_radius >= 0.5 * self.pitch:
            raise ValueError("rod_radius: the turns of the helix overlap: it must be < pitch / 2")
        if self.edge_length > 0.34 * self.axial_length:
            raise ValueError("edge_length: at least three edges must fit into axial_length")
        return self


class Material(Table):
    """[material] The flagellum: Young's modulus in Pa, density in kg/m^3."""

    youngs_modulus: Positive = 1.255e6
    poisson_ratio: Annotated[float, Field(gt=-1, le=0.5)] = 0.5
    density: Positive = 1260.0


class Fluid(Table):
    """[fluid] Viscosity in Pa s, density in kg/m^3, and the drag on the flagella.

    The regularization (m) is by default 1.04 rod radii: the paper's table prints a tenth of
    that, which contradicts the buckling thresholds of the same paper.
    """

    viscosity: Positive = 1.0
    fluid_density: NonNegative = 1260.0
    hydrodynamics: Literal["rss", "rft", "none"] = "rss"
    resistive: Literal["gray_hancock", "lighthill"] = "gray_hancock"
    regularization: Length = 1.67e-3
    end_nodes: Literal["half", "full"] = "half"
    drag_matrix: Literal["symmetric", "collocation", "lower_triangle"] = "symmetric"
    head_nodes: Literal["excluded", "dropped"] | None = None

    @property
    def head_nodes_resolved(self) -> Literal["excluded", "dropped"]:
        """Whether head nodes stay out of the flow problem, or only the forces on them do.

        Published codes solve with them and drop the forces; the comparison options do so too.
        """
        if self.head_nodes is not None:
            return self.head_nodes
        return "excluded" if self.drag_matrix == "symmetric" else "dropped"


class Head(Table):
    """[head] Drag prefactors (dimensionless) and mass (kg; default: a ball of the material)."""

    drag: Literal["stokes", "none"] = "stokes"
    C_t: NonNegative = 4.8
    C_r: NonNegative = 0.36
    rotation: Literal["spin", "full"] = "spin"
    mass: Positive | None = None


class Motor(Table):
    """[motor] A constant rate, or the path of a table with columns `time` (s) and `rpm`."""

    rpm: Finite = 60.0
    table: str | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if {"rpm", "table"} <= self.model_fields_set:
            raise ValueError("rpm: give either rpm or table, not both")
        if abs(self.rpm) > 1e5:
            raise ValueError(f"rpm: {self.rpm:g} revolutions per minute is beyond any motor")
        return self


class Time(Table):
    """[time] Step, end and interval of saved frames (s), and the scheme."""

    step: Positive = 0.01
    end: Positive = 20.0
    frame: Positive | None = None
    scheme: Literal["implicit", "explicit"] = "implicit"
    inertia: bool = False

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.step > self.end:
            raise ValueError("step: must not be longer than end")
        if not np.isclose(self.end / self.step, round(self.end / self.step), atol=1e-6):
            raise ValueError("end: must be a whole number of steps")
        if self.frame is not None:
            ratio = self.frame / self.step
            if round(ratio) < 1 or not np.isclose(ratio, round(ratio), atol=1e-6):
                raise ValueError("frame: must be a whole number of steps")
            if self.n_steps % self.steps_per_frame:
                raise ValueError("frame: end must be a whole number of frames")
        return self

    @property
    def n_steps(self) -> int:
        """Steps of the run."""
        return round(self.end / self.step)

    @property
    def steps_per_frame(self) -> int:
        """Steps from one saved frame to the next; without `frame`, about 0.1 s of them."""
        if self.frame is not None:
            return round(self.frame / self.step)
        most = max(1, round(0.1 / self.step))
        return max(k for k in range(1, most + 1) if self.n_steps % k == 0)

    @property
    def n_frames(self) -> int:
        """Saved frames, not counting the start."""
        return self.n_steps // self.steps_per_frame


class Gravity(Table):
    """[gravity] Acceleration (m/s^2); a scene without this table has no gravity."""

    acceleration: tuple[Finite, Finite, Finite] = (0.0, 0.0, -9.81)


class Solver(Table):
    """[solver] Newton's method: largest scaled residual, and number of iterations."""

    tolerance: Annotated[float, Field(gt=0, lt=1)] = 1e-9
    max_iterations: Annotated[int, Field(ge=1)] = 40


class MotorTable(Table):
    """A motor's rate over time: s and revolutions per minute, linear in between."""

    time: tuple[Finite, ...]
    rpm: tuple[Finite, ...]


class SceneFile(Table):
    """A whole scene. Hashable; its numbers are also available as `parameters`."""

    robot: Robot = Robot()
    material: Material = Material()
    fluid: Fluid = Fluid()
    head: Head = Head()
    motor: Motor = Motor()
    time: Time = Time()
    gravity: Gravity | None = None
    solver: Solver = Solver()
    motor_table: MotorTable | None = Field(default=None, exclude=True)

    @property
    def parameters(self) -> dict[str, Any]:
        """The numbers that a scene can be differentiated with respect to, by their keys.

        SI units, and `rpm` in revolutions per minute. With a motor table `rpm` is an array.
        """
        robot, material, fluid, head = self.robot, self.material, self.fluid, self.head
        return {
            "helix_radius": robot.helix_radius,
            "pitch": robot.pitch,
            "axial_length": robot.axial_length,
            "rod_radius": robot.rod_radius,
            "head_radius": robot.head_radius,
            "youngs_modulus": material.youngs_modulus,
            "poisson_ratio": material.poisson_ratio,
            "density": material.density,
            "viscosity": fluid.viscosity,
            "fluid_density": fluid.fluid_density,
            "regularization": fluid.regularization,
            "C_t": head.C_t,
            "C_r": head.C_r,
            "rpm": self.motor.rpm if self.motor_table is None else np.array(self.motor_table.rpm),
        }


def load_scene(path: str | Path) -> SceneFile:
    """Read and check a scene file.

    Raises:
        InputError: the file is missing, is not TOML, or has an unknown key or a value that
            cannot be; the message names file and key.
    """
    path = Path(path)
    scene = check(SceneFile, read_toml(path), path)
    if scene.motor.table is not None:
        table = read_motor_table(path.parent / scene.motor.table, scene.time.end)
        scene = scene.model_copy(update={"motor_table": table})
    return scene


def read_toml(path: Path) -> dict[str, Any]:
    """The contents of a TOML file; `InputError` if there is none."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None


def check(model: type[T], content: dict[str, Any], path: Path) -> T:
    """`content` as a `model`; `InputError` naming `path` and the keys at fault."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        problems = [_describe(model, problem) for problem in error.errors()]
        raise InputError("\n".join(f"{path}: {problem}" for problem in problems)) from None


def _describe(model: type[BaseModel], problem: Any) -> str:
    """One problem that pydantic found, as a sentence with the key in TOML's notation."""
    *tables, key = problem["loc"] or ("",)
    where = "".join(f"[{t}] " if isinstance(t, str) else f"(entry {t + 1}) " for t in tables)
    if problem["type"] == "extra_forbidden":
        known = _known_keys(model, tables)
        close = difflib.get_close_matches(str(key), known, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        return f"{where}{key}: unknown key.{hint} Known keys: {', '.join(known)}"
    if problem["type"] == "value_error":
        table = f"[{key}] " if key else ""
        return f"{where}{table}{problem['ctx']['error']}"
    units = " (lengths are in metres)" if problem["type"] == "less_than_equal" else ""
    message = problem["msg"][0].lower() + problem["msg"][1:]
    return f"{where}{key}: {message}, got {problem['input']!r}{units}"


def _known_keys(model: type[BaseModel], tables: list[Any]) -> list[str]:
    for table in tables:
        if not isinstance(table, str):
            continue
        annotation = model.model_fields[table].annotation
        inner = [annotation, *getattr(annotation, "__args__", ())]
        model = next(a for a in inner if isinstance(a, type) and issubclass(a, BaseModel))
    return [name for name, field in model.model_fields.items() if not field.exclude]


def read_motor_table(path: Path, end: float) -> MotorTable:
    """A CSV file with columns `time` (s) and `rpm`, which must cover the run up to `end`."""
    try:
        frame = pd.read_csv(path, comment="#", skipinitialspace=True)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file ([motor] table)") from None
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: not a CSV table: {error}") from None
    if missing := {"time", "rpm"} - set(frame.columns):
        raise InputError(f"{path}: no column {' or '.join(sorted(missing))}; needs time, rpm")
    frame = frame[["time", "rpm"]].apply(pd.to_numeric, errors="coerce")
    if bad := frame.index[frame.isna().any(axis=1)].tolist():
        raise InputError(f"{path}: row {bad[0] + 1}: not a number")
    time = frame["time"].to_numpy()
    if len(time) == 0:
        raise InputError(f"{path}: the table is empty")
    if (np.diff(time) <= 0).any():
        row = int(np.argmax(np.diff(time) <= 0)) + 2
        raise InputError(f"{path}: row {row}: times must increase")
    if time[0] > 0 or time[-1] < end * (1 - 1e-9):
        raise InputError(
            f"{path}: the motor table covers {time[0]:g} to {time[-1]:g} s, "
            f"but the run lasts from 0 to {end:g} s"
        )
    return MotorTable(time=tuple(time.tolist()), rpm=tuple(frame["rpm"].tolist()))
