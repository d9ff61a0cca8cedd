"""The masses of a robot: what resists acceleration, and what gravity pulls at."""

from collections.abc import Mapping

import jax.numpy as jnp
from jaxtyping import Array, Float

from ...rods.rod import Rod
from .ingredient import Setting


def inertial_mass(setting: Setting) -> Float[Array, " d"]:
    """Mass (kg) of every position and polar moment of inertia (kg m^2) of every angle."""
    p, rod = setting.numbers, setting.rod
    line_density = p["density"] * jnp.pi * p["rod_radius"] ** 2
    mass = line_density * _node_length(rod)
    if rod.topology.head is not None:
        mass = mass.at[rod.topology.head.node].set(_head_mass(setting))
    polar = 0.5 * p["rod_radius"] ** 2 * line_density * rod.rest_length
    return jnp.concatenate([jnp.repeat(mass, 3), polar])


def buoyant_mass(setting: Setting) -> Float[Array, " n"]:
    """Mass (kg) of every node less that of the fluid in its place.

    The head stands for itself and for the rod within, as it does in `inertial_mass`.
    """
    p, rod, given = setting.numbers, setting.rod, setting.file.head.mass
    area = jnp.pi * p["rod_radius"] ** 2
    mass = _node_length(rod) * area * (p["density"] - p["fluid_density"])
    if rod.topology.head is None:
        return mass
    volume = _head_volume(p)
    if given is None:  # so written, it is exactly neutral in a fluid as dense
        head = volume * (p["density"] - p["fluid_density"])
    else:
        head = given - volume * p["fluid_density"]
    return mass.at[rod.topology.head.node].set(head)


def _node_length(rod: Rod) -> Float[Array, " n"]:
    """Length of rod (m) that each node stands for."""
    length = jnp.zeros(rod.topology.n_nodes)
    return length.at[rod.topology.edge_nodes].add(0.5 * rod.rest_length[:, None])


def _head_volume(p: Mapping[str, Array]) -> Array:
    """m^3, of a ball."""
    return 4 / 3 * jnp.pi * p["head_radius"] ** 3


def _head_mass(setting: Setting) -> Array:
    """kg; by default that of a ball of the material."""
    if setting.file.head.mass is not None:
        return jnp.asarray(setting.file.head.mass)
    return _head_volume(setting.numbers) * setting.numbers["density"]
