"""Scene files: TOML in SI units, checked key by key.

A scene file says what a robot is and how it is simulated. Every table may be left out; what
is not given has the value of the paper's table (Lim, Yadunandan & Jawed, Soft Matter 19,
2254, 2023), except for the regularization (see `Fluid`).
"""

import tomllib
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

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

from ..core.errors import InputError, InputWarning
from ..io.fields import Count, Finite, NonNegative, Positive, Switch, Table
from ..io.textfile import LEGACY, encoding_of, read_text
from .defaults import REGULARIZATION, SLIP, completed
from .effects import idle_keys
from .extensions import Extension, extension, extension_names
from .messages import check, checked
from .motortable import Motor, MotorTable, read_motor_table
from .parameters import EACH, index_of, place_of
from .parameters import UNITS as UNITS
from .plausibility import (
    USUAL_LENGTHS,
    check_angle,
    check_density,
    check_lengths,
    check_modulus,
    check_regularization,
)
from .timing import TimeGrid, time_grid

PerFlagellum = Positive | tuple[Positive, ...]
"""One number for all flagella, or a list with one for each."""

Handedness = Literal["left", "right"]
MOST_FLAGELLA, MOST_ON_A_HEAD = 64, 8

SHORTEST_LINK = 0.05
"""The least radius of a helix, in edges."""

FINEST = 3.5
"""The most that the regularization may be, in edges: with more the flow problem, an equation of
the first kind, has forces at the ends of a flagellum that alternate and grow, and drag that does
work."""

FINEST_IN_BLOCKS = 1.7
"""The same for robots in blocks, each of which is an equation of that kind."""


class Robot(Table):
    """[robot] Shape of the robot, in metres.

    `n_flagella` is given for the kinds "branched" and "clamped". Flagella lie around the
    robot's axis, neighbours `separation` apart; `handedness` and `phase` (rad, about the axis
    of each), `helix_radius`, `pitch` and `axial_length` are one for all, or a list with one for
    each. The shape "arc" is pre-bent by the
    angle `bend` (rad).
    """

    kind: Literal["single_flagellum", "two_flagella", "branched", "clamped"] = "single_flagellum"
    n_flagella: Annotated[Count, Field(le=MOST_FLAGELLA)] | None = None
    shape: Literal["helix", "straight", "arc"] = "helix"
    bend: Finite = 0.0
    helix_radius: PerFlagellum = USUAL_LENGTHS["helix_radius"]
    pitch: PerFlagellum = USUAL_LENGTHS["pitch"]
    axial_length: PerFlagellum = USUAL_LENGTHS["axial_length"]
    rod_radius: Positive = USUAL_LENGTHS["rod_radius"]
    edge_length: Positive = USUAL_LENGTHS["edge_length"]
    head_radius: Positive = USUAL_LENGTHS["head_radius"]
    separation: Positive = USUAL_LENGTHS["separation"]
    handedness: Handedness | tuple[Handedness, ...] = "left"
    phase: Finite | tuple[Finite, ...] = 0.0
    clamped_tip: Switch = False

    @property
    def count(self) -> int:
        """Number of flagella."""
        fixed = {"single_flagellum": 1, "two_flagella": 2}
        return fixed.get(self.kind) or self.n_flagella or 1

    def each(self, key: str) -> tuple[float, ...]:
        """A length of every flagellum, m."""
        return _each(getattr(self, key), self.count)

    @property
    def hands(self) -> tuple[Handedness, ...]:
        """Handedness of every flagellum."""
        given = self.handedness
        return (given,) * self.count if isinstance(given, str) else given

    @property
    def phases(self) -> tuple[float, ...]:
        """Phase of every flagellum, rad."""
        given = self.phase
        return given if isinstance(given, tuple) else (given,) * self.count

    @model_validator(mode="after")
    def _metres(self) -> Self:
        check_lengths(self.lengths, self.model_fields_set)
        return self

    @model_validator(mode="after")
    def _radians(self) -> Self:
        for name, angles in (("phase", self.phases), ("bend", (self.bend,))):
            for angle in angles:
                check_angle(name, angle)
        return self

    @model_validator(mode="after")
    def _flagella(self) -> Self:
        counted = self.kind in ("branched", "clamped")
        if counted and self.n_flagella is None:
            raise ValueError(f"n_flagella: must be given for kind = {self.kind!r}")
        if self.n_flagella is not None and not counted and self.n_flagella != self.count:
            raise ValueError(
                f"n_flagella = {self.n_flagella}: a robot of kind {self.kind!r} has {self.count}; "
                "kind = 'branched' takes any number"
            )
        if self.kind == "branched" and self.count > MOST_ON_A_HEAD:
            raise ValueError(f"n_flagella = {self.count}: at most {MOST_ON_A_HEAD} fit on a head")
        lists = {"handedness": self.hands, "phase": self.phases}
        lists |= {key: self.each(key) for key in ("helix_radius", "pitch", "axial_length")}
        for name, given in lists.items():
            if len(given) != self.count:
                raise ValueError(f"{name}: {len(given)} given for {_flagella(self.count)}")
        if self.count > 1 and self.separation <= 2 * self.rod_radius:
            raise ValueError(
                f"separation = {self.separation:g}: the flagella overlap; their axes must be more "
                f"than the rod's diameter of {2 * self.rod_radius:g} m apart"
            )
        if self.clamped_tip and self.kind != "clamped":
            raise ValueError(
                f"clamped_tip = true: is for kind = 'clamped', whose filaments are held at their "
                f"bases; this robot is of kind {self.kind!r}"
            )
        if self.bend and self.shape != "arc":
            raise ValueError(f"bend = {self.bend:g}: is only for shape = 'arc'")
        return self

    @property
    def lengths(self) -> dict[str, float]:
        """The lengths that matter for the robot, m."""
        unused = set()
        if self.shape != "helix":
            unused |= {"helix_radius", "pitch"}
        if self.kind == "clamped":
            unused.add("head_radius")
        if self.count == 1:
            unused.add("separation")
        chosen = {key: getattr(self, key) for key in USUAL_LENGTHS if key not in unused}
        return {key: float(np.max(given)) for key, given in chosen.items()}

    @model_validator(mode="after")
    def _slender(self) -> Self:
        radius, pitch = min(self.each("helix_radius")), min(self.each("pitch"))
        length = min(self.each("axial_length"))
        if self.shape == "helix" and radius < SHORTEST_LINK * self.edge_length:
            raise ValueError(
                f"helix_radius = {radius:g}: too small: the edge from the shaft to the "
                f"helix has that length, and others the edge_length of {self.edge_length:g} m; "
                "a straight flagellum has shape = 'straight'"
            )
        if self.shape == "helix" and self.rod_radius >= 0.5 * pitch:
            raise ValueError(
                f"rod_radius = {self.rod_radius:g}: the turns of the helix overlap; "
                f"it must be less than half the pitch of {pitch:g} m"
            )
        if self.edge_length > 0.34 * length:
            raise ValueError(
                f"edge_length = {self.edge_length:g}: three edges must fit into "
                f"the axial_length of {length:g} m"
            )
        return self


def _each(given: float | tuple[float, ...], count: int) -> tuple[float, ...]:
    """What is given for each flagellum, or for all."""
    return given if isinstance(given, tuple) else (given,) * count


def _flagella(count: int) -> str:
    return "1 flagellum" if count == 1 else f"{count} flagella"


class Material(Table):
    """[material] The flagellum: Young's modulus in Pa, density in kg/m^3."""

    youngs_modulus: PerFlagellum = 1.255e6
    poisson_ratio: Annotated[Finite, Field(gt=-1, le=0.5)] = 0.5
    density: Positive = 1260.0


class Fluid(Table):
    """[fluid] Viscosity in Pa s, density in kg/m^3, and the drag on the flagella.

    The regularization (m) is by default 1.04 rod radii (`defaults.REGULARIZATION`): the paper's
    table prints a tenth of that, which contradicts the buckling thresholds of the same paper.
    `spin_drag` says whether rods that spin about their own axis meet drag, which they do not in
    the paper's model.
    """

    viscosity: Positive = 1.0
    fluid_density: NonNegative = 1260.0
    hydrodynamics: Literal["rss", "rft", "none"] = "rss"
    resistive: Literal["gray_hancock", "lighthill"] = "gray_hancock"
    regularization: Positive | None = None
    end_nodes: Literal["half", "full"] = "half"
    drag_matrix: Literal["symmetric", "collocation", "lower_triangle"] = "symmetric"
    head_nodes: Literal["excluded", "dropped"] | None = None
    spin_drag: Switch = False

    @model_validator(mode="after")
    def _wet(self) -> Self:
        if self.spin_drag and self.hydrodynamics == "none":
            raise ValueError("spin_drag = true: is of a fluid; hydrodynamics = 'none' has none")
        return self


class Head(Table):
    """[head] Drag prefactors (dimensionless) and mass (kg; default: a ball of the material).

    `rotation` says which rotations of the head meet drag: its spin about its own axis only,
    as in the paper's model of one flagellum, or all ("full", the default for several flagella).
    `stiffness` is that of the arms of a head with several flagella, relative to the rod's.
    """

    drag: Literal["stokes", "none"] = "stokes"
    C_t: NonNegative = 4.8
    C_r: NonNegative = 0.36
    rotation: Literal["spin", "full"] | None = None
    stiffness: Positive = 100.0
    mass: Positive | None = None


class Contact(Table):
    """[contact] What keeps rods apart.

    "smooth" is the default for several flagella, "none" for one. `stiffness` in N/m: by
    default Young's modulus times the radius of the rod. `capacity`: how many pairs of edges may
    be close at one time; it grows as needed in `derjax simulate`.
    """

    method: Literal["smooth", "spillmann_teschner", "none"] | None = None
    stiffness: Positive | None = None
    capacity: Count | None = None


class Friction(Table):
    """[friction] Coulomb friction of touching rods, regularised below `slip_speed` (m/s).

    That is by default a part (`defaults.SLIP`) of the speed of the surface of a rod that turns
    about its axis with the fastest motor.
    A scene without this table, or with a coefficient of zero, has no friction.
    """

    coefficient: Annotated[NonNegative, Field(le=10)] = 0.3
    slip_speed: Positive | None = None


TOLERANCES = {"euler": 2e-3, "trbdf2": 1e-4}
"""Of steps that adapt, unless another one is given: some 0.3 and 0.1 % in speed and head rate."""


class Time(Table):
    """[time] Step, end and interval of saved frames (s), and the scheme.

    `step` and `frame` are by default chosen by the motors' rates (`SceneFile.grid`).
    With a `tolerance`, or with neither that nor a `step`, steps adapt to the motion: the
    estimated error of each is at most that part of the radius of a circle as long as a flagellum.
    `step` is then that of the start. The schemes are "euler", implicit and of first order,
    "trbdf2", of second order, and "explicit", with the drag of the step before.
    """

    step: Positive | None = None
    end: Positive = 20.0
    frame: Positive | None = None
    scheme: Literal["euler", "trbdf2", "explicit"] = "euler"
    tolerance: Annotated[Positive, Field(lt=1)] | None = None
    inertia: Switch = True

    @model_validator(mode="before")
    @classmethod
    def _adapts(cls, given: Any) -> Any:
        if not isinstance(given, Mapping) or given.keys() & {"step", "tolerance"}:
            return given
        scheme = given.get("scheme", "euler")
        if scheme == "explicit":
            raise ValueError("step: must be given for scheme = 'explicit'")
        return {**given, "tolerance": TOLERANCES.get(str(scheme))}

    @model_validator(mode="after")
    def _implicit(self) -> Self:
        if self.tolerance is not None and self.scheme == "explicit":
            raise ValueError("tolerance: steps of scheme = 'explicit' do not adapt")
        return self


class Gravity(Table):
    """[gravity] Acceleration (m/s^2); a scene without this table has no gravity."""

    acceleration: tuple[Finite, Finite, Finite] = (0.0, 0.0, -9.81)


class Solver(Table):
    """[solver] Newton's method: largest scaled residual, and number of iterations.

    `method`: one dense matrix, or blocks along the flagella and an iterative method for what
    couples them; by default blocks for robots of many nodes, where they can be had.
    """

    method: Literal["dense", "blocks"] | None = None
    tolerance: Annotated[Positive, Field(lt=1)] = 1e-9
    max_iterations: Count = 40


class SceneFile(Table):
    """A whole scene. Hashable; its numbers are also available as `parameters`."""

    robot: Robot = Robot()
    material: Material = Material()
    fluid: Fluid = Fluid()
    head: Head = Head()
    motor: Motor = Motor()
    time: Time = Time.model_validate({})
    contact: Contact = Contact()
    friction: Friction | None = None
    gravity: Gravity | None = None
    solver: Solver = Solver()
    motor_table: MotorTable | None = Field(default=None, exclude=True)
    extensions: tuple[tuple[str, Extension], ...] = Field(default=(), exclude=True)

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
        check_regularization(regularization, robot.rod_radius)
        check_density(self.material.density, self.fluid.fluid_density)
        stokeslets = self.fluid.hydrodynamics == "rss"
        if (count := len(self.moduli)) != robot.count:
            raise ValueError(
                f"[material] youngs_modulus: {count} given for {_flagella(robot.count)}"
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
        if len(self.motor.rates) not in (1, robot.count):
            raise ValueError(
                f"[motor] rpm: {len(self.motor.rates)} rates given for {_flagella(robot.count)}"
            )
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
    def moduli(self) -> tuple[float, ...]:
        """Young's modulus of every flagellum, Pa."""
        return _each(self.material.youngs_modulus, self.robot.count)

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
    def edge(self) -> float:
        """Length of the edges of the flagella, m; the shortest if they differ."""
        robot = self.robot
        contours = np.array(robot.each("axial_length"))
        if robot.shape == "helix":
            pitch = np.array(robot.each("pitch"))
            contours *= np.hypot(2 * np.pi * np.array(robot.each("helix_radius")), pitch) / pitch
        edges = [c / max(3, int(c / robot.edge_length + 1e-9)) for c in contours.tolist()]
        return min(edges)

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
                table = checked(MotorTable, rates)
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
        robot, material, fluid, head = self.robot, self.material, self.fluid, self.head
        numbers = {
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
        if robot.kind == "clamped":
            del numbers["head_radius"], numbers["C_t"], numbers["C_r"]
        if robot.shape != "helix":
            del numbers["helix_radius"], numbers["pitch"]
        if robot.shape == "arc":
            numbers["bend"] = robot.bend
        if robot.count > 1:
            numbers["separation"] = robot.separation
        if self.contact_method == "smooth":
            numbers["contact_stiffness"] = self.contact.stiffness
        if self.rubbing and self.friction is not None:
            numbers["friction"] = self.friction.coefficient
        for name in EACH:
            if isinstance(numbers.get(name), tuple):
                numbers[name] = np.array(numbers[name])
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
    if isinstance(content, Extension):
        return content
    if not isinstance(content, Mapping):
        raise InputError(f"[{name}]: should be a table")
    try:
        return checked(extension(name), content)
    except InputError as error:
        said = str(error).splitlines()
        raise InputError(
            "\n".join(s if s.startswith(f"[{name}]") else f"[{name}] {s}" for s in said)
        ) from None


def _put(content: dict[str, Any], name: str, number: Any) -> None:
    """Puts a parameter into the tables of a file."""
    table, key = place_of(name)
    content.setdefault(table, {})[key] = np.asarray(number).tolist()


def load_scene(path: str | Path) -> SceneFile:
    """Read and check a scene file.

    Warns with an `InputWarning` for every key that has no effect (see `effects`).

    Raises:
        InputError: the file is missing, is not TOML, or has an unknown key or a value that
            cannot be; the message names file and key.
    """
    path = Path(path)
    content = read_toml(path)
    scene = with_motor_table(check(SceneFile, content, path), path)
    for sentence in idle_keys(scene, content).values():
        warnings.warn(f"{path}: {sentence}", InputWarning, stacklevel=2)
    return scene


def with_motor_table(scene: SceneFile, path: Path) -> SceneFile:
    """The scene with the motor table that it names, if it does; `path` is that of its file.

    Raises:
        InputError: the table cannot be read or does not fit the scene.
    """
    if scene.motor.table is None:
        return scene
    try:
        table = read_motor_table(
            path.parent / scene.motor.table, scene.motor, scene.time.end, scene.robot.count
        )
    except InputError as error:
        raise InputError(f"{path}: [motor] table: {error}") from None
    scene = scene.model_copy(update={"motor_table": table})
    try:
        scene.check_motion()
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    return scene


def read_toml(path: Path) -> dict[str, Any]:
    """The contents of a TOML file; `InputError` if there is none."""
    if encoding_of(path) in LEGACY:
        raise InputError(f"{path}: cannot be read: it is not UTF-8; save it in that encoding")
    text = read_text(path)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        end = f"at end of document, line {text.count(chr(10)) + 1}"
        said = str(error).replace("at end of document", end)
        raise InputError(f"{path}: not valid TOML: {said}") from None
