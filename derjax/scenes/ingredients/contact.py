"""[contact]: what keeps rods apart."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import jax.numpy as jnp
import numpy as np

from ...io.fields import Count, Positive
from ...terms.contact.repulsion import Contact
from ...terms.contact.spillmann_teschner import SpillmannTeschner
from ...terms.term import Term
from .ingredient import Idle, Ingredient, Parameter, SceneFile, Setting, contact_method
from .masses import inertial_mass


def _is_smooth(file: SceneFile) -> bool:
    return file.contact_method == "smooth"


def _mean(value: Any) -> Any:
    """Of a number of each flagellum, if there is one for each."""
    return value.mean() if np.ndim(value) else value


class ContactTable(Ingredient):
    """[contact] What keeps rods apart.

    "smooth" is the default for several flagella, "none" for one. `stiffness` in N/m: by
    default Young's modulus times the radius of the rod. `capacity`: how many pairs of edges may
    be close at one time; it grows as needed in `derjax simulate`.
    """

    PARAMETERS: ClassVar[Mapping[str, Parameter]] = {
        "stiffness": Parameter(
            "contact_stiffness",
            "N/m",
            when=_is_smooth,
            follows=lambda p: _mean(p["youngs_modulus"]) * p["rod_radius"],
        ),
    }
    IDLE: ClassVar[tuple[Idle, ...]] = (
        Idle(("stiffness", "capacity"), lambda s: not _is_smooth(s), contact_method),
    )

    method: Literal["smooth", "spillmann_teschner", "none"] | None = None
    stiffness: Positive | None = None
    capacity: Count | None = None

    def terms(self, setting: Setting) -> list[Term]:
        """The repulsion of rods that touch."""
        if setting.pairs is None:
            return []
        p, topology = setting.numbers, setting.rod.topology
        if _is_smooth(setting.file):
            capacity = min(self.capacity or 3 * topology.n_edges // 2, len(setting.pairs.array))
            return [Contact(p["contact_stiffness"], p["rod_radius"], setting.pairs, capacity)]
        mass = inertial_mass(setting)
        of_nodes = mass[: 3 * topology.n_nodes : 3]
        push = jnp.zeros_like(mass)
        return [SpillmannTeschner(p["rod_radius"], of_nodes, push, setting.pairs)]
