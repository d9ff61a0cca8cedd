"""[fluid]: the liquid around the robot, and its drag on the flagella."""

from collections.abc import Mapping
from typing import ClassVar, Literal, Self

import jax.numpy as jnp
from pydantic import model_validator

from ...io.fields import NonNegative, Positive, Switch
from ...terms.fluid.block_stokeslets import BlockStokeslets
from ...terms.fluid.explicit import ExplicitDrag
from ...terms.fluid.resistive import ResistiveDrag, gray_hancock, lighthill
from ...terms.fluid.spin import SpinDrag
from ...terms.fluid.stokeslets import StokesletSegments
from ...terms.term import Term
from .ingredient import (
    Idle,
    Ingredient,
    Parameter,
    SceneFile,
    Setting,
    because,
    has_value,
    is_headless,
)

REGULARIZATION = 1.67 / 1.6
"""Regularization of Stokeslet segments, in rod radii; see "The regularization" in the equations."""

FINEST = 3.5
"""The most that the regularization may be, in edges: with more the flow problem, an equation of
the first kind, has forces at the ends of a flagellum that alternate and grow, and drag that does
work."""

FINEST_IN_BLOCKS = 1.7
"""The same for robots in blocks, each of which is an equation of that kind."""

LAWS = {"gray_hancock": gray_hancock, "lighthill": lighthill}
"""The resistive force theories by their names in scene files."""


def _nothing_is_dragged(file: SceneFile) -> bool:
    headless = is_headless(file) or file.head.drag == "none"
    return file.fluid.hydrodynamics == "none" and headless


class FluidTable(Ingredient):
    """[fluid] Viscosity in Pa s, density in kg/m^3, and the drag on the flagella.

    The regularization (m) is by default 1.04 rod radii (`REGULARIZATION`): the paper's
    table prints a tenth of that, which contradicts the buckling thresholds of the same paper.
    `spin_drag` says whether rods that spin about their own axis meet drag, which they do not in
    the paper's model.
    """

    PARAMETERS: ClassVar[Mapping[str, Parameter]] = {
        "viscosity": Parameter("viscosity", "Pa s"),
        "fluid_density": Parameter("fluid_density", "kg/m^3"),
        "regularization": Parameter(
            "regularization", "m", follows=lambda p: REGULARIZATION * p["rod_radius"]
        ),
    }
    IDLE: ClassVar[tuple[Idle, ...]] = (
        Idle(("fluid_density",), lambda s: s.gravity is None, because("without [gravity]")),
        Idle(("viscosity",), _nothing_is_dragged, because("where nothing is dragged")),
        Idle(
            ("regularization", "end_nodes", "drag_matrix", "head_nodes"),
            lambda s: s.fluid.hydrodynamics != "rss",
            has_value("fluid", "hydrodynamics"),
        ),
        Idle(
            ("resistive",),
            lambda s: s.fluid.hydrodynamics != "rft",
            has_value("fluid", "hydrodynamics"),
        ),
        Idle(
            ("spin_drag",),
            lambda s: s.fluid.hydrodynamics == "none",
            has_value("fluid", "hydrodynamics"),
        ),
    )

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

    def terms(self, setting: Setting) -> list[Term]:
        """The drag on the flagella, and on their spin."""
        terms: list[Term] = []
        if self.hydrodynamics != "none":
            drag = _stokeslets(setting) if self.hydrodynamics == "rss" else _resistive(setting)
            explicit = setting.file.time.scheme == "explicit"
            terms.append(ExplicitDrag(drag) if explicit else drag)
        if self.spin_drag:
            p = setting.numbers
            terms.append(SpinDrag(4 * jnp.pi * p["viscosity"] * p["rod_radius"] ** 2))
        return terms


def _stokeslets(setting: Setting) -> StokesletSegments | BlockStokeslets:
    file, p, topology = setting.file, setting.numbers, setting.rod.topology
    if setting.layout is not None:
        viscosity, regularization = p["viscosity"], p["regularization"]
        return BlockStokeslets(viscosity, regularization, setting.layout, file.fluid.end_nodes)
    filaments = solved = topology.filaments
    if file.head_nodes == "dropped":
        solved = (tuple(range(topology.n_nodes)),)
    return StokesletSegments(
        viscosity=p["viscosity"],
        regularization=p["regularization"],
        solved=solved,
        dragged=tuple(node for path in filaments for node in path),
        end_nodes=file.fluid.end_nodes,
        drag_matrix=file.fluid.drag_matrix,
    )


def _resistive(setting: Setting) -> ResistiveDrag:
    file, p = setting.file, setting.numbers
    if file.robot.shape == "helix":
        pitch, radius = p["pitch"], p["helix_radius"]
    else:  # no turns: the filament's length stands in for their pitch
        pitch, radius = p["axial_length"], jnp.zeros(())
    return ResistiveDrag(
        *LAWS[file.fluid.resistive](p["viscosity"], pitch, p["rod_radius"], radius)
    )
