"""Inertia, for scenes that are not quite at zero Reynolds number."""

from jaxtyping import Array, Float

from ..potential import Diagonal
from ..pytree import pytree
from ..rod import Rod, State
from .term import Interval


@pytree
class Inertia:
    """`1/(2 h^2) |q1 - q0 - h v0|^2_M`, whose gradient is the inertia of implicit Euler.

    Attributes:
        mass: (d,) kg for positions, kg m^2 for angles.
    """

    mass: Float[Array, " d"]

    def contribution(self, rod: Rod, state: State, interval: Interval) -> Diagonal:
        h = interval.length
        return Diagonal(weight=self.mass / h**2, origin=state.q + h * state.velocity)
