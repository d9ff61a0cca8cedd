"""The parameters of a scene: numbers that it can be differentiated with respect to."""

import re

PLACES = {
    "helix_radius": "robot.helix_radius",
    "pitch": "robot.pitch",
    "axial_length": "robot.axial_length",
    "rod_radius": "robot.rod_radius",
    "head_radius": "robot.head_radius",
    "bend": "robot.bend",
    "separation": "robot.separation",
    "youngs_modulus": "material.youngs_modulus",
    "poisson_ratio": "material.poisson_ratio",
    "density": "material.density",
    "viscosity": "fluid.viscosity",
    "fluid_density": "fluid.fluid_density",
    "regularization": "fluid.regularization",
    "C_t": "head.C_t",
    "C_r": "head.C_r",
    "rpm": "motor.rpm",
    "contact_stiffness": "contact.stiffness",
    "friction": "friction.coefficient",
}
"""Where each parameter stands in a scene file: table and key."""


EACH = ("helix_radius", "pitch", "axial_length", "youngs_modulus", "rpm")
"""Parameters that may have a value for each flagellum or motor: `pitch[1]` is the second one's."""


def index_of(parameter: str) -> tuple[str, int | None]:
    """The name of a parameter without its index, and the index; None if it has none."""
    found = re.fullmatch(r"(.*)\[(\d+)\]", parameter)
    return (parameter, None) if found is None else (found[1], int(found[2]))


def place_of(parameter: str) -> tuple[str, str]:
    """Table and key of a parameter; those of extensions are named by both."""
    name, _ = index_of(parameter)
    table, _, key = PLACES.get(name, name).partition(".")
    return table, key


UNITS = {
    "helix_radius": "m",
    "pitch": "m",
    "axial_length": "m",
    "rod_radius": "m",
    "head_radius": "m",
    "bend": "rad",
    "separation": "m",
    "youngs_modulus": "Pa",
    "poisson_ratio": "1",
    "density": "kg/m^3",
    "viscosity": "Pa s",
    "fluid_density": "kg/m^3",
    "regularization": "m",
    "C_t": "1",
    "C_r": "1",
    "rpm": "rpm",
    "contact_stiffness": "N/m",
    "friction": "1",
}
"""Their units."""
