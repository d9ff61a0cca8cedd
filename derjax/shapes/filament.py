"""Filaments: (n, 3) nodes in m, in a frame in which the motor's shaft ends at the origin.

The shaft points along x. The origin itself is not among the nodes: it belongs to the shaft.
"""

import math

import numpy as np
from jaxtyping import Array, Float

from .numbers import library_of


def helix_contour(radius: Array, pitch: Array, axial_length: Array) -> Array:
    """Arc length (m) of a helix."""
    xp = library_of(radius, pitch, axial_length)
    return axial_length / pitch * xp.hypot(2.0 * xp.pi * radius, pitch)


def helix(
    radius: Array, pitch: Array, axial_length: Array, n_edges: int, handedness: str
) -> Float[Array, "n 3"]:
    """`n_edges + 1` nodes (m), equally spaced on a helix about the x axis from (0, radius, 0)."""
    xp = library_of(radius, pitch, axial_length)
    sign = {"left": -1.0, "right": 1.0}[handedness]
    phase = 2.0 * xp.pi / pitch * axial_length * np.linspace(0.0, 1.0, n_edges + 1)
    x = axial_length * np.linspace(0.0, 1.0, n_edges + 1)
    return xp.stack([x, radius * xp.cos(phase), sign * radius * xp.sin(phase)], axis=1)


def arc(length: Array, bend: Array, n_edges: int) -> Float[Array, "n 3"]:
    """`n_edges` nodes (m) on an arc in the x-y plane that turns by `bend` (rad) in all.

    A polygon of equal edges; `bend = 0` is straight.
    """
    xp = library_of(length, bend)
    angle = bend * (np.arange(n_edges) + 0.5) / n_edges
    edges = xp.stack([xp.cos(angle), xp.sin(angle), xp.zeros(n_edges)], axis=1)
    return xp.cumsum(length / n_edges * edges, axis=0)


def edge_count(radius: float, pitch: float, axial_length: float, edge_length: float) -> int:
    """Edges of a helix: as many of at least `edge_length` as fit, but three or more."""
    contour = axial_length / pitch * math.hypot(2.0 * math.pi * radius, pitch)
    return max(3, math.floor(contour / edge_length + 1e-9))
