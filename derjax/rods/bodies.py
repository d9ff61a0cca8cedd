"""How parts of a rod turn as if they were rigid: filaments, and what joins them."""

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .topology import Topology
from .vectors import cross, dot

SLENDER = 1e-6
"""Of its moment of inertia, about every axis: a straight rod does not turn about itself."""


@lru_cache(maxsize=32)
def bodies(topology: Topology) -> np.ndarray:
    """(n,) the body that every node belongs to: its filament, or what is in none."""
    body = np.full(topology.n_nodes, len(topology.filaments))
    for k, path in enumerate(topology.filaments):
        body[list(path)] = k
    return np.unique(body, return_inverse=True)[1]


@lru_cache(maxsize=32)
def _shares(topology: Topology) -> np.ndarray:
    """(g, n) one for every node of a body."""
    body = bodies(topology)
    return (body == np.arange(body.max() + 1)[:, None]).astype(float)


def centres(topology: Topology, vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """For every node the mean of a vector over its body."""
    share = _shares(topology)
    return ((share / share.sum(axis=1, keepdims=True)) @ vectors)[bodies(topology)]


def turns(
    topology: Topology, end: Float[Array, "n 3"], move: Float[Array, "n 3"]
) -> Float[Array, "g 3"]:
    """The rotation of every body that comes closest to a move (m) that ends at `end`.

    A vector along the axis, of length 2 tan(angle / 2). What it turns by is exact for a rigid body,
    whose nodes move by its product with where they are halfway.
    """
    middle = end - 0.5 * move
    arm = middle - centres(topology, middle)
    share = jnp.asarray(_shares(topology))
    moment = share @ cross(arm, move)
    squared = share @ dot(arm, arm)
    second = jnp.einsum("gn,ni,nj->gij", share, arm, arm)
    # A body of one node does not turn.
    diagonal = jnp.where(squared > 0.0, (1.0 + SLENDER) * squared, 1.0)
    inertia = diagonal[:, None, None] * jnp.eye(3) - second
    return _solve3(inertia, moment)


def _solve3(a: Float[Array, "g 3 3"], b: Float[Array, "g 3"]) -> Float[Array, "g 3"]:
    """Solutions of systems with three unknowns, by Cramer's rule: quicker than a library's LU."""
    first, second, third = (a[:, :, k] for k in range(3))
    across = jnp.stack([cross(second, third), cross(third, first), cross(first, second)], axis=1)
    return (across @ b[:, :, None])[:, :, 0] / dot(first, across[:, 0])[:, None]
