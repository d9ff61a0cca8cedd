"""Twisting energy; motors work against it."""

import numpy as np
from jaxtyping import Array, Float

from ...core.pytree import pytree
from ...rods.rod import Rod, State
from ...solve.contributions import Elements
from ..term import Stage, Term
from .hinge import HingePotential, hinge_frames


def energy(kappa: Float[Array, " 2"], twist: Array, data: tuple[Array, Array, Array]) -> Array:
    """1/2 GJ (twist - natural)^2 / l of one hinge (J); Bergou et al. 2010, eq. 7."""
    stiffness, natural, length = data
    return 0.5 * stiffness / length * (twist - natural) ** 2


@pytree
class Twist(Term):
    """`E = sum over hinges of 1/2 GJ (theta_1 - theta_0 + m_ref - natural_twist)^2 / l`.

    At a motor the twist is what is left of it once the motor's angle at the end of the stage is
    taken out.

    Attributes:
        stiffness: (b,) GJ in N m^2.
    """

    stiffness: Float[Array, " b"]

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: None) -> Elements:
        topology, natural = rod.topology, rod.natural_twist
        if topology.motors and topology.motor_hinge == "published":
            natural = natural.at[np.array(topology.motors)].add(stage.motor_angle)
        data = (self.stiffness, natural, rod.hinge_length)
        frames = hinge_frames(rod, state, stage.motor_angle)
        return Elements(topology.hinge_stencil, HingePotential(energy), (frames, data))
