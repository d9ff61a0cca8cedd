"""The tables of scene files, and what each of them can say of itself.

What is not given has the value of the paper's table (Lim, Yadunandan & Jawed, Soft Matter 19, 2254,
2023), except for the regularization (see `FluidTable`).
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ..io.fields import Count, Finite, NonNegative, Positive, Switch, Table
from .plausibility import USUAL_LENGTHS, check_angle, check_lengths

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


class RobotTable(Table):
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
        return of_each(getattr(self, key), self.count)

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
                raise ValueError(f"{name}: {len(given)} given for {flagella_in_words(self.count)}")
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


def of_each(given: float | tuple[float, ...], count: int) -> tuple[float, ...]:
    """What is given for each flagellum, or for all."""
    return given if isinstance(given, tuple) else (given,) * count


def flagella_in_words(count: int) -> str:
    return "1 flagellum" if count == 1 else f"{count} flagella"


class MaterialTable(Table):
    """[material] The flagellum: Young's modulus in Pa, density in kg/m^3."""

    youngs_modulus: PerFlagellum = 1.255e6
    poisson_ratio: Annotated[Finite, Field(gt=-1, le=0.5)] = 0.5
    density: Positive = 1260.0


class FluidTable(Table):
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


class HeadTable(Table):
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


class ContactTable(Table):
    """[contact] What keeps rods apart.

    "smooth" is the default for several flagella, "none" for one. `stiffness` in N/m: by
    default Young's modulus times the radius of the rod. `capacity`: how many pairs of edges may
    be close at one time; it grows as needed in `derjax simulate`.
    """

    method: Literal["smooth", "spillmann_teschner", "none"] | None = None
    stiffness: Positive | None = None
    capacity: Count | None = None


class FrictionTable(Table):
    """[friction] Coulomb friction of touching rods, regularised below `slip_speed` (m/s).

    That is by default a part (`defaults.SLIP`) of the speed of the surface of a rod that turns
    about its axis with the fastest motor.
    A scene without this table, or with a coefficient of zero, has no friction.
    """

    coefficient: Annotated[NonNegative, Field(le=10)] = 0.3
    slip_speed: Positive | None = None


TOLERANCES = {"euler": 2e-3, "trbdf2": 1e-4}
"""Of steps that adapt, unless another one is given: some 0.3 and 0.1 % in speed and head rate."""


class TimeTable(Table):
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


class GravityTable(Table):
    """[gravity] Acceleration (m/s^2); a scene without this table has no gravity."""

    acceleration: tuple[Finite, Finite, Finite] = (0.0, 0.0, -9.81)


class SolverTable(Table):
    """[solver] Newton's method: largest scaled residual, and number of iterations.

    `method`: one dense matrix, or blocks along the flagella and an iterative method for what
    couples them; by default blocks for robots of many nodes, where they can be had.
    """

    method: Literal["dense", "blocks"] | None = None
    tolerance: Annotated[Positive, Field(lt=1)] = 1e-9
    max_iterations: Count = 40
