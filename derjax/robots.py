"""The bodies of the robots: node positions and topology from a few dimensions.

Positions are smooth functions of the dimensions, so that a rollout can be differentiated
with respect to the shape; the number of nodes is fixed beforehand, on the host.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .rod import Topology, chain


class Body(NamedTuple):
    """A robot at rest: its node positions (n, 3) in m, and what is joined to what."""

    nodes: Float[Array, "n 3"]
    topology: Topology


def helix_contour(radius: Array, pitch: Array, axial_length: Array) -> Array:
    """Arc length (m) of a helix."""
    return axial_length / pitch * jnp.hypot(2.0 * jnp.pi * radius, pitch)


def helix(
    radius: Array, pitch: Array, axial_length: Array, n_edges: int, handedness: str
) -> Float[Array, "n 3"]:
    """`n_edges + 1` nodes (m), equally spaced on a helix about the x axis from (0, radius, 0)."""
    sign = {"left": -1.0, "right": 1.0}[handedness]
    phase = 2.0 * jnp.pi / pitch * axial_length * np.linspace(0.0, 1.0, n_edges + 1)
    x = axial_length * np.linspace(0.0, 1.0, n_edges + 1)
    return jnp.stack([x, radius * jnp.cos(phase), sign * radius * jnp.sin(phase)], axis=1)


def edge_count(radius: float, pitch: float, axial_length: float, edge_length: float) -> int:
    """Edges of a helix: as many of at least `edge_length` as fit, but three or more."""
    contour = axial_length / pitch * math.hypot(2.0 * math.pi * radius, pitch)
    return max(3, math.floor(contour / edge_length + 1e-9))


def single_flagellum(
    helix_radius: Array, pitch: Array, axial_length: Array, n_edges: int, handedness: str
) -> Body:
    """A head and one helical flagellum, as one rod along the x axis.

    Four nodes in line at -2 d, -d, 0 and d (d: length of the flagellum's edges) make the
    head and the shaft of the motor; a radial edge leads to the helix, which begins over the
    last of them. The head node is the first, and the motor sits at the third.
    """
    flagellum = helix(helix_radius, pitch, axial_length, n_edges, handedness)
    d = helix_contour(helix_radius, pitch, axial_length) / n_edges
    line = d * jnp.array([[-2.0, 0, 0], [-1.0, 0, 0], [0.0, 0, 0], [1.0, 0, 0]])
    nodes = jnp.concatenate([line, flagellum + line[-1]])
    topology = chain(
        len(nodes),
        filaments=(tuple(range(2, len(nodes))),),
        head_edge=0,
        motors=(1,),
    )
    return Body(nodes, topology)
