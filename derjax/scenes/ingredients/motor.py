"""[motor]: how fast the motors turn."""

from collections.abc import Mapping
from typing import ClassVar, Literal, Self

import jax.numpy as jnp
from pydantic import model_validator

from ...integrate.motor import Motor
from ...io.fields import Finite, Positive, Table
from .ingredient import Idle, Ingredient, Parameter, Setting, has_value, is_headless

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


class MotorTable(Ingredient):
    """[motor] A constant rate, or the path of a table.

    The rate is one for all motors, or a list with one for each. A table has by default the
    columns `time` and `rpm`, or `rpm_1`, `rpm_2` and so on for motors that differ; `columns`
    says other ones. Encoders have `counts_per_turn` of the shaft. Times are in `time_unit`, and
    `time_offset`, in that unit, is added to them: the run begins at 0.

    `hinge` says how the rod bends where a motor turns it: "rigid", as everywhere else, or as in the
    "published" model, in which it goes limp once in every turn (see `Topology.motor_hinge`).
    """

    PARAMETERS: ClassVar[Mapping[str, Parameter]] = {"rpm": Parameter("rpm", "rpm", each=True)}
    IDLE: ClassVar[tuple[Idle, ...]] = (Idle(("hinge",), is_headless, has_value("robot", "kind")),)

    rpm: Finite | tuple[Finite, ...] = 60.0
    table: str | None = None
    columns: MotorColumns = MotorColumns()
    counts_per_turn: Positive | None = None
    time_unit: Literal["s", "ms", "us", "min"] = "s"
    time_offset: Finite = 0.0
    hinge: Literal["rigid", "published"] = "rigid"

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.table is not None and "rpm" in self.model_fields_set:
            raise ValueError("rpm: give either rpm or table, not both")
        for rpm in self.rates:
            if abs(rpm) > FASTEST_RPM:
                raise ValueError(f"rpm = {rpm:g}: beyond any motor (revolutions per minute)")
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
        """The constant rates that are given, rpm: one for all motors, or one for each."""
        return self.rpm if isinstance(self.rpm, tuple) else (self.rpm,)

    def motor(self, setting: Setting) -> Motor:
        """Rates by time and motor; one rate is that of every motor."""
        topology, rpm = setting.rod.topology, setting.numbers["rpm"]
        n_motors = len(topology.motors) + len(topology.driven_edges)
        times, rate = (0.0,), rpm
        if setting.file.motor_table is not None:
            times = setting.file.motor_table.time
            rate = rpm.reshape(len(times), -1)
        rate = jnp.broadcast_to(rate, (len(times), n_motors))
        return Motor(jnp.array(times), rate * (2 * jnp.pi / 60))
