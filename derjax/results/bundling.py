"""How close the flagella of a robot come, and how they wind about each other."""

from functools import partial
from itertools import combinations, pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.programs import stored
from ..rods.topology import Topology
from ..rods.vectors import cross, dot
from ..terms.contact.neighbours import closest
from ..terms.contact.repulsion import Contact, ContactLaw, force, meeting
from ..terms.contact.segments import distance

NEAR = 2.0
"""Diameters, from centre line to centre line, within which a flagellum is bundled with another:
there is room for less than one more rod in between."""


class Closeness(NamedTuple):
    """Of the flagella of a robot at a time.

    Attributes:
        minimum_distance: m, between the centre lines of different flagella.
        bundle_fraction: the part of all their edges that are bundled with another flagellum.
        linking_number: Gauss' integral over the open centre lines, summed over all pairs of
            flagella: how often they wind about each other, right-handed turns counting
            positive. Not a whole number.
    """

    minimum_distance: Float[Array, "*t"]
    bundle_fraction: Float[Array, "*t"]
    linking_number: Float[Array, "*t"]


@partial(stored, static=(0,))
def closeness(topology: Topology, nodes: Float[Array, "t n 3"], diameter: Array) -> Closeness:
    """Of robots with two flagella or more whose nodes are at `nodes` (m)."""
    filaments = [list(pairwise(path)) for path in topology.filaments]
    edges = np.array([edge for filament in filaments for edge in filament])
    owner = np.repeat(np.arange(len(filaments)), [len(filament) for filament in filaments])
    every = np.array([p for p in combinations(range(len(edges)), 2) if owner[p[0]] != owner[p[1]]])
    first, second = every.T
    pairs = np.concatenate([edges[first], edges[second]], axis=1)

    def at_one_time(x: Float[Array, "n 3"]) -> Closeness:
        pair = x[pairs]
        d = distance(pair)
        nearest = jnp.full(len(edges), jnp.inf).at[first].min(d).at[second].min(d)
        bundled = jnp.mean(nearest < NEAR * diameter)
        return Closeness(jnp.min(d), bundled, jnp.sum(winding(pair)))

    return jax.lax.map(at_one_time, nodes)


def winding(pair: Float[Array, "*b 4 3"]) -> Float[Array, "*b"]:
    """Gauss' integral over two segments.

    The solid angle of the quadrangle of directions from one to the other, over 4 pi (Klenin &
    Langowski, Biopolymers 54, 307, 2000).
    """
    a, b, c, d = (pair[..., i, :] for i in range(4))
    corners = (c - a, d - a, d - b, c - b)
    normals = [_unit_or_zero(cross(corners[i - 1], corners[i])) for i in range(4)]
    angles = [jnp.arcsin(jnp.clip(dot(normals[i - 1], normals[i]), -1.0, 1.0)) for i in range(4)]
    return jnp.sign(dot(cross(d - c, b - a), c - a)) * sum(angles) / (4.0 * jnp.pi)


@partial(stored, static=(1,))
def contact_forces(
    contact: Contact, topology: Topology, nodes: Float[Array, "t n 3"]
) -> Float[Array, "t k"]:
    """Forces (N) by which the pairs of edges that touch repel each other, in no order.

    Zero in places that no pair takes.
    """
    touch = ContactLaw(contact.stiffness, 2.0 * contact.radius)

    def at_one_time(x: Float[Array, "n 3"]) -> Float[Array, " k"]:
        edges, found = closest(topology, x, contact.pairs, touch.diameter, contact.capacity)
        pairs = x[jnp.asarray(topology.edge_nodes)[edges].reshape(-1, 4)]
        _, d = jax.vmap(meeting, (0, None))(pairs.reshape(-1, 12), touch.diameter)
        return jnp.where(jnp.arange(contact.capacity) < found, force(d, touch), 0.0)

    return jax.lax.map(at_one_time, nodes)


def phases(topology: Topology, nodes: np.ndarray) -> Float[np.ndarray, "t k"]:
    """Angle (rad) by which each flagellum has turned about the x axis at its base.

    That of the edge which leads from the end of the shaft to the flagellum, counting turns.
    """
    bases = np.array([path[1:3] for path in topology.filaments])
    radial = nodes[:, bases[:, 1]] - nodes[:, bases[:, 0]]
    return np.unwrap(np.arctan2(radial[..., 2], radial[..., 1]), axis=0)


def _unit_or_zero(v: Array) -> Array:
    size = jnp.sqrt(dot(v, v))[..., None]
    return jnp.where(size > 0.0, v / jnp.where(size > 0.0, size, 1.0), 0.0)
