"""Stretching energy."""

from jaxtyping import Array, Float

from ...core.pytree import pytree
from ...rods.rod import Rod, State
from ...rods.vectors import norm
from ...solve.contributions import Elements
from ...solve.local import Autodiff
from ..term import Stage, Term


def energy(local: Float[Array, " 6"], data: tuple[Array, Array]) -> Array:
    """1/2 EA l (|e|/l - 1)^2 of one edge (J); Bergou et al. 2010, eq. 5."""
    stiffness, length = data
    strain = norm(local[3:] - local[:3]) / length - 1.0
    return 0.5 * stiffness * length * strain**2


@pytree
class Stretch(Term):
    """`E = sum over edges of 1/2 EA l (|e|/l - 1)^2`.

    Attributes:
        stiffness: (e,) EA in N.
    """

    stiffness: Float[Array, " e"]

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: None) -> Elements:
        return Elements(
            rod.topology.edge_stencil, Autodiff(energy), (self.stiffness, rod.rest_length)
        )
