"""[material]: what the flagella are made of, and the elastic forces of rods."""

from collections.abc import Mapping
from typing import Annotated, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from pydantic import Field

from ...io.fields import Finite, Positive
from ...rods.topology import Topology
from ...terms.elastic.bend import Bend
from ...terms.elastic.stretch import Stretch
from ...terms.elastic.twist import Twist
from ...terms.term import Term
from .ingredient import (
    Idle,
    Ingredient,
    Parameter,
    PerFlagellum,
    Setting,
    because,
    is_weightless,
)


class MaterialTable(Ingredient):
    """[material] The flagellum: Young's modulus in Pa, density in kg/m^3."""

    PARAMETERS: ClassVar[Mapping[str, Parameter]] = {
        "youngs_modulus": Parameter("youngs_modulus", "Pa", each=True),
        "poisson_ratio": Parameter("poisson_ratio", "1"),
        "density": Parameter("density", "kg/m^3"),
    }
    IDLE: ClassVar[tuple[Idle, ...]] = (
        Idle(("density",), is_weightless, because("without inertia and [gravity]")),
    )

    youngs_modulus: PerFlagellum = 1.255e6
    poisson_ratio: Annotated[Finite, Field(gt=-1, le=0.5)] = 0.5
    density: Positive = 1260.0

    def terms(self, setting: Setting) -> list[Term]:
        """Stretching, bending and twisting of the whole robot, the arms of its head included."""
        p, topology = setting.numbers, setting.rod.topology
        radius, modulus = p["rod_radius"], p["youngs_modulus"]
        area, inertia = jnp.pi * radius**2, jnp.pi * radius**4 / 4
        relative = np.ones(len(topology.hinges))
        relative[list(setting.geometry.stiff_hinges)] = setting.file.head.stiffness
        of_hinges = _of_hinges(topology, modulus)
        shear = of_hinges / (2 * (1 + p["poisson_ratio"]))
        return [
            Stretch(jnp.broadcast_to(_of_edges(topology, modulus) * area, topology.n_edges)),
            Bend(of_hinges * inertia * relative),
            Twist(2 * shear * inertia * relative),
        ]


def _of_edges(topology: Topology, each: Array) -> Array:
    """A number of each flagellum as one of each edge; that of the head's edges is the mean."""
    if each.ndim == 0:
        return each
    flagellum = topology.edge_filaments
    return jnp.where(flagellum >= 0, each[flagellum], jnp.mean(each))


def _of_hinges(topology: Topology, each: Array) -> Array:
    """A number of each flagellum as one of each hinge, that of those of its edges."""
    if each.ndim == 0:
        return each
    inside = (topology.edge_filaments >= 0)[topology.hinge_edges].astype(float)
    inside[inside.sum(axis=1) == 0] = 1.0
    weight = inside / inside.sum(axis=1, keepdims=True)
    return jnp.sum(weight * _of_edges(topology, each)[topology.hinge_edges], axis=1)
