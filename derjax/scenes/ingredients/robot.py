"""[robot]: the shape of the robot.

What is not given has the value of the paper's table (Lim, Yadunandan & Jawed, Soft Matter 19, 2254,
2023), as in all tables, except for the regularization (see `FluidTable`).
"""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ...io.fields import Count, Finite, Positive, Switch
from ..plausibility import USUAL_LENGTHS, check_angle, check_lengths
from .ingredient import (
    Idle,
    Ingredient,
    Parameter,
    PerFlagellum,
    SceneFile,
    because,
    flagella_in_words,
    has_value,
    is_headless,
    of_each,
)

Handedness = Literal["left", "right"]
MOST_FLAGELLA, MOST_ON_A_HEAD = 64, 8

SHORTEST_LINK = 0.05
"""The least radius of a helix, in edges."""


def _coiled(file: SceneFile) -> bool:
    return file.robot.shape == "helix"


def _bent(file: SceneFile) -> bool:
    return file.robot.shape != "straight"


class RobotTable(Ingredient):
    """[robot] Shape of the robot, in metres.

    `n_flagella` is given for the kinds "branched" and "clamped". Flagella lie around the
    robot's axis, neighbours `separation` apart. `handedness`, `phase`, `helix_radius`, `pitch`
    and `axial_length` are one for all, or a list with one for each. The phase (rad) of a flagellum
    is the direction in which it leaves its axis, from y towards z: the same direction in space for
    all, so that flagella of one phase are copies of each other. The shape "arc" is pre-bent by
    the angle `bend` (rad), in the direction of its phase.
    """

    PARAMETERS: ClassVar[Mapping[str, Parameter]] = {
        "helix_radius": Parameter("helix_radius", "m", each=True, when=_coiled),
        "pitch": Parameter("pitch", "m", each=True, when=_coiled),
        "axial_length": Parameter("axial_length", "m", each=True),
        "rod_radius": Parameter("rod_radius", "m"),
        "head_radius": Parameter("head_radius", "m", when=lambda s: not is_headless(s)),
        "bend": Parameter("bend", "rad", when=lambda s: s.robot.shape == "arc"),
        "separation": Parameter("separation", "m", when=lambda s: s.robot.count > 1),
        "phase": Parameter("phase", "rad", each=True, when=_bent),
    }
    IDLE: ClassVar[tuple[Idle, ...]] = (
        Idle(
            ("helix_radius", "pitch", "handedness"),
            lambda s: not _coiled(s),
            has_value("robot", "shape"),
        ),
        Idle(("bend",), lambda s: s.robot.shape != "arc", has_value("robot", "shape")),
        Idle(("phase",), lambda s: not _bent(s), has_value("robot", "shape")),
        Idle(("separation",), lambda s: s.robot.count == 1, because("on a robot of 1 flagellum")),
        Idle(("head_radius",), is_headless, has_value("robot", "kind")),
        Idle(("clamped_tip",), lambda s: not is_headless(s), has_value("robot", "kind")),
    )

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
