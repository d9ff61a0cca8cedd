"""Bending energy."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ...core.pytree import pytree
from ...rods.rod import Rod, State
from ...solve.contributions import Elements
from ..term import Stage, Term
from .hinge import HingePotential, hinge_frames


def energy(kappa: Float[Array, " 2"], twist: Array, data: tuple[Array, Array, Array]) -> Array:
    """1/2 EI |kappa - natural|^2 / l of one hinge (J); Bergou et al. 2010, eq. 6."""
    stiffness, natural, length = data
    return 0.5 * stiffness / length * jnp.sum((kappa - natural) ** 2)


@pytree
class Bend(Term):
    """`E = sum over hinges of 1/2 EI |kappa - natural_curvature|^2 / l`.

    Attributes:
        stiffness: (b,) EI in N m^2, the same in every direction of the cross-section.
    """

    stiffness: Float[Array, " b"]

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: None) -> Elements:
        data = (self.stiffness, rod.natural_curvature, rod.hinge_length)
        frames = hinge_frames(rod, state, stage.motor_angle)
        return Elements(rod.topology.hinge_stencil, HingePotential(energy), (frames, data))
