"""Bending energy."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..hinge import HingeFrames, hinge_frames, strains
from ..potential import Elements
from ..pytree import pytree
from ..rod import Rod, State
from .term import Interval


def energy(
    local: Float[Array, " 11"], data: tuple[HingeFrames, Array, Array, Array]
) -> Float[Array, ""]:
    """1/2 EI |kappa - kappa_bar|^2 / l of one hinge (J); Bergou et al. 2010, eq. 6."""
    frames, stiffness, natural, length = data
    kappa, _ = strains(local, frames)
    return 0.5 * stiffness / length * jnp.sum((kappa - natural) ** 2)


@pytree
class Bend:
    """`E = sum over hinges of 1/2 EI |kappa - natural_curvature|^2 / l`.

    Attributes:
        stiffness: (b,) EI in N m^2, the same in every direction of the cross-section.
    """

    stiffness: Float[Array, " b"]

    def contribution(self, rod: Rod, state: State, interval: Interval) -> Elements:
        data = (
            hinge_frames(rod, state),
            self.stiffness,
            rod.natural_curvature,
            rod.hinge_length,
        )
        return Elements(rod.topology.hinge_stencil, energy, data)
