"""Two slender elastic filaments that turn alike beside each other: a local model of how they wind.

Each turns about its own axis and carries the other with its flow, which bending resists. With rho
the vector from the middle to one of them in units of its value at the clamp, s the place along it
in units of its length L, and time in units of zeta L^4 / B,

    rho_t = Bu e_z x rho / (|rho|^2 + c^2) - rho_ssss,
    rho(0) = (1, 0), rho_s(0) = 0, free at s = 1,
    Bu = 8 pi mu w a^2 L^4 / (M B h^2),  M = ln(h / 2 r_0),

for helices of radius a, of rods of radius r_0 and bending stiffness B, a distance h apart, that
turn at w in a fluid of viscosity mu. Without the core c, which is small, they could pass through
each other at infinite speed. For a small Bu the tips turn by Bu / 8. From some Bu on they cross,
which is half a turn, and from a much larger one on they wrap around each other.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.integrate import solve_ivp

NODES = 48
CORE = 0.05
SETTLED = 4.0
"""Time at which the slowest motion of a clamped filament has decayed by exp(-12.4 SETTLED)."""


class Filaments(NamedTuple):
    """Two helices on motors; SI units.

    Attributes:
        length: m, along their axes.
        radius: m, of the helices.
        rod_radius: m.
        separation: m, of their axes.
        youngs_modulus: Pa.
        viscosity: Pa s.
    """

    length: float
    radius: float
    rod_radius: float
    separation: float
    youngs_modulus: float
    viscosity: float

    def number(self, rate: float) -> float:
        """Bu, at which they turn at `rate` (rad/s)."""
        stiffness = self.youngs_modulus * np.pi / 4 * self.rod_radius**4
        drive = 8 * np.pi * self.viscosity * rate * self.radius**2 * self.length**4
        return (
            drive
            / (np.log(self.separation / (2 * self.rod_radius)) * stiffness)
            / (self.separation**2)
        )


def fourth_derivative(nodes: int = NODES) -> tuple[np.ndarray, np.ndarray]:
    """(n, n) fourth derivative at nodes 1 to n of a filament, and (n,) by its clamped value."""
    full = np.zeros((nodes, nodes + 5))  # of nodes -1 to n + 2, with one to spare
    for row in range(nodes):
        full[row, row : row + 5] = 1.0, -4.0, 6.0, -4.0, 1.0
    matrix, end = full[:, 2 : nodes + 2].copy(), nodes - 1
    matrix[:, 0] += full[:, 0]  # no slope at the clamp: node -1 is as node 1
    matrix[:, end] += 2 * full[:, nodes + 2] + 4 * full[:, nodes + 3]  # no moment, no force
    matrix[:, end - 1] += -full[:, nodes + 2] - 4 * full[:, nodes + 3]
    matrix[:, end - 2] += full[:, nodes + 3]
    return matrix * nodes**4, full[:, 1] * nodes**4


def turned(number: float, end: float = SETTLED, nodes: int = NODES) -> Float[np.ndarray, " t"]:
    """rad, by which the tips have turned about each other, at 400 times up to `end`."""
    matrix, clamped = fourth_derivative(nodes)

    def change(_: float, packed: np.ndarray) -> np.ndarray:
        x, y = packed.reshape(2, -1)
        square = x**2 + y**2 + CORE**2
        return np.concatenate(
            [
                -number * y / square - matrix @ x - clamped,
                number * x / square - matrix @ y,
            ]
        )

    def slope(_: float, packed: np.ndarray) -> np.ndarray:
        x, y = packed.reshape(2, -1)
        square = x**2 + y**2 + CORE**2
        mixed = np.diag(2 * number * x * y / square**2)
        by_x = np.diag(number * (1 / square - 2 * x**2 / square**2))
        by_y = np.diag(-number * (1 / square - 2 * y**2 / square**2))
        return np.block([[mixed - matrix, by_y], [by_x, -mixed - matrix]])

    start = np.concatenate([np.ones(nodes), np.zeros(nodes)])
    times = np.linspace(0.0, end, 400)
    found = solve_ivp(change, (0.0, end), start, "BDF", times, jac=slope, rtol=1e-5, atol=1e-7)
    if not found.success:
        raise RuntimeError(f"Bu = {number:g}: {found.message}")
    x, y = found.y[nodes - 1], found.y[-1]
    return np.unwrap(np.arctan2(y, x))
