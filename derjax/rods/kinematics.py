"""Tangents, frames and strains of a rod, as functions of its nodes and angles."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .topology import Topology
from .vectors import any_normal, cross, dot, parallel_transport, signed_angle, unit


def positions(topology: Topology, q: Float[Array, "*batch d"]) -> Float[Array, "*batch n 3"]:
    """Node positions (m) in the packed vector `q`."""
    return q[..., : 3 * topology.n_nodes].reshape(*q.shape[:-1], topology.n_nodes, 3)


def angles(topology: Topology, q: Float[Array, "*batch d"]) -> Float[Array, "*batch e"]:
    """Edge angles (rad) in the packed vector `q`."""
    return q[..., 3 * topology.n_nodes :]


def tangents(topology: Topology, nodes: Float[Array, "n 3"]) -> Float[Array, "e 3"]:
    """Unit tangent of every edge."""
    start, end = topology.edge_nodes.T
    return unit(nodes[end] - nodes[start])


def _untwisting(topology: Topology) -> np.ndarray:
    """(e, b): turns reference twists into the edge rotations that remove them all.

    Walks the tree of hinges from the first edge of each connected part.
    """
    rotation = np.full((topology.n_edges, len(topology.hinges)), np.nan)
    neighbours: dict[int, list[tuple[int, int]]] = {e: [] for e in range(topology.n_edges)}
    for hinge, (first, second) in enumerate(topology.hinges):
        neighbours[first].append((hinge, second))
        neighbours[second].append((hinge, first))
    for root in range(topology.n_edges):
        if not np.isnan(rotation[root]).any():
            continue
        rotation[root] = 0.0
        pending = [root]
        while pending:
            known = pending.pop()
            for hinge, new in neighbours[known]:
                if not np.isnan(rotation[new]).any():
                    continue
                s0, s1 = topology.hinge_signs[hinge]
                forward = topology.hinges[hinge][0] == known
                rotation[new] = s0 * s1 * rotation[known]
                rotation[new, hinge] += -s1 if forward else s0
                pending.append(new)
    return rotation


def space_parallel_directors(
    topology: Topology, tangent: Float[Array, "e 3"]
) -> Float[Array, "e 3"]:
    """A reference director for every edge, free of twist across every hinge.

    The director of the first edge of each connected part is an arbitrary normal.
    """
    director = any_normal(tangent)
    twist = hinge_reference_twist(topology, director, tangent, jnp.zeros(len(topology.hinges)))
    rotation = jnp.asarray(_untwisting(topology)) @ twist
    return material_directors(director, tangent, rotation)[0]


def curvature(
    t0: Float[Array, "*b 3"],
    t1: Float[Array, "*b 3"],
    m1: tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]],
    m2: tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]],
) -> Float[Array, "*b 2"]:
    """Integrated material curvature at a hinge (Bergou et al. 2008, eq. 1 and 2).

    The curvature binormal 2 t0 x t1 / (1 + t0 . t1), projected on the averages of the
    material directors of the two edges.
    """
    binormal = 2.0 * cross(t0, t1) / (1.0 + dot(t0, t1))[..., None]
    return 0.5 * jnp.stack([dot(binormal, m2[0] + m2[1]), -dot(binormal, m1[0] + m1[1])], axis=-1)


def reference_twist(
    d0: Float[Array, "*b 3"],
    d1: Float[Array, "*b 3"],
    t0: Float[Array, "*b 3"],
    t1: Float[Array, "*b 3"],
    previous: Float[Array, "*b"],
) -> Float[Array, "*b"]:
    """Angle (rad) from the director `d0` transported along the hinge to the director `d1`.

    Chosen within half a turn of `previous`, so that it goes on counting past +-pi.
    """
    angle = signed_angle(parallel_transport(d0, t0, t1), d1, t1)
    return previous + jnp.arctan2(jnp.sin(angle - previous), jnp.cos(angle - previous))


def hinge_tangents(
    topology: Topology, tangent: Float[Array, "e 3"]
) -> tuple[Float[Array, "b 3"], Float[Array, "b 3"]]:
    """Tangents of the two edges of every hinge, pointing along the hinge."""
    first, second = topology.hinge_edges.T
    signs = jnp.asarray(topology.hinge_signs)
    return signs[:, :1] * tangent[first], signs[:, 1:] * tangent[second]


def hinge_reference_twist(
    topology: Topology,
    director: Float[Array, "e 3"],
    tangent: Float[Array, "e 3"],
    previous: Float[Array, " b"],
) -> Float[Array, " b"]:
    """Reference twist (rad) of every hinge; see `reference_twist`."""
    first, second = topology.hinge_edges.T
    t0, t1 = hinge_tangents(topology, tangent)
    return reference_twist(director[first], director[second], t0, t1, previous)


def material_directors(
    director: Float[Array, "*e 3"], tangent: Float[Array, "*e 3"], theta: Float[Array, "*e"]
) -> tuple[Float[Array, "*e 3"], Float[Array, "*e 3"]]:
    """The reference frame turned by the edge angle `theta` (rad) about the tangent."""
    c, s = jnp.cos(theta)[..., None], jnp.sin(theta)[..., None]
    second = cross(tangent, director)
    return c * director + s * second, c * second - s * director


def hinge_lengths(topology: Topology, length: Float[Array, " e"]) -> Float[Array, " b"]:
    """The length of rod (m) that bends and twists at each hinge: half of its edges (m).

    An edge that is held is part of what holds it. A hinge between two of them cannot bend.
    """
    bends = np.where(topology.held_edges, 0.0, 1.0)[topology.hinge_edges]
    bends[~bends.any(axis=1)] = 1.0
    return 0.5 * jnp.sum(bends * length[topology.hinge_edges], axis=1)
