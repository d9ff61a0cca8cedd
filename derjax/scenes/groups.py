"""Nondimensional groups: a robot in units of its own, and the same robot at another scale.

The units are those of Lim, Yadunandan & Jawed (Soft Matter 19, 2254, 2023): the axial length l of
the flagellum, the time mu l^4 / EI in which it relaxes, and the force EI / l^2. The rate of a motor
in them is the paper's omega_bar = omega mu l^4 / EI. Nothing that a scene of length, time and force
does depends on the units: two robots whose groups agree do the same.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from .file import SceneFile
from .ingredients import INGREDIENTS

DIMENSIONS: dict[str, tuple[int, int, int]] = {
    "1": (0, 0, 0),
    "rad": (0, 0, 0),
    "m": (1, 0, 0),
    "s": (0, 1, 0),
    "rpm": (0, -1, 0),
    "rad/s": (0, -1, 0),
    "m/s": (1, -1, 0),
    "m/s^2": (1, -2, 0),
    "N": (0, 0, 1),
    "N m": (1, 0, 1),
    "N/m": (-1, 0, 1),
    "Pa": (-2, 0, 1),
    "Pa s": (-2, 1, 1),
    "kg": (-1, 2, 1),
    "kg/m^3": (-4, 2, 1),
}
"""Powers of length, time and force."""

OTHER_UNITS = {
    "robot.edge_length": "m",
    "head.mass": "kg",
    "friction.slip_speed": "m/s",
    "gravity.acceleration": "m/s^2",
    "time.step": "s",
    "time.end": "s",
    "time.frame": "s",
}
"""Of keys that are numbers with units, and no parameters."""

REPORTED = {
    "v_x_m_per_s": ("v", "m/s"),
    "head_rate_rad_per_s": ("head_rate", "rad/s"),
    "tail_to_head_m": ("tail_to_head", "m"),
    "propulsive_force_N": ("propulsive_force", "N"),
    "propulsive_force_per_flagellum_N": ("propulsive_force_per_flagellum", "N"),
    "minimum_distance_m": ("minimum_distance", "m"),
    "contact_force_N": ("contact_force", "N"),
    "efficiency": ("efficiency", "1"),
    "bundle_fraction": ("bundle_fraction", "1"),
    "linking_number": ("linking_number", "1"),
}
"""Numbers of a summary, what they are called without units, and what unit they have."""


class Units(NamedTuple):
    """Of length (m), time (s) and force (N)."""

    length: float
    time: float
    force: float

    def of(self, unit: str) -> float:
        """How much a unit such as "N/m" of this system is in SI units.

        Raises:
            KeyError: a unit that is not in `DIMENSIONS`.
        """
        a, b, c = DIMENSIONS[unit]
        return self.length**a * self.time**b * self.force**c


def units_of(file: SceneFile) -> Units:
    """The units of a scene: those of its first flagellum.

    Args:
        file: a scene with a fluid.
    """
    length = file.robot.each("axial_length")[0]
    bending = file.moduli[0] * np.pi * file.robot.rod_radius**4 / 4
    return Units(length, file.fluid.viscosity * length**4 / bending, bending / length**2)


def groups(file: SceneFile) -> dict[str, float]:
    """What a scene is in its own units; the rate is that of the fastest motor."""
    units, robot = units_of(file), file.robot
    found = {"omega_bar": 2 * np.pi / 60 * file.fastest_rpm * units.time}
    if robot.shape == "helix":
        radius = robot.each("helix_radius")[0]
        found["pitch_over_radius"] = robot.each("pitch")[0] / radius
        found["helix_radius_over_length"] = radius / units.length
    found["rod_radius_over_length"] = robot.rod_radius / units.length
    if robot.count > 1:
        found["separation_over_length"] = robot.separation / units.length
    if robot.kind != "clamped":
        found["head_radius_over_length"] = robot.head_radius / units.length
    if file.fluid.hydrodynamics == "rss":
        found["regularization_over_rod_radius"] = file.regularization / robot.rod_radius
    return {name: float(value) for name, value in found.items()}


def nondimensional(file: SceneFile, summary: Mapping[str, Any]) -> dict[str, float]:
    """The groups of a scene, and the numbers of a summary of its run in its own units."""
    units, found = units_of(file), groups(file)
    for name, (short, unit) in REPORTED.items():
        if summary.get(name) is not None:
            found[short] = summary[name] / units.of(unit)
    return found


def rescaled(file: SceneFile, length: float, time: float, force: float) -> SceneFile:
    """The same robot at another scale: nondimensional numbers stay as they are.

    Args:
        file: a scene without a table of the motor and without ingredients of other packages.
        length: by which lengths are multiplied.
        time: by which times are multiplied.
        force: by which forces are multiplied.

    Raises:
        ValueError: a motor's table or another package's ingredient, whose units are not known.
        InputError: numbers that cannot be, as too short an end.
    """
    if file.motor_table is not None or file.extensions:
        raise ValueError("a motor's table, or another package's ingredient, cannot be rescaled")
    units = dict(OTHER_UNITS)
    for table, kind in INGREDIENTS.items():
        units |= {f"{table}.{key}": p.unit for key, p in kind.PARAMETERS.items()}
    content = file.model_dump(mode="json", exclude_none=True)
    scale = Units(length, time, force)
    for place, unit in units.items():
        table, key = place.split(".")
        if key in content.get(table, {}):
            value = scale.of(unit) * np.asarray(content[table][key], float)
            content[table][key] = value.tolist()
    return SceneFile.from_dict(content)
