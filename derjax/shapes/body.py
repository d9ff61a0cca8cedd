"""What every robot is made of: its nodes and topology, and flagella set around an axis."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from ..rods.topology import Topology
from .numbers import library_of

Nodes = Float[Array, "n 3"]


class RobotGeometry(NamedTuple):
    """A robot at rest.

    Attributes:
        nodes: (n, 3) m.
        topology: what is joined to what.
        stiff_hinges: the hinges that hold a head of several arms in shape.
    """

    nodes: Nodes
    topology: Topology
    stiff_hinges: tuple[int, ...] = ()


def rotated_about_x(azimuth: Array | float, nodes: Nodes) -> Nodes:
    """`nodes` turned about the x axis by an angle (rad)."""
    xp = library_of(azimuth, nodes)
    c, s = xp.cos(azimuth), xp.sin(azimuth)
    x, y, z = nodes.T
    return xp.stack([x, c * y - s * z, s * y + c * z], axis=1)


def places_around_axis(n_flagella: int, separation: Array) -> Float[Array, "k 3"]:
    """Where (m) the axes of flagella lie around the x axis, neighbours `separation` apart.

    Flagella are set there without being turned, so that a phase is the same direction in space for
    each of them.
    """
    if n_flagella == 1:
        return separation * np.zeros((1, 3))
    radius = separation / (2.0 * np.sin(np.pi / n_flagella))
    azimuth = 2.0 * np.pi * np.arange(n_flagella) / n_flagella
    return radius * np.stack([0.0 * azimuth, np.cos(azimuth), np.sin(azimuth)], axis=1)


def on_shaft(filament: Nodes, edge: Array, backwards: int) -> Nodes:
    """`filament` on its shaft: nodes in line behind it, `edge` (m) apart, along the x axis.

    The shaft ends at (edge, 0, 0), after the motor at the origin and `backwards` more nodes.
    """
    xp = library_of(filament, edge)
    steps = np.arange(-backwards, 2, dtype=float)
    line = xp.stack([steps * edge, 0.0 * steps, 0.0 * steps], axis=1)
    return xp.concatenate([line, filament + line[-1]])
