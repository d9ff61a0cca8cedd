"""Numbers that only make sense in another unit.

Robots come in all sizes, from bacteria to arms of metres, so that no number is wrong by itself.
What tells a wrong unit are ratios: to the robot's other lengths, to the density of the fluid, of
viscous to elastic forces. A number is refused only if it is off by far and would fit in the unit
that was meant.
"""

import math
from collections.abc import Collection, Mapping
from statistics import median_low

FAR = 100.0
"""How many times too large or too small a number must be to be refused."""

MILLI, KILO, MEGA = 1e-3, 1e3, 1e6

MOST_BENDING = 1e6
"""Viscous over elastic forces, mu omega L^4 / (E I), beyond which a modulus is in doubt."""

STIFFEST = 1.2e12
"""Young's modulus of diamond, Pa: no modulus that was meant is larger."""

MOST_TWIST = 1e4
"""rad, by which the stall torque of a motor twists its flagellum from end to end: beyond that it is
in doubt. Those of flagellated bacteria twist theirs by a few, a strong motor a soft one by 1e3."""

WATER = 1000.0
"""Density of the fluid that stands in for one without density, kg/m^3."""

USUAL_LENGTHS = {
    "helix_radius": 6.4e-3,
    "pitch": 44.5e-3,
    "axial_length": 95.4e-3,
    "rod_radius": 1.6e-3,
    "edge_length": 5.0e-3,
    "head_radius": 31.0e-3,
    "separation": 28.0e-3,
}
"""Lengths of a robot that go together, m: those of the default one."""


def check_lengths(lengths: Mapping[str, float], given: Collection[str]) -> None:
    """Refuses lengths that are in millimetres.

    A length that is given is compared with those that are not given, or with all others if there
    are none, each over its usual value. It is in millimetres if it is more than `FAR` times the
    median of these, and a thousandth of it is not.

    Args:
        lengths: m, by the keys of `USUAL_LENGTHS`; those that matter for the robot.
        given: which of them the user gave.

    Raises:
        ValueError: the message begins with the key, as is usual within a table.
    """
    sizes = {key: length / USUAL_LENGTHS[key] for key, length in lengths.items()}
    slips = []
    for key in lengths.keys() & set(given):
        others = [sizes[k] for k in sizes if k not in given]
        others = others or [size for k, size in sizes.items() if k != key]
        excess = sizes[key] / median_low(others)
        if FAR < excess < FAR / MILLI:
            slips.append(key)
    if slips:
        first, *more = sorted(slips, key=list(lengths).index)
        too = f" So for {', '.join(more)}" if more else ""
        raise ValueError(
            f"{first} = {lengths[first]:g}: lengths are in metres; "
            f"did you mean {lengths[first] * MILLI:.6g}?{too}"
        )


def check_angle(key: str, angle: float) -> None:
    """Refuses an angle (rad) of more than a turn, which is in degrees.

    Raises:
        ValueError: the message begins with the key, as is usual within a table.
    """
    if abs(angle) > 2 * math.pi * (1 + 1e-9):
        raise ValueError(
            f"{key} = {angle:g}: {key} is in rad; did you mean {math.radians(angle):.6g}?"
        )


def check_regularization(regularization: float, rod_radius: float) -> None:
    """Refuses a regularization (m) of a rod that is in millimetres.

    Raises:
        ValueError: the message begins with table and key.
    """
    if FAR < regularization / rod_radius < FAR / MILLI:
        raise ValueError(
            f"[fluid] regularization = {regularization:g}: lengths are in metres; "
            f"did you mean {regularization * MILLI:.6g}?"
        )


def check_density(density: float, fluid_density: float) -> None:
    """Refuses a density (kg/m^3) that is in g/cm^3, against that of the fluid, or of water.

    Raises:
        ValueError: the message begins with table and key.
    """
    ratio = density / (fluid_density or WATER)
    if 1 / (FAR * KILO) < ratio < 1 / FAR:
        raise ValueError(
            f"[material] density = {density:g}: densities are in kg/m^3; "
            f"did you mean {density * KILO:.6g}?"
        )


def check_modulus(
    modulus: float, rod_radius: float, length: float, viscosity: float, rate: float
) -> None:
    """Refuses Young's modulus (Pa) of a flagellum that is in MPa.

    Args:
        modulus: Pa.
        rod_radius: m.
        length: m, of the flagellum.
        viscosity: Pa s.
        rate: rad/s, of the fastest motor.

    Raises:
        ValueError: the message begins with table and key.
    """
    bending = modulus * math.pi * rod_radius**4 / 4
    excess = viscosity * rate * length**4 / bending / MOST_BENDING
    if 1 < excess < MEGA and modulus * MEGA <= STIFFEST:
        raise ValueError(
            f"[material] youngs_modulus = {modulus:g}: moduli are in pascals; "
            f"did you mean {modulus * MEGA:.6g}?"
        )


def check_torque(torque: float, twist: float) -> None:
    """Refuses a stall torque (N m) that is in mN m.

    Args:
        torque: N m.
        twist: rad, of the flagellum from end to end under that torque.

    Raises:
        ValueError: the message begins with table and key.
    """
    if twist > MOST_TWIST:
        raise ValueError(
            f"[motor] stall_torque = {torque:g}: it would twist a flagellum by "
            f"{twist / (2 * math.pi):.3g} turns; torques are in N m; "
            f"did you mean {torque * MILLI:.6g}?"
        )
