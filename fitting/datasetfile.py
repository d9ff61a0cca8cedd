"""Dataset files: TOML that names tracks and says how to read them.

scene = "scene.toml"            # relative to this file

[[runs]]
track = "run1.csv"
motor_rpm = 70
columns = { t = "time", x = "x_mm", y = "-y_mm", head_angle = "angle" }
length_unit = "mm"
"""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from derjax.io.fields import Finite, NonNegative, Positive, Switch, Table

from .joint.file import KnownPrior, NoiseFile, Nuisances, RatesFile, Shared
from .observe import CHANNELS
from .trackkeys import TrackKeys

LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
ANGLE_UNITS = {"rad": 1.0, "deg": np.pi / 180.0}


class Columns(Table):
    """The names that the channels have in the header of the track; those that it has.

    A minus before a name turns the sense of an axis or an angle, as of y in images. Without `t` the
    column of times or frames is that of the program that wrote the table.
    """

    t: str | None = None
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


class RunFile(TrackKeys):
    """[[runs]] One track and how to read it.

    Without `columns` the file is read as the program that wrote it is known to write; keys on how
    a track is written are those of `TrackKeys`.

    `motor_rpm` is one rate for all motors, or a list with one for each. Positions are in
    `length_unit`, or, with `pixel_size`, in pixels of so many of that unit. With `fps` (frames
    per second) the column t holds the numbers of frames, and the time is 0 at `first_frame`, by
    default the lowest number in the track; else t is in `time_unit`. Of a table with several
    objects the rows are taken whose `track_column` is `track_id`, or one of several.

    `t_start` and `t_end` (in `time_unit`) select frames. `time_offset` (in `time_unit`) is
    added to the times of the track: in the simulation the motor starts at time 0, which for a
    camera switched on 3 s later is 3 s before its first frame. `exposure` (in `time_unit`) is for
    how long the shutter is open from the time of each frame on; what is seen is the mean over that.
    `sigma` is the noise of positions
    in `length_unit`, `sigma_angle` that of the angle in `angle_unit`; left out, the noise is
    estimated. `origin` says what positions are relative to: with "scene" they are those of
    the scene, with "track" only displacements are compared. With `drift = true` the robot may drift
    besides, as in a tank that flows: a steady velocity is fitted.

    `start = "steady"` says that the track begins after the transient: then it is compared with the
    steady state, or the periodic orbit, from a phase that is fitted, and times only count from the
    first frame on. `scene` is another robot than that of the dataset, `own` names parameters of
    which this run has a value of its own, and `nuisances` what else is not known of it.
    """

    track: str
    motor_rpm: Finite | tuple[Finite, ...] | None = None
    columns: Columns | None = None
    track_id: Finite | str | tuple[Finite | str, ...] | None = None
    track_column: str | None = None
    length_unit: Literal["m", "cm", "mm", "um"] = "m"
    pixel_size: Positive | None = None
    time_unit: Literal["s", "ms", "us", "min"] = "s"
    fps: Positive | None = None
    first_frame: Finite | None = None
    angle_unit: Literal["rad", "deg"] = "rad"
    sigma: Positive | None = None
    sigma_angle: Positive | None = None
    t_start: Finite | None = None
    t_end: Finite | None = None
    time_offset: Finite = 0.0
    exposure: NonNegative = 0.0
    origin: Literal["scene", "track"] = "scene"
    drift: Switch = False
    start: Literal["rest", "steady"] = "rest"
    scene: str | None = None
    own: tuple[str, ...] = ()
    nuisances: Nuisances = Nuisances()

    @model_validator(mode="after")
    def _together(self) -> Self:
        for name, needed in (("first_frame", "fps"), ("track_column", "track_id")):
            if getattr(self, name) is not None and getattr(self, needed) is None:
                raise ValueError(f"{name}: is only for runs with {needed}")
        given = self.nuisances.given
        if self.start == "steady" and "time_offset" in given:
            raise ValueError(
                "nuisances.time_offset: has no effect on a track that starts steady: the phase in "
                "its first frame is fitted"
            )
        if self.start == "steady" and self.point == "silhouette":
            raise ValueError(
                'start = "steady": is only for tracks of heads: a silhouette changes as the robot '
                'rolls, and its track is no part of a gait; with point = "silhouette" a track is '
                "simulated from rest, and must have the transient"
            )
        if self.start == "rest" and "phase" in given:
            raise ValueError(
                'nuisances.phase: is only for tracks with start = "steady"; from rest the motors '
                "start at phase 0 of the scene: time_offset says when"
            )
        if self.start == "rest" and "motor_rpm" in given:
            raise ValueError(
                'nuisances.motor_rpm: is only for tracks with start = "steady": leave the '
                "transient out with t_start"
            )
        return self

    @property
    def tracked(self) -> dict[str, str]:
        """Column name of every channel that was tracked, as far as the file says."""
        return {} if self.columns is None else self.columns.tracked

    @property
    def length(self) -> float:
        """What a position of 1 is, in m."""
        return LENGTH_UNITS[self.length_unit] * (self.pixel_size or 1.0)

    @property
    def tracks(self) -> tuple[str, ...]:
        """The values of `track_id`; none if all rows are taken."""
        given = () if self.track_id is None else self.track_id
        return tuple(map(str, given if isinstance(given, tuple) else (given,)))


class DatasetFile(Table):
    """A whole dataset file."""

    scene: str
    runs: Annotated[tuple[RunFile, ...], Field(default=())]
    rates: tuple[RatesFile, ...] = ()
    priors: dict[str, KnownPrior] = Field(default_factory=dict)
    noise: NoiseFile = NoiseFile()
    nuisances: Shared = Shared()

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.runs and not self.rates:
            raise ValueError("there is nothing to fit: give [[runs]] or [[rates]]")
        return self
