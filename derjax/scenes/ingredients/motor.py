"""[motor]: how fast the motors turn, or how strong they are."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

import jax.numpy as jnp
from jaxtyping import Array
from pydantic import SerializerFunctionWrapHandler, model_serializer, model_validator

from ...integrate.motor import Motor
from ...io.fields import Count, Finite, NonNegative, Positive, Table
from ...terms.motor import TorqueMotor
from .ingredient import (
    Idle,
    Ingredient,
    Parameter,
    PerFlagellum,
    SceneFile,
    Setting,
    because,
    flagella_in_words,
    has_value,
    is_headless,
)

FASTEST_RPM = 1e6
"""No motor is faster: those of bacteria reach 1e5 (Vibrio), small turbines a few times that."""


class MotorColumns(Table):
    """[motor] columns: their names in the table, for all motors or one for each.

    `rpm` is a rate in revolutions per minute; `counts`, instead, those of an encoder.
    """

    time: str = "time"
    rpm: str | tuple[str, ...] | None = None
    counts: str | tuple[str, ...] | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.rpm is not None and self.counts is not None:
            raise ValueError("rpm: give either rpm or counts, not both")
        return self

    @property
    def driven(self) -> tuple[str, ...]:
        """Names of the columns that say how the motors turn; none: the usual ones."""
        given = self.rpm or self.counts or ()
        return (given,) if isinstance(given, str) else given


def _prescribed(file: SceneFile) -> bool:
    return file.motor.stall_torque is None


def _limited(file: SceneFile) -> bool:
    return not _prescribed(file)


class MotorTable(Ingredient):
    """[motor] A constant rate, the path of a table, or a torque that falls with the rate.

    The rate is one for all motors, or a list with one for each. A table has by default the
    columns `time` and `rpm`, or `rpm_1`, `rpm_2` and so on for motors that differ; `columns`
    says other ones. Encoders have `counts_per_turn` of the shaft. Times are in `time_unit`, and
    `time_offset`, in that unit, is added to them: the run begins at 0.

    In place of a rate, a motor may have a `stall_torque` (N m) and a rate at which it turns with no
    load, `free_rpm`: its torque falls linearly from the one to the other, and a negative `free_rpm`
    turns it backwards. `ripple` is a part of the rate, or of the stall torque, that goes up and
    down `ripple_order` times in a turn. These, too, are one for all motors, or a list.

    `hinge` says how the rod bends where a motor turns it: "rigid", as everywhere else, or as in the
    "published" model, in which it goes limp once in every turn (see `Topology.motor_hinge`).
    """

    PARAMETERS: ClassVar[Mapping[str, Parameter]] = {
        "rpm": Parameter("rpm", "rpm", each=True, when=_prescribed),
        "stall_torque": Parameter("stall_torque", "N m", each=True, when=_limited),
        "free_rpm": Parameter("free_rpm", "rpm", each=True, when=_limited),
        "ripple": Parameter("ripple", "1", each=True, when=lambda s: s.motor.rippled),
    }
    IDLE: ClassVar[tuple[Idle, ...]] = (
        Idle(("hinge",), is_headless, has_value("robot", "kind")),
        Idle(("ripple_order",), lambda s: not s.motor.rippled, because("without ripple")),
    )

    rpm: Finite | tuple[Finite, ...] = 60.0
    stall_torque: PerFlagellum | None = None
    free_rpm: Finite | tuple[Finite, ...] | None = None
    ripple: NonNegative | tuple[NonNegative, ...] = 0.0
    ripple_order: Count = 1
    table: str | None = None
    columns: MotorColumns = MotorColumns()
    counts_per_turn: Positive | None = None
    time_unit: Literal["s", "ms", "us", "min"] = "s"
    time_offset: Finite = 0.0
    hinge: Literal["rigid", "published"] = "rigid"

    @model_serializer(mode="wrap")
    def _without_rate(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without the default of a rate, where there is a torque in its place."""
        content = handler(self)
        if self.stall_torque is not None:
            content.pop("rpm", None)
        return content

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.table is not None and "rpm" in self.model_fields_set:
            raise ValueError("rpm: give either rpm or table, not both")
        name = "rpm" if self.stall_torque is None else "free_rpm"
        for rpm in self.rates:
            if abs(rpm) > FASTEST_RPM:
                raise ValueError(f"{name} = {rpm:g}: beyond any motor (revolutions per minute)")
        return self

    @model_validator(mode="after")
    def _torque(self) -> Self:
        if self.stall_torque is None:
            if self.free_rpm is not None:
                raise ValueError("stall_torque: must be given (N m) where free_rpm is")
        else:
            for name in ("rpm", "table"):
                if name in self.model_fields_set and getattr(self, name) is not None:
                    raise ValueError(f"stall_torque: give either {name} or stall_torque, not both")
            if self.free_rpm is None:
                raise ValueError("free_rpm: must be given (revolutions per minute with no load)")
            if 0.0 in self.rates:
                raise ValueError("free_rpm = 0: such a motor cannot start")
            if self.hinge == "published":
                raise ValueError(
                    "hinge = 'published': a motor of limited torque cannot turn a hinge that goes "
                    "limp; leave the key out"
                )
        for ripple in self.ripples:
            if ripple >= 1.0:
                raise ValueError(
                    f"ripple = {ripple:g}: must be less than 1: such a motor cannot start from "
                    "every angle"
                )
        return self

    @model_validator(mode="after")
    def _log(self) -> Self:
        if self.table is None:
            for name in ("columns", "counts_per_turn", "time_unit", "time_offset"):
                if getattr(self, name) != type(self).model_fields[name].default:
                    raise ValueError(f"{name}: is only for a table")
        if self.columns.counts is not None and self.counts_per_turn is None:
            raise ValueError("counts_per_turn: must be given for columns with counts")
        if self.columns.counts is None and self.counts_per_turn is not None:
            raise ValueError("counts_per_turn: is only for columns = { counts = ... }")
        return self

    @property
    def rates(self) -> tuple[float, ...]:
        """The constant rates that are given, rpm, or those with no load: one for all, or each."""
        given = self.rpm if self.stall_torque is None or self.free_rpm is None else self.free_rpm
        return given if isinstance(given, tuple) else (given,)

    @property
    def ripples(self) -> tuple[float, ...]:
        """The ripple that is given, one for all motors, or one for each."""
        return self.ripple if isinstance(self.ripple, tuple) else (self.ripple,)

    @property
    def rippled(self) -> bool:
        """Whether any motor has ripple."""
        return any(self.ripples)

    def check_number(self, count: int) -> None:
        """Refuses lists that have no value for every motor.

        Raises:
            ValueError: the message begins with table and key.
        """
        for name in ("rpm", "stall_torque", "free_rpm", "ripple"):
            given = getattr(self, name)
            if isinstance(given, tuple) and len(given) not in (1, count):
                what = "rates" if name == "rpm" else "values"
                raise ValueError(
                    f"[motor] {name}: {len(given)} {what} given for {flagella_in_words(count)}"
                )

    def motor(self, setting: Setting) -> Motor | TorqueMotor:
        """Motors of prescribed rates, or of limited torque; one value is that of every motor."""
        topology, numbers = setting.rod.topology, setting.numbers
        n_motors = len(topology.motors) + len(topology.driven_edges)
        turns = 2 * jnp.pi / 60

        def each(value: Any) -> Array:
            return jnp.broadcast_to(jnp.asarray(value, float), (n_motors,))

        ripple = each(numbers["ripple"]) if self.rippled else None
        order = each(self.ripple_order) if self.rippled else None
        if self.stall_torque is not None:
            torque, rate = each(numbers["stall_torque"]), turns * each(numbers["free_rpm"])
            return TorqueMotor(torque, rate, ripple, order)
        times, rate = (0.0,), numbers["rpm"]
        if setting.file.motor_table is not None:
            times = setting.file.motor_table.time
            rate = rate.reshape(len(times), -1)
        rate = jnp.broadcast_to(rate, (len(times), n_motors))
        return Motor(jnp.array(times), turns * rate, ripple, order)
