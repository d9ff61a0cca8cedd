"""Weight less buoyancy."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.pytree import pytree
from ..rods.rod import Rod, State
from ..solve.contributions import Load
from .term import Stage, Term


@pytree
class Gravity(Term):
    """`E = - sum over nodes of m g . x`, with m the mass less that of the displaced fluid.

    Attributes:
        buoyant_mass: (n,) kg.
        acceleration: (3,) m/s^2.
    """

    buoyant_mass: Float[Array, " n"]
    acceleration: Float[Array, " 3"]

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: None) -> Load:
        weight = self.buoyant_mass[:, None] * self.acceleration
        return Load(jnp.concatenate([weight.ravel(), jnp.zeros(rod.topology.n_edges)]))
