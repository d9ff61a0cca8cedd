"""[time]: how the run is divided into steps and frames, by which scheme, and inertia."""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from pydantic import Field, model_validator

from ...integrate.schemes.contact_corrected import contact_corrected_euler
from ...integrate.schemes.euler import euler
from ...integrate.schemes.trbdf2 import trbdf2
from ...integrate.step import Scene, Step
from ...integrate.step_size import StepSizeController
from ...io.fields import Positive, Switch
from ...rods.rod import State
from ...terms.inertia import Inertia
from ...terms.term import Term
from .ingredient import Idle, Ingredient, SceneFile, Setting, contact_method, has_value
from .masses import inertial_mass

SHORTEST = 1e-6
"""The shortest that steps that adapt may become, over the first."""

TOLERANCES = {"euler": 2e-3, "trbdf2": 1e-4}
"""Of steps that adapt, unless another one is given: some 0.3 and 0.1 % in speed and head rate."""


def _is_corrected(file: SceneFile) -> bool:
    """Whether rods are pushed apart after each step, which is a scheme of its own."""
    return file.contact_method == "spillmann_teschner"


class TimeTable(Ingredient):
    """[time] Step, end and interval of saved frames (s), and the scheme.

    `step` and `frame` are by default chosen by the motors' rates (`SceneFile.grid`).
    With a `tolerance`, or with neither that nor a `step`, steps adapt to the motion: the
    estimated error of each is at most that part of the radius of a circle as long as a flagellum.
    `step` is then that of the start. The schemes are "euler", implicit and of first order,
    "trbdf2", of second order, and "explicit", with the drag of the step before.
    """

    IDLE: ClassVar[tuple[Idle, ...]] = (
        Idle(("inertia",), lambda s: s.time.scheme == "explicit", has_value("time", "scheme")),
        Idle(
            ("tolerance",),
            _is_corrected,
            lambda s: f"{contact_method(s)}, whose steps do not adapt",
        ),
        Idle(
            ("scheme",),
            lambda s: _is_corrected(s) and s.time.scheme == "trbdf2",
            lambda s: f"{contact_method(s)}, whose steps are those of implicit Euler",
        ),
    )

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

    def terms(self, setting: Setting) -> list[Term]:
        """Inertia, without which explicit drag has nothing to act against."""
        if not (self.inertia or self.scheme == "explicit"):
            return []
        return [Inertia(inertial_mass(setting))]

    def stepping(self, setting: Setting) -> Callable[[Scene, State, Array], Step]:
        """How one step is taken."""
        if _is_corrected(setting.file):
            return contact_corrected_euler
        return {"trbdf2": trbdf2, "euler": euler, "explicit": euler}[self.scheme]

    def controller(self, setting: Setting) -> StepSizeController | None:
        """Errors are measured in the radius of a circle as long as a flagellum.

        Those of angles by how far they move the widest helix; if none is coiled, in rad.
        """
        if self.tolerance is None or _is_corrected(setting.file):
            return None
        rod, topology = setting.rod, setting.rod.topology
        contour = jnp.sum(rod.rest_length) / setting.file.robot.count / (2 * jnp.pi)
        radius = setting.numbers.get("helix_radius")
        turn = 1.0 if radius is None else contour / jnp.max(radius)
        position = np.arange(topology.n_dofs) < 3 * topology.n_nodes
        return StepSizeController(
            tolerance=jnp.asarray(self.tolerance),
            scale=jnp.where(position, contour, turn),
            shortest=jnp.asarray(SHORTEST * setting.file.step),
            order=1 if self.scheme == "euler" else 2,
            negligible=jnp.asarray(setting.file.solver.negligible),
        )
