"""[nondimensional]: groups in place of the keys that follow from them.

Units are the axial length l of the first flagellum, the time mu l^4 / EI in which it relaxes, and
the force EI / l^2 (see `groups`). So `axial_length`, `youngs_modulus` and `viscosity` say how
large, how stiff and how slow everything is, and the groups say what it is.
"""

import math
from collections.abc import Mapping
from typing import Any

from ..io.fields import Finite, Positive, Table
from .ingredients import FluidTable, MaterialTable, RobotTable

TABLE = "nondimensional"

KEYS = {
    "rod_radius_over_length": ("robot", "rod_radius"),
    "helix_radius_over_length": ("robot", "helix_radius"),
    "pitch_over_radius": ("robot", "pitch"),
    "separation_over_length": ("robot", "separation"),
    "head_radius_over_length": ("robot", "head_radius"),
    "regularization_over_rod_radius": ("fluid", "regularization"),
    "omega_bar": ("motor", "rpm"),
}
"""Which key each group stands for."""

INSTEAD_OF_A_RATE = ("table", "stall_torque", "free_rpm")


class GroupsTable(Table):
    """[nondimensional] Groups of a scene, each in place of one of its keys.

    `omega_bar` is the rate of the motors times mu l^4 / EI, with a sign; `pitch_over_radius` is
    pitch over helix radius. They are as `derjax simulate --nondimensional` prints them.
    """

    omega_bar: Finite | None = None
    pitch_over_radius: Positive | None = None
    helix_radius_over_length: Positive | None = None
    rod_radius_over_length: Positive | None = None
    separation_over_length: Positive | None = None
    head_radius_over_length: Positive | None = None
    regularization_over_rod_radius: Positive | None = None


def dimensional(content: Mapping[str, Any], groups: GroupsTable) -> dict[str, Any]:
    """The tables of a scene file, with the keys that follow from groups.

    Args:
        content: the other tables; what they leave out has its default.
        groups: those that are given.

    Raises:
        ValueError: a key is given as well as its group, or motors have no rate of their own.
    """
    tables = {name: dict(t) if isinstance(t, Mapping) else t for name, t in content.items()}
    given = {name: value for name, value in groups if value is not None}

    def number(table: str, key: str, default: Any) -> float:
        """Of a key, or of its first entry; the default where it is no number, which is said."""
        found = tables.get(table, {})
        value = found.get(key, default) if isinstance(found, Mapping) else default
        value = value[0] if isinstance(value, list | tuple) and value else value
        return float(value) if isinstance(value, int | float) and value > 0 else float(default)

    robot, usual = RobotTable.model_fields, MaterialTable.model_fields
    length = number("robot", "axial_length", robot["axial_length"].default)

    def put(name: str, value: float) -> None:
        table, key = KEYS[name]
        found = tables.setdefault(table, {})
        if isinstance(found, dict):
            if key in found:
                raise ValueError(
                    f"[{TABLE}] {name}: is given by [{table}] {key} as well; leave one of them out"
                )
            found[key] = value

    for name in given:
        if name.endswith("_over_length"):
            put(name, given[name] * length)
    if "pitch_over_radius" in given:
        radius = number("robot", "helix_radius", robot["helix_radius"].default)
        put("pitch_over_radius", given["pitch_over_radius"] * radius)
    rod = number("robot", "rod_radius", robot["rod_radius"].default)
    if "regularization_over_rod_radius" in given:
        put("regularization_over_rod_radius", given["regularization_over_rod_radius"] * rod)
    if "omega_bar" in given:
        motor = tables.get("motor", {})
        for key in INSTEAD_OF_A_RATE:
            if isinstance(motor, Mapping) and key in motor:
                raise ValueError(
                    f"[{TABLE}] omega_bar: is for motors of one constant rate; leave it or "
                    f"[motor] {key} out"
                )
        modulus = number("material", "youngs_modulus", usual["youngs_modulus"].default)
        viscosity = number("fluid", "viscosity", FluidTable.model_fields["viscosity"].default)
        time = viscosity * length**4 / (modulus * math.pi * rod**4 / 4)
        put("omega_bar", given["omega_bar"] / time * 60 / (2 * math.pi))
    return tables
