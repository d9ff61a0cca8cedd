"""Inertia, for scenes that are not quite at zero Reynolds number."""

from typing import ClassVar

from jaxtyping import Array, Float

from ..core.pytree import pytree
from ..rods.rod import Rod, State
from ..solve.contributions import Diagonal
from .term import Role, Stage, Term


@pytree
class Inertia(Term):
    """`1/(2 l^2) |q - origin - l velocity|^2_M`: the inertia of a stage of length l.

    Attributes:
        mass: (d,) kg for positions, kg m^2 for angles.
    """

    role: ClassVar[Role] = Role.INERTIA

    mass: Float[Array, " d"]

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: None) -> Diagonal:
        length, origin = stage.length, stage.origin_from(state)
        ahead = origin + length * stage.velocity_from(state)
        return Diagonal(weight=self.mass / length**2, origin=ahead)
