"""Tracked motions, and the scene that they were filmed in."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from derjax import SceneFile, build
from derjax.core.errors import InputError
from derjax.io.fields import TIME_UNITS
from derjax.scenes.load import read_toml
from derjax.scenes.messages import check
from derjax.scenes.motortable import covers
from derjax.scenes.timing import time_grid

from .clock import ROUNDING
from .datasetfile import ANGLE_UNITS, LENGTH_UNITS, DatasetFile, RunFile
from .direction import check_direction
from .joint.file import KnownPrior, NoiseFile, Nuisances, Prior, Shared
from .joint.rates import Rates, load_rates
from .observe import ANGLE, seen
from .reading import Track, read_track
from .scenes import scene_with_rates

TYPICAL = 0.02
"""How far robots swim, as a part of the way of a screw with their pitch."""


@dataclass(frozen=True)
class Run:
    """One tracked motion, in SI units.

    Attributes:
        name: of the track.
        time: (f,) s since the motor started, increasing.
        channels: which of `CHANNELS` were tracked, as c indices.
        values: (f, c) m and rad.
        motor_rpm: revolutions per minute, of all motors or of each; None: the motor of the scene.
        sigma: m, noise of positions; None: to be estimated.
        sigma_angle: rad, noise of the head angle; None: to be estimated.
        free_origin: whether only displacements count, not positions.
        drift: whether the robot also drifts with a steady velocity, which is fitted.
        free_angle: whether only changes of the head angle count.
        dropped: frames that are left out as something in them was not tracked.
        said: what was decided when the track was read, as sentences.
        sight: the axis along which the camera looks, if the track is of the robot's silhouette;
            None if it is of the head.
        steady: whether the robot swims steadily from the first frame on.
        scene: the robot; None: that of the dataset.
        own: parameters of which this run has a value of its own.
        nuisances: what else is estimated, in SI units.
        exposure: s, for how long the shutter is open in each frame, half of it before its time.
    """

    name: str
    time: Float[np.ndarray, " f"]
    channels: tuple[int, ...]
    values: Float[np.ndarray, "f c"]
    motor_rpm: float | tuple[float, ...] | None = None
    sigma: float | None = None
    sigma_angle: float | None = None
    free_origin: bool = False
    drift: bool = False
    free_angle: bool = False
    dropped: int = 0
    said: tuple[str, ...] = ()
    sight: int | None = None
    steady: bool = False
    scene: SceneFile | None = None
    own: tuple[str, ...] = ()
    nuisances: Nuisances = field(default_factory=Nuisances)
    exposure: float = 0.0

    @property
    def is_angle(self) -> np.ndarray:
        """(c,): which of the tracked channels is the head angle."""
        return np.array(self.channels) == ANGLE


@dataclass(frozen=True)
class Dataset:
    """Tracks, and the scene that they were filmed in.

    Attributes:
        scene: the robot, with the parameters to start from.
        runs: tracks.
        path: of the dataset file, for reports.
        rates: speeds of robots that swim steadily.
        priors: of what is fitted.
        noise: what residuals are like.
        shared: what else is estimated, the same for all.
    """

    scene: SceneFile
    runs: tuple[Run, ...]
    path: Path | None = None
    rates: tuple[Rates, ...] = ()
    priors: Mapping[str, KnownPrior] = field(default_factory=dict)
    noise: NoiseFile = field(default_factory=NoiseFile)
    shared: Shared = field(default_factory=Shared)

    @property
    def is_plain(self) -> bool:
        """Whether all are tracks from rest, of one robot, with independent Gaussian noise."""
        plain = all(
            not (run.steady or run.scene or run.own or run.nuisances.given) for run in self.runs
        )
        nothing = not (self.rates or self.priors or self.shared.viscosity)
        return plain and nothing and self.noise == NoiseFile()

    @property
    def sight(self) -> int | None:
        """Along which axis all runs with positions see silhouettes; None if they see heads."""
        return next((run.sight for run in self.runs if not run.is_angle.all()), None)


def load_dataset(path: str | Path) -> Dataset:
    """Read and check a dataset file, its scene and its tracks.

    Raises:
        InputError: a file is missing or malformed, or a track cannot be what the file says
            it is; the message names file and key, or column and line.
    """
    path = Path(path)
    file = check(DatasetFile, read_toml(path), path)
    scene = scene_with_rates(path.parent / file.scene)
    if scene.motor_table is not None and any(run.motor_rpm is not None for run in file.runs):
        raise InputError(
            f"{path}: the scene's motor follows a table; leave motor_rpm out, "
            "or give the scene a constant rate"
        )
    for described in file.runs:
        _check_rates(path, described, scene)
    tracks = [read_track(path.parent / run.track, run) for run in file.runs]
    scenes = [_scene_of(path, run.scene, scene) for run in file.runs]
    runs = tuple(_run(track, own) for track, own in zip(tracks, scenes, strict=True))
    for run, one in zip(runs, tracks, strict=True):
        described = one.keys
        track = path.parent / described.track
        own = run.scene or scene
        _check_exposure(track, run, described)
        _check_covered(track, run, own, described)
        check_plausible(track, run, own, described)
        check_direction(track, own, described, run.time, run.values, run.channels)
    _check_alike(path, runs)
    return Dataset(
        _in_steps_for(runs, scene),
        runs,
        path,
        load_rates(path, file.rates, scene),
        file.priors,
        file.noise,
        file.nuisances,
    )


def _scene_of(path: Path, name: str | None, scene: SceneFile) -> SceneFile | None:
    """The scene that a run names; None if it names none, or that of the dataset."""
    if name is None:
        return None
    other = scene_with_rates(path.parent / name)
    return None if other == scene else other


def _in_steps_for(runs: tuple[Run, ...], scene: SceneFile) -> SceneFile:
    """The scene with steps that suit the fastest motor of all runs, unless it has its own."""
    if scene.time.step is not None or scene.time.frame is not None:
        return scene
    rates = [scene.fastest_rpm if run.motor_rpm is None else run.motor_rpm for run in runs]
    if not rates:
        return scene
    fastest = max(float(np.abs(rate).max()) for rate in rates)
    step = time_grid(scene.time.end, None, None, fastest).step
    return scene.model_copy(update={"time": scene.time.model_copy(update={"step": step})})


def _run(track: Track, scene: SceneFile | None) -> Run:
    run = track.keys
    rpm = run.motor_rpm
    exposure = run.exposure * TIME_UNITS[run.time_unit]
    return Run(
        name=Path(run.track).stem,
        time=track.time + 0.5 * exposure,
        channels=track.channels,
        values=track.values,
        motor_rpm=rpm[0] if isinstance(rpm, tuple) and len(rpm) == 1 else rpm,
        sigma=None if run.sigma is None else run.sigma * LENGTH_UNITS[run.length_unit],
        sigma_angle=(
            None if run.sigma_angle is None else run.sigma_angle * ANGLE_UNITS[run.angle_unit]
        ),
        free_origin=run.origin == "track" or run.start == "steady",
        drift=run.drift,
        dropped=track.dropped,
        said=track.said,
        sight=track.sight,
        steady=run.start == "steady",
        scene=scene,
        own=run.own,
        nuisances=_in_si(run),
        exposure=exposure,
    )


def _in_si(run: RunFile) -> Nuisances:
    """What else is estimated, in m, s and rad."""
    length, time = LENGTH_UNITS[run.length_unit], TIME_UNITS[run.time_unit]
    units = {
        "origin": length,
        "drift": length / time,
        "time_offset": time,
        "angle_origin": ANGLE_UNITS[run.angle_unit],
    }
    return run.nuisances.model_copy(
        update={
            name: Prior(
                mean=None if prior.mean is None else units[name] * prior.mean,
                std=None if prior.std is None else units[name] * prior.std,
            )
            for name, prior in run.nuisances.given.items()
            if name in units
        }
    )


def _check_alike(path: Path, runs: tuple[Run, ...]) -> None:
    """`InputError` if some tracks are of heads and others of silhouettes, or from another side."""
    sights = {run.sight: run.name for run in runs if not run.is_angle.all()}
    if len(sights) > 1:
        raise InputError(
            f"{path}: tracks {', '.join(map(repr, sights.values()))} differ in point, or in the "
            'side from which the camera sees the silhouette (point = "silhouette"); fit them apart'
        )


def _check_rates(path: Path, run: RunFile, scene: SceneFile) -> None:
    """`InputError` if a run has rates for more or fewer motors than there are."""
    count = scene.robot.count
    if isinstance(run.motor_rpm, tuple) and len(run.motor_rpm) not in (1, count):
        raise InputError(
            f"{path}: [runs] {run.track}: motor_rpm has {len(run.motor_rpm)} rates, "
            f"but the robot has {count} motors"
        )


def _check_exposure(path: Path, run: Run, described: RunFile) -> None:
    """`InputError` if the shutter of the camera is open for longer than a frame."""
    shortest = float(np.diff(run.time).min(initial=np.inf))
    if run.exposure > shortest * (1.0 + ROUNDING):
        raise InputError(
            f"{path}: exposure = {described.exposure:g} {described.time_unit} is longer than the "
            f"{shortest / TIME_UNITS[described.time_unit]:.3g} {described.time_unit} from one "
            "frame to the next; it is in time_unit, also where the rate of frames is given by fps"
        )


def _check_covered(path: Path, run: Run, scene: SceneFile, described: RunFile) -> None:
    """`InputError` if the table of the motor ends before the track."""
    if scene.motor_table is None:
        return
    table, last = np.array(scene.motor_table.time), float(run.time[-1])
    if covers(table, last):
        return
    within = float(run.time[run.time <= table[-1]].max(initial=0.0))
    unit = TIME_UNITS[described.time_unit]
    raise InputError(
        f"{path}: the last frame is from {last:g} s after the start of the motor, but the "
        f"scene's motor table covers {table[0]:g} to {table[-1]:g} s; leave later frames out with "
        f"t_end = {within / unit - described.time_offset:.15g}, or give a longer table"
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
    size = robot_length(scene)
    screw = max(robot.each("pitch")) * np.abs(rpm).max() / 60  # m/s
    duration = run.time[-1] - run.time[0]
    moved = np.linalg.norm(position - position[0], axis=1).max()
    names = ", ".join(name for channel, name in described.tracked.items() if channel in "xyz")
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
            + ("" if described.pixel_size else " (positions in pixels need pixel_size)")
        )
    if run.free_origin:
        return
    start = _start_position(scene, run.sight)[[c for c in run.channels if c != ANGLE]]
    distance = float(np.linalg.norm(position[0] - start))
    if distance > 0.5 * size + screw * run.time[0]:
        raise InputError(
            f"{path}: columns {names}: the first frame is {distance:.3g} m away from where "
            "the head of the scene starts; set origin = 'track' to compare displacements only"
        )


def robot_length(scene: SceneFile) -> float:
    """About the length (m) of the robot of a scene, from head to tip."""
    return max(scene.robot.each("axial_length")) + 4 * scene.robot.edge_length


def _start_position(scene: SceneFile, sight: int | None) -> np.ndarray:
    """(3,): what is tracked (m) of the scene at rest: the head node, or the silhouette."""
    built = build(scene)
    state = built.start
    topology = built.rod.topology
    if topology.head is None:
        raise InputError("the scene's robot has no head to track")
    states = jax.tree.map(lambda x: x[None], state)
    return np.asarray(seen(built, states, sight))[0, :ANGLE]
