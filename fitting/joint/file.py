"""Tables of dataset files about speeds, priors, noise, and what else is not known.

[priors]                                   # of what is fitted
C_t = { mean = 4.5, std = 0.5 }

[noise]
shape = "student"                          # or "gaussian", "huber"
correlated = true
discrepancy = { way = 0.01, angle = 0.01 }

[[runs]]
track = "run1.csv"
start = "steady"                           # this track begins after the transient
nuisances = { motor_rpm = { std = 1.0 }, drift = {}, orientation = { std = 0.1 } }

[[rates]]
motor_rpm = [30, 70, 100]
v = [-0.278, -0.619, -0.857]
head_rate = [-0.1176, -0.2585, -0.3546]
length_unit = "mm"
"""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from derjax.io.fields import Finite, Positive, Switch, Table

Numbers = Finite | tuple[Finite, ...]
Sizes = Positive | tuple[Positive, ...]


class Prior(Table):
    """What is known beforehand: a mean and a standard deviation, or nothing (`{}`)."""

    mean: Finite | None = None
    std: Positive | None = None

    @model_validator(mode="after")
    def _together(self) -> Self:
        if self.mean is not None and self.std is None:
            raise ValueError("mean: is only for a prior with std")
        return self


class KnownPrior(Table):
    """A mean and a standard deviation."""

    mean: Finite
    std: Positive


class Nuisances(Table):
    """What is estimated beside the parameters of the robot, each with a prior or with none (`{}`).

    `motor_rpm` (rpm; mean: the rate that is given) and `viscosity` (Pa s; mean: that of the scene).
    `orientation` (rad, of the way of the robot about y and about z), `drift` (of all coordinates,
    in length_unit per time_unit), `origin` (length_unit), `angle_origin` (angle_unit),
    `time_offset` (time_unit; of tracks that start at rest), `phase` (rad, of the motors in the
    first frame; of tracks that start steady).
    """

    motor_rpm: Prior | None = None
    viscosity: Prior | None = None
    orientation: Prior | None = None
    drift: Prior | None = None
    origin: Prior | None = None
    angle_origin: Prior | None = None
    time_offset: Prior | None = None
    phase: Prior | None = None

    @property
    def given(self) -> dict[str, Prior]:
        """Those that are there."""
        named = {name: getattr(self, name) for name in type(self).model_fields}
        return {name: prior for name, prior in named.items() if prior is not None}


class Shared(Table):
    """[nuisances] What is not known, but the same for all runs and rates."""

    viscosity: Prior | None = None


class Discrepancy(Table):
    """By which parts of the way and of the angle the model may be off, the same for all runs."""

    way: Positive
    angle: Positive


class NoiseFile(Table):
    """[noise] What residuals are like.

    `shape` is the distribution: "student" (4 degrees of freedom) and "huber" are for tracks with
    outliers. With `correlated = true` errors go on from frame to frame, and how much is estimated.
    """

    shape: Literal["gaussian", "student", "huber"] = "gaussian"
    correlated: Switch = False
    discrepancy: Discrepancy | None = None


class RatesFile(Table):
    """[[rates]] Speeds of a robot that swims steadily, over the rate of its motors.

    Inline as lists, or columns of a table (`file`; `columns` names them where they are not called
    as the keys). `v` is the speed along the axis, in `length_unit` per `time_unit`, positive along
    x of the scene; `head_rate` in `angle_unit` per `time_unit`. `v_std` and `head_rate_std` are
    their noise, one number or one for each rate; left out, it is estimated.
    """

    name: str | None = None
    file: str | None = None
    columns: dict[str, str] | None = None
    motor_rpm: Numbers | None = None
    v: Numbers | None = None
    v_std: Sizes | None = None
    head_rate: Numbers | None = None
    head_rate_std: Sizes | None = None
    length_unit: Literal["m", "cm", "mm", "um"] = "m"
    time_unit: Literal["s", "ms", "us", "min"] = "s"
    angle_unit: Literal["rad", "deg"] = "rad"
    scene: str | None = None
    own: Annotated[tuple[str, ...], Field()] = ()
    nuisances: Nuisances = Nuisances()

    @model_validator(mode="after")
    def _one_of(self) -> Self:
        inline = [n for n in ("motor_rpm", "v", "head_rate") if getattr(self, n) is not None]
        if self.file is not None and inline:
            raise ValueError(f"{inline[0]}: is in the file already; leave one of them out")
        if self.file is None:
            if self.columns is not None:
                raise ValueError("columns: is only for rates with a file")
            if self.motor_rpm is None:
                raise ValueError("give motor_rpm, and v or head_rate or both; or a file")
            if self.v is None and self.head_rate is None:
                raise ValueError("besides motor_rpm give v or head_rate or both")
        for std, of in (("v_std", "v"), ("head_rate_std", "head_rate")):
            if self.file is None and getattr(self, std) is not None and getattr(self, of) is None:
                raise ValueError(f"{std}: is only for rates with {of}")
        wrong = set(self.nuisances.given) - {"motor_rpm", "viscosity"}
        if wrong:
            raise ValueError(
                f"nuisances.{min(wrong)}: speeds do not depend on it; motor_rpm and viscosity may "
                "be given here"
            )
        return self
