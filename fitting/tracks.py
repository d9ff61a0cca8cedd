"""Tracked motions: a TOML file that names the tracks, and the tracks as CSV tables.

scene = "scene.toml"            # relative to this file

[[runs]]
track = "run1.csv"
motor_rpm = 70
columns = { t = "time", x = "x_mm", y = "y_mm", head_angle = "angle" }
length_unit = "mm"
"""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

from derjax import SceneFile, build, load_scene, positions
from derjax.scenefile import Finite, InputError, NonNegative, Positive, Table, check, read_toml

from .observe import ANGLE, CHANNELS

LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "min": 60.0}
ANGLE_UNITS = {"rad": 1.0, "deg": np.pi / 180.0}
MIN_FRAMES = 10

TYPICAL = 0.02
"""How far robots swim, as a part of the way of a screw with their pitch."""


class Columns(Table):
    """The names that the channels have in the header of the track; those that it has."""

    t: str
    x: str | None = None
    y: str | None = None
    z: str | None = None
    head_angle: str | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.tracked:
            raise ValueError("besides t give at least one of x, y, z, head_angle")
        return self

    @property
    def tracked(self) -> dict[str, str]:
        """Column name of every channel that was tracked."""
        named = {channel: getattr(self, channel) for channel in CHANNELS}
        return {channel: name for channel, name in named.items() if name is not None}


class RunFile(Table):
    """[[runs]] One track and how to read it.

    `t_start` and `t_end` (in `time_unit`) select frames. `time_offset` (in `time_unit`) is
    added to the times of the track: in the simulation the motor starts at time 0, which for a
    camera switched on 3 s later is 3 s before its first frame. `sigma` is the noise of positions
    in `length_unit`, `sigma_angle` that of the angle in `angle_unit`; left out, the noise is
    estimated. `origin` says what positions are relative to: with "scene" they are those of
    the scene, with "track" only displacements are compared.
    """

    track: str
    motor_rpm: Finite | None = None
    columns: Columns
    length_unit: Literal["m", "cm", "mm", "um"] = "m"
    time_unit: Literal["s", "ms", "min"] = "s"
    angle_unit: Literal["rad", "deg"] = "rad"
    sigma: Positive | None = None
    sigma_angle: Positive | None = None
    t_start: NonNegative = 0.0
    t_end: Positive | None = None
    time_offset: Finite = 0.0
    origin: Literal["scene", "track"] = "scene"


class DatasetFile(Table):
    """A whole dataset file."""

    scene: str
    runs: Annotated[tuple[RunFile, ...], Field(min_length=1)]


@dataclass(frozen=True)
class Run:
    """One tracked motion, in SI units.

    Attributes:
        name: of the track.
        time: (f,) s since the motor started, increasing.
        channels: which of `CHANNELS` were tracked, as c indices.
        values: (f, c) m and rad.
        motor_rpm: revolutions per minute; None: the motor of the scene.
        sigma: m, noise of positions; None: to be estimated.
        sigma_angle: rad, noise of the head angle; None: to be estimated.
        free_origin: whether only displacements count, not positions.
    """

    name: str
    time: Float[np.ndarray, " f"]
    channels: tuple[int, ...]
    values: Float[np.ndarray, "f c"]
    motor_rpm: float | None = None
    sigma: float | None = None
    sigma_angle: float | None = None
    free_origin: bool = False

    @property
    def is_angle(self) -> np.ndarray:
        """(c,): which of the tracked channels is the head angle."""
        return np.array(self.channels) == ANGLE


@dataclass(frozen=True)
class Dataset:
    """Tracks, and the scene that they were filmed in.

    Attributes:
        scene: the robot, with the parameters to start from.
        runs: at least one.
        path: of the dataset file, for reports.
    """

    scene: SceneFile
    runs: tuple[Run, ...]
    path: Path | None = None


def load_dataset(path: str | Path) -> Dataset:
    """Read and check a dataset file, its scene and its tracks.

    Raises:
        InputError: a file is missing or malformed, or a track cannot be what the file says
            it is; the message names file and key, or column and line.
    """
    path = Path(path)
    file = check(DatasetFile, read_toml(path), path)
    scene = load_scene(path.parent / file.scene)
    if scene.motor_table is not None and any(run.motor_rpm is not None for run in file.runs):
        raise InputError(
            f"{path}: the scene's motor follows a table; leave motor_rpm out, "
            "or give the scene a constant rate"
        )
    runs = tuple(_read_run(path.parent / run.track, run) for run in file.runs)
    for run, described in zip(runs, file.runs, strict=True):
        check_plausible(path.parent / described.track, run, scene, described)
    return Dataset(scene, runs, path)


def _read_run(path: Path, run: RunFile) -> Run:
    tracked = run.columns.tracked
    table, lines = read_columns(path, [run.columns.t, *tracked.values()])
    time = (table[:, 0] + run.time_offset) * TIME_UNITS[run.time_unit]
    late = np.flatnonzero(np.diff(time) <= 0)
    if late.size:
        i = late[0]
        kind = "repeated" if time[i + 1] == time[i] else "earlier than the one before"
        raise InputError(
            f"{path}: line {lines[i + 1]}, column {run.columns.t!r}: "
            f"time {table[i + 1, 0]:g} is {kind}; times must increase"
        )
    start = (run.t_start + run.time_offset) * TIME_UNITS[run.time_unit]
    end = np.inf if run.t_end is None else (run.t_end + run.time_offset) * TIME_UNITS[run.time_unit]
    slack = 1e-9 * max(abs(time[-1]), abs(time[0]))
    chosen = (time >= start - slack) & (time <= end + slack)
    if run.t_start == 0.0 and run.t_end is None:
        chosen[:] = True
    if chosen.any() and time[chosen][0] < 0:
        i = int(np.argmax(chosen))
        raise InputError(
            f"{path}: line {lines[i]}, column {run.columns.t!r}: the frame is from "
            f"{-time[i]:g} s before the motor starts; set t_start or time_offset"
        )
    if (n := int(chosen.sum())) < MIN_FRAMES:
        raise InputError(
            f"{path}: {n} frames"
            + ("" if n == len(time) else f" of {len(time)} lie between t_start and t_end")
            + f"; at least {MIN_FRAMES} are needed"
        )
    is_angle = np.array([channel == "head_angle" for channel in tracked])
    unit = np.where(is_angle, ANGLE_UNITS[run.angle_unit], LENGTH_UNITS[run.length_unit])
    values = table[chosen, 1:] * unit
    if is_angle.any():
        _check_unwrapped(path, values[:, is_angle][:, 0], np.array(lines)[chosen])
    sigma_angle = None
    if run.sigma_angle is not None:
        sigma_angle = run.sigma_angle * ANGLE_UNITS[run.angle_unit]
    return Run(
        name=Path(run.track).stem,
        time=time[chosen],
        channels=tuple(CHANNELS.index(channel) for channel in tracked),
        values=values,
        motor_rpm=run.motor_rpm,
        sigma=None if run.sigma is None else run.sigma * LENGTH_UNITS[run.length_unit],
        sigma_angle=sigma_angle,
        free_origin=run.origin == "track",
    )


def read_columns(path: Path, names: list[str]) -> tuple[Float[np.ndarray, "f c"], list[int]]:
    """The named columns of a CSV file with a header, and the line that each row is from.

    Blank lines and lines that begin with # are skipped.

    Raises:
        InputError: the file is missing or has no such column, or a field is not a number.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file (named as a track by the dataset)") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    numbered = [
        (i, line)
        for i, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    lines = [i for i, _ in numbered]
    rows = list(csv.reader((line for _, line in numbered), skipinitialspace=True))
    if not rows:
        raise InputError(f"{path}: the file is empty")
    header = [field.strip() for field in rows[0]]
    for name in names:
        if name not in header:
            raise InputError(f"{path}: no column {name!r}; the columns are {', '.join(header)}")
        if header.count(name) > 1:
            raise InputError(f"{path}: line {lines[0]}: two columns have the name {name!r}")
    places = [header.index(name) for name in names]
    table = np.empty((len(rows) - 1, len(names)))
    for k, row in enumerate(rows[1:]):
        if len(row) != len(header) and any(row[len(header) :] or [True]):
            raise InputError(
                f"{path}: line {lines[k + 1]}: {len(row)} fields, but the header has {len(header)}"
            )
        for j, place in enumerate(places):
            field = row[place].strip()
            try:
                table[k, j] = float(field)
            except ValueError:
                table[k, j] = np.nan
            if not np.isfinite(table[k, j]):
                shown = repr(field) if field else "an empty field"
                raise InputError(
                    f"{path}: line {lines[k + 1]} (row {k + 1}), column {names[j]!r}: "
                    f"not a finite number: {shown}; leave out frames that were not tracked"
                )
    return table, lines[1:]


def _check_unwrapped(path: Path, angle: Float[np.ndarray, " f"], lines: np.ndarray) -> None:
    """Angles given within one turn jump where they leave it; a simulation's do not."""
    jumps = np.abs(np.diff(angle))
    if np.ptp(angle) <= 2 * np.pi * (1 + 1e-9) and jumps.max() > np.pi:
        line = lines[int(np.argmax(jumps)) + 1]
        raise InputError(
            f"{path}: line {line}: the head angle jumps by {jumps.max():.3g} rad: it seems to "
            "be given within one turn; add whole turns so that it is continuous"
        )


def check_plausible(path: Path, run: Run, scene: SceneFile, described: RunFile) -> None:
    """Refuse positions in `path` that this robot cannot have reached: they are in another unit.

    No swimmer driven by a helix goes further in a turn of its motor than the pitch, as a
    screw in wood would; robots in fluid stay at a few per cent of that.

    Raises:
        InputError: with the unit that would make sense, if one does.
    """
    position = run.values[:, ~run.is_angle]
    if not position.shape[1]:
        return
    robot = scene.robot
    rpm = scene.parameters["rpm"] if run.motor_rpm is None else run.motor_rpm
    size = robot.axial_length + 4 * robot.edge_length
    screw = robot.pitch * np.abs(rpm).max() / 60  # m/s
    duration = run.time[-1] - run.time[0]
    moved = np.linalg.norm(position - position[0], axis=1).max()
    names = ", ".join(
        name for channel, name in described.columns.tracked.items() if channel in "xyz"
    )
    if moved > size + screw * duration:
        length_unit = described.length_unit
        would = {unit: moved * m / LENGTH_UNITS[length_unit] for unit, m in LENGTH_UNITS.items()}
        typical = TYPICAL * (screw * duration or size)
        likely = min(would, key=lambda unit: abs(np.log(would[unit] / typical)))
        hint = "" if likely == length_unit else f"; did you mean length_unit = '{likely}'?"
        raise InputError(
            f"{path}: columns {names}: in {duration:.4g} s the head moves by {moved:.4g} m "
            f"(length_unit = '{length_unit}'), but a robot {size:.2g} m long with this motor "
            f"can go no further than {size + screw * duration:.2g} m{hint}"
        )
    if run.free_origin:
        return
    start = _start_position(scene)[[c for c in run.channels if c != ANGLE]]
    distance = float(np.linalg.norm(position[0] - start))
    if distance > 0.5 * size + screw * run.time[0]:
        raise InputError(
            f"{path}: columns {names}: the first frame is {distance:.3g} m away from where "
            "the head of the scene starts; set origin = 'track' to compare displacements only"
        )


def _start_position(scene: SceneFile) -> np.ndarray:
    """(3,): the head node (m) of the scene at rest."""
    built, state = build(scene)
    topology = built.rod.topology
    if topology.head is None:
        raise InputError("the scene's robot has no head to track")
    return np.asarray(positions(topology, state.q))[topology.head.node]
