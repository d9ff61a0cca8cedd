"""[head]: the drag and mass of the robot's head."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import jax.numpy as jnp

from ...io.fields import NonNegative, Positive
from ...terms.fluid.head import HeadDrag
from ...terms.term import Term
from .ingredient import (
    Idle,
    Ingredient,
    Parameter,
    Setting,
    because,
    has_value,
    is_headless,
    is_weightless,
)


class HeadTable(Ingredient):
    """[head] Drag prefactors (dimensionless) and mass (kg; default: a ball of the material).

    `rotation` says which rotations of the head meet drag: its spin about its own axis only,
    as in the paper's model of one flagellum, or all ("full", the default for several flagella).
    `arm` = "published" has the rotational drag of kind "two_flagella" as the first author's code
    has it: a force on an end of the bar, as if that were a head radius away from the middle, so
    that the head feels (separation / 2 head_radius)^2 of C_r, 0.20 at the default lengths.
    `stiffness` is that of the arms of a head with several flagella, relative to the rod's.
    """

    PARAMETERS: ClassVar[Mapping[str, Parameter]] = {
        "C_t": Parameter("C_t", "1", when=lambda s: not is_headless(s)),
        "C_r": Parameter("C_r", "1", when=lambda s: not is_headless(s)),
    }
    IDLE: ClassVar[tuple[Idle, ...]] = (
        Idle(
            ("drag", "C_t", "C_r", "rotation", "stiffness", "mass"),
            is_headless,
            has_value("robot", "kind"),
        ),
        Idle(("mass",), is_weightless, because("without inertia and [gravity]")),
        Idle(
            ("C_t", "C_r", "rotation", "arm"),
            lambda s: s.head.drag == "none",
            has_value("head", "drag"),
        ),
        Idle(("arm",), lambda s: s.robot.kind != "two_flagella", has_value("robot", "kind")),
        Idle(
            ("stiffness",),
            lambda s: s.robot.count == 1,
            because("on a robot of 1 flagellum, whose head has no arms"),
        ),
    )

    drag: Literal["stokes", "none"] = "stokes"
    C_t: NonNegative = 4.8
    C_r: NonNegative = 0.36
    rotation: Literal["spin", "full"] | None = None
    arm: Literal["exact", "published"] = "exact"
    stiffness: Positive = 100.0
    mass: Positive | None = None

    def terms(self, setting: Setting) -> list[Term]:
        """The drag of a sphere, times the prefactors."""
        p = setting.numbers
        if setting.rod.topology.head is None or self.drag == "none":
            return []
        viscosity, radius = p["viscosity"], p["head_radius"]
        spin = 8 * jnp.pi * viscosity * radius**3 * p["C_r"]
        if self.arm == "published" and setting.file.robot.kind == "two_flagella":
            spin = spin * (0.5 * p["separation"] / radius) ** 2
        tilt = spin if setting.file.head_rotation == "full" else jnp.zeros(())
        return [HeadDrag(6 * jnp.pi * viscosity * radius * p["C_t"], spin, tilt, radius)]
