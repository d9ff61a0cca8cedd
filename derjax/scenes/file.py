"""Scene files: TOML in SI units, checked key by key.

A scene file says what a robot is and how it is simulated. Every table may be left out.
"""

from collections.abc import Iterable, Mapping
from typing import Any, Literal, Self, TypeVar

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from pydantic import (
    Field,
    SerializationInfo,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from ..core.errors import InputError
from ..io.fields import Table
from .dimensionless import TABLE, GroupsTable, dimensional
from .extensions import Extension, extension, extension_names
from .ingredients import (
    INGREDIENTS,
    ContactTable,
    FluidTable,
    FrictionTable,
    GravityTable,
    HeadTable,
    MaterialTable,
    MotorTable,
    RobotTable,
    SolverTable,
    TimeTable,
)
from .ingredients.fluid import FINEST, FINEST_IN_BLOCKS, REGULARIZATION
from .ingredients.friction import SLIP
from .ingredients.ingredient import Ingredient, flagella_in_words, of_each
from .messages import checked
from .motortable import RateTable
from .parameters import EACH, completed, index_of, place_of
from .plausibility import check_density, check_modulus, check_regularization, check_torque
from .timing import TimeGrid, time_grid

T = TypeVar("T", bound=Table)


class SceneFile(Table):
    """A whole scene. Hashable; its numbers are also available as `parameters`."""

    robot: RobotTable = RobotTable()
    material: MaterialTable = MaterialTable()
    fluid: FluidTable = FluidTable()
    head: HeadTable = HeadTable()
    motor: MotorTable = MotorTable()
    time: TimeTable = TimeTable.model_validate({})
    contact: ContactTable = ContactTable()
    friction: FrictionTable | None = None
    gravity: GravityTable | None = None
    solver: SolverTable = SolverTable()
    motor_table: RateTable | None = Field(default=None, exclude=True)
    extensions: tuple[tuple[str, Extension], ...] = Field(default=(), exclude=True)

    @model_validator(mode="before")
    @classmethod
    def _dimensional(cls, content: Any) -> Any:
        """With keys in place of the groups that they follow from."""
        if not isinstance(content, Mapping) or TABLE not in content:
            return content
        rest = {name: table for name, table in content.items() if name != TABLE}
        return dimensional(rest, _named(TABLE, GroupsTable, content[TABLE]))

    @model_validator(mode="before")
    @classmethod
    def _extended(cls, content: Any) -> Any:
        """With the tables of extensions apart."""
        if not isinstance(content, Mapping):
            return content
        own = [name for name in extension_names() if name in content]
        if not own:
            return content
        rest = {name: table for name, table in content.items() if name not in own}
        return rest | {"extensions": tuple((name, _extension(name, content[name])) for name in own)}

    @model_serializer(mode="wrap")
    def _with_extensions(
        self, handler: SerializerFunctionWrapHandler, info: SerializationInfo
    ) -> dict[str, Any]:
        """With the tables of extensions among the others, as in the file."""
        unset = info.exclude_unset
        return handler(self) | {
            name: table.model_dump(mode=info.mode, exclude_unset=unset)
            for name, table in self.extensions
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "SceneFile":
        """The scene file with these tables, as `{"robot": {"pitch": 0.05}}`.

        Raises:
            InputError: an unknown key or a value that cannot be; the message names table and key.
        """
        return checked(cls, content)

    @model_validator(mode="after")
    def _local(self) -> Self:
        robot, regularization = self.robot, self.regularization
        self.motor.check_number(robot.count)
        check_regularization(regularization, robot.rod_radius)
        check_density(self.material.density, self.fluid.fluid_density)
        stokeslets = self.fluid.hydrodynamics == "rss"
        if (count := len(self.moduli)) != robot.count:
            raise ValueError(
                f"[material] youngs_modulus: {count} given for {flagella_in_words(robot.count)}"
            )
        pitch = min(robot.each("pitch"))
        if stokeslets and robot.shape == "helix" and regularization >= pitch:
            raise ValueError(
                f"[fluid] regularization = {regularization:g}: must be less than "
                f"the [robot] pitch of {pitch:g} m"
            )
        if stokeslets and regularization > FINEST * self.edge:
            raise ValueError(
                f"[fluid] regularization = {regularization:g}: more than {FINEST:g} "
                f"times the length of the edges, {self.edge:.3g} m: the drag of the fluid is not "
                "positive on so fine a mesh; try a larger [robot] edge_length"
            )
        if self.motor.table is None or self.motor_table is not None:
            self.check_motion()
        if self.solver.method == "blocks" and not self.in_blocks:
            raise ValueError(
                "[solver] method = 'blocks': only for an implicit [time] scheme with [fluid] "
                "drag_matrix = 'symmetric' and head_nodes = 'excluded', and a regularization of at "
                f"most {FINEST_IN_BLOCKS:g} edges of {self.edge:.3g} m"
            )
        if robot.kind == "two_flagella" and self.head.rotation == "spin":
            raise ValueError(
                "[head] rotation = 'spin': the head of kind = 'two_flagella' has no axis of its "
                "own to spin about; kind = 'branched' has"
            )
        chain = robot.kind in ("single_flagellum", "two_flagella")
        if not chain and self.fluid.head_nodes == "dropped":
            raise ValueError(
                f"[fluid] head_nodes = 'dropped': not for a robot of kind {robot.kind!r}"
            )
        if self.friction is not None and self.friction.coefficient and not self.touching:
            raise ValueError("[friction]: needs a [contact] method other than 'none'")
        if self.friction is not None and self.contact_method == "spillmann_teschner":
            raise ValueError("[friction]: is not part of [contact] method = 'spillmann_teschner'")
        return self

    def check_motion(self) -> None:
        """Checks what depends on the rates of the motors, once they are known.

        Raises:
            ValueError: the modulus has another unit, or steps, frames and end do not divide one
                another, or friction of a robot whose motors stand still has no slip speed.
        """
        if self.fluid.hydrodynamics != "none":
            rate = 2 * np.pi / 60 * self.fastest_rpm
            radius, viscosity = self.robot.rod_radius, self.fluid.viscosity
            for modulus, length in zip(self.moduli, self.robot.each("axial_length"), strict=True):
                check_modulus(modulus, radius, length, viscosity, rate)
        if self.motor.stall_torque is not None:
            stiffness, poisson = 0.5 * np.pi * self.robot.rod_radius**4, self.material.poisson_ratio
            torques = np.broadcast_to(self.motor.stall_torque, self.robot.count)
            for torque, modulus, length in zip(torques, self.moduli, self.contours, strict=True):
                shear = 0.5 * modulus / (1.0 + poisson)
                check_torque(float(torque), torque * length / (shear * stiffness))
        try:
            _ = self.grid
        except ValueError as error:
            raise ValueError(f"[time] {error}") from None
        friction = self.friction
        if self.rubbing and friction and friction.slip_speed is None and self.fastest_rpm == 0:
            raise ValueError(
                "[friction] slip_speed: must be given where all motors stand still (m/s; by "
                f"default it is {SLIP:g} of the speed of the surface of a rod that a motor turns)"
            )

    @property
    def ingredients(self) -> tuple[Ingredient, ...]:
        """The tables of derjax's own that the file has, in the order of their terms."""
        every = (getattr(self, name) for name in INGREDIENTS)
        return tuple(table for table in every if table is not None)

    @property
    def moduli(self) -> tuple[float, ...]:
        """Young's modulus of every flagellum, Pa."""
        return of_each(self.material.youngs_modulus, self.robot.count)

    @property
    def fastest_rpm(self) -> float:
        """The largest rate of any motor at any time, rpm, without sign."""
        table = self.motor_table
        return float(np.max(np.abs(self.motor.rates if table is None else table.rpm)))

    @property
    def grid(self) -> TimeGrid:
        """How the run is divided into steps and frames."""
        return time_grid(self.time.end, self.time.step, self.time.frame, self.fastest_rpm)

    @property
    def step(self) -> float:
        """Length of a step, s, or that of the first one if steps adapt."""
        return self.grid.step

    @property
    def steps_per_frame(self) -> int:
        """Steps (of the length `step`) from one saved frame to the next."""
        return self.grid.steps_per_frame

    @property
    def n_frames(self) -> int:
        """Saved frames, not counting the start."""
        return self.grid.n_frames

    @property
    def n_steps(self) -> int:
        """Steps of the run, if they do not adapt."""
        return self.n_frames * self.steps_per_frame

    @property
    def contact_method(self) -> Literal["smooth", "spillmann_teschner", "none"]:
        """How rods are kept apart."""
        return self.contact.method or ("smooth" if self.robot.count > 1 else "none")

    @property
    def contours(self) -> tuple[float, ...]:
        """Length of every flagellum along its centre line, m."""
        robot = self.robot
        contours = np.array(robot.each("axial_length"))
        if robot.shape == "helix":
            pitch = np.array(robot.each("pitch"))
            contours *= np.hypot(2 * np.pi * np.array(robot.each("helix_radius")), pitch) / pitch
        return tuple(contours.tolist())

    @property
    def edge_counts(self) -> tuple[int, ...]:
        """Number of edges of every flagellum."""
        return tuple(max(3, int(c / self.robot.edge_length + 1e-9)) for c in self.contours)

    @property
    def edge(self) -> float:
        """Length of the edges of the flagella, m; the shortest if they differ."""
        return min(c / n for c, n in zip(self.contours, self.edge_counts, strict=True))

    @property
    def in_blocks(self) -> bool:
        """Whether the scene can be solved for in blocks."""
        local = self.fluid.hydrodynamics != "rss"
        usual = self.fluid.drag_matrix == "symmetric" and self.head_nodes == "excluded"
        sharp = self.regularization <= FINEST_IN_BLOCKS * self.edge
        return (local or (usual and sharp)) and self.time.scheme != "explicit"

    @property
    def regularization(self) -> float:
        """Of Stokeslet segments, m."""
        return self.fluid.regularization or REGULARIZATION * self.robot.rod_radius

    @property
    def touching(self) -> bool:
        """Whether rods are kept apart at all."""
        return self.contact_method != "none"

    @property
    def rubbing(self) -> bool:
        """Whether there is friction."""
        return self.friction is not None and self.friction.coefficient > 0

    @property
    def head_rotation(self) -> Literal["spin", "full"]:
        """Which rotations of the head meet drag."""
        return self.head.rotation or ("spin" if self.robot.count == 1 else "full")

    @property
    def head_nodes(self) -> Literal["excluded", "dropped"]:
        """Whether head nodes stay out of the flow problem, or only the forces on them do.

        Published codes solve with them and drop the forces; the comparison options do so too,
        for robots that are one rod.
        """
        if self.fluid.head_nodes is not None:
            return self.fluid.head_nodes
        if self.robot.kind in ("branched", "clamped") or self.fluid.drag_matrix == "symmetric":
            return "excluded"
        return "dropped"

    @property
    def parameters(self) -> dict[str, Any]:
        """The numbers that a scene can be differentiated with respect to, by their keys.

        SI units, and `rpm` in revolutions per minute. With a motor table `rpm` is an array.
        """
        return self.parameters_with({})

    def parameters_with(self, others: Mapping[str, Any]) -> dict[str, Any]:
        """`parameters`, some of them replaced by `others`.

        What the file does not give follows from the others, as far as it does so by default.
        """
        return completed({**self.given, **self.whole(others)})

    @property
    def single_numbers(self) -> dict[str, float]:
        """The parameters that are one number each, as `pitch`, or `pitch[1]` of several."""
        count, numbers = self.robot.count, {}
        for name, value in self.parameters.items():
            if np.ndim(value) == 0:
                numbers[name] = float(value)
            if name in EACH and np.ndim(value) <= 1 and count > 1:
                every = np.broadcast_to(value, count)
                numbers |= {f"{name}[{k}]": float(every[k]) for k in range(count)}
        return numbers

    def check_names(self, names: Iterable[str]) -> None:
        """Refuses names of parameters that the scene does not have.

        Raises:
            KeyError: with a sentence that says which it has.
        """
        known, count = self.given, self.robot.count
        for name in names:
            base, place = index_of(name)
            if base not in known:
                raise KeyError(f"no parameter {name!r}; the scene has {', '.join(known)}")
            if place is None:
                continue
            if base not in EACH or (base == "rpm" and self.motor_table is not None):
                raise KeyError(f"no parameter {name!r}; {base} is not one of each flagellum")
            if place >= count:
                every = ", ".join(f"{base}[{k}]" for k in range(count))
                raise KeyError(f"no parameter {name!r}; the robot has {every}")

    def whole(self, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """`numbers` with those of one flagellum or motor, as `pitch[1]`, in lists for all."""
        found = {name: value for name, value in numbers.items() if index_of(name)[1] is None}
        for name, value in numbers.items():
            base, place = index_of(name)
            if place is not None:
                found[base] = _with_one(
                    found.get(base, self.given[base]), self.robot.count, place, value
                )
        return found

    def with_parameters(self, numbers: Mapping[str, Any]) -> "SceneFile":
        """The file in which some of the parameters stand with these numbers, checked.

        Raises:
            InputError: the numbers cannot be; the message names table and key.
        """
        content = self.model_dump(exclude_unset=True)
        table = self.motor_table
        for name, number in self.whole(numbers).items():
            if name == "rpm" and table is not None:
                rates = {"time": table.time, "rpm": np.asarray(number).tolist()}
                table = checked(RateTable, rates)
            else:
                _put(content, name, number)
        changed = checked(SceneFile, content)
        if table is None:
            return changed
        changed = changed.model_copy(update={"motor_table": table})
        try:
            changed.check_motion()
        except ValueError as error:
            raise InputError(str(error)) from None
        return changed

    def content(self, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """All tables as JSON data, with some of the parameters as `numbers` has them, unchecked.

        What the file leaves open stays so if it follows from the others by default. A table of the
        motor is left as it is.
        """
        content = self.model_dump(mode="json")
        given = self.given
        following = self.parameters_with({k: v for k, v in numbers.items() if given[k] is not None})
        for name, number in numbers.items():
            as_usual = given[name] is None and np.isclose(number, following[name], 1e-12, 0)
            if not (as_usual or (name == "rpm" and self.motor_table is not None)):
                _put(content, name, number)
        return content

    @property
    def given(self) -> dict[str, Any]:
        """The parameters that the file gives or has defaults for; None for those that follow."""
        numbers: dict[str, Any] = {}
        for table in self.ingredients:
            for key, parameter in table.PARAMETERS.items():
                if parameter.when(self):
                    value = getattr(table, key)
                    whole = parameter.each and isinstance(value, tuple)
                    numbers[parameter.name] = np.array(value) if whole else value
        if self.motor_table is not None:
            numbers["rpm"] = np.array(self.motor_table.rpm)
        for name, table in self.extensions:
            for key in table.NUMBERS:
                value = getattr(table, key)
                whole = np.array(value, float) if isinstance(value, tuple | list) else value
                numbers[f"{name}.{key}"] = whole
        return numbers


def _with_one(given: Any, count: int, place: int, value: Any) -> Any:
    """(count,) what is given for all or for each, with another value in one place."""
    if isinstance(given, Tracer) or isinstance(value, Tracer):
        return jnp.broadcast_to(jnp.asarray(given, float), count).at[place].set(value)
    every = np.array(np.broadcast_to(np.asarray(given, float), count))
    every[place] = value
    return every


def _extension(name: str, content: Any) -> Extension:
    """The table of an extension, checked; `InputError` names table and key."""
    return content if isinstance(content, Extension) else _named(name, extension(name), content)


def _named(name: str, kind: type[T], content: Any) -> T:
    """A table that is checked by itself; `InputError` names it and the key."""
    if not isinstance(content, Mapping):
        raise InputError(f"[{name}]: should be a table")
    try:
        return checked(kind, content)
    except InputError as error:
        said = str(error).splitlines()
        raise InputError(
            "\n".join(s if s.startswith(f"[{name}]") else f"[{name}] {s}" for s in said)
        ) from None


def _put(content: dict[str, Any], name: str, number: Any) -> None:
    """Puts a parameter into the tables of a file."""
    table, key = place_of(name)
    content.setdefault(table, {})[key] = np.asarray(number).tolist()
