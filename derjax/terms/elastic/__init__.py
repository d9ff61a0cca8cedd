"""Elastic energies: stretching, bending and twisting."""

import jax.numpy as jnp
from jaxtyping import Array

from ...rods.rod import Rod
from .bend import Bend
from .stretch import Stretch
from .twist import Twist


def elasticity(
    rod: Rod, youngs_modulus: float | Array, poisson_ratio: float | Array = 0.5
) -> tuple[Stretch, Bend, Twist]:
    """Stretching, bending and twisting of a uniform rod with a circular cross-section.

    Args:
        rod: that knows its radius r.
        youngs_modulus: E, Pa. EA = pi r^2 E, EI = pi r^4 E / 4.
        poisson_ratio: nu. GJ = EI / (1 + nu).

    Raises:
        ValueError: the rod has no radius.
    """
    if rod.radius is None:
        raise ValueError("this rod has no radius; make it with Rod.straight, or the terms by hand")
    n_edges, n_hinges = rod.topology.n_edges, len(rod.topology.hinges)
    stretching = jnp.pi * rod.radius**2 * youngs_modulus
    bending = jnp.pi * rod.radius**4 / 4 * youngs_modulus
    return (
        Stretch(jnp.broadcast_to(stretching, n_edges)),
        Bend(jnp.broadcast_to(bending, n_hinges)),
        Twist(jnp.broadcast_to(bending / (1 + poisson_ratio), n_hinges)),
    )
