"""The contact forces of published codes, to compare with.

After a step, every pair of edges that overlaps gets a pair of forces that would push it apart
in the next try, as free masses: with the overlap p = 2 r_0 - d and the normal n, node i of the
pair with weight w_i and mass m_i gets

    f_i += w_i n p m_i / (2 h^2),

and the step is taken again, until nothing overlaps (Spillmann & Teschner 2008; Lim,
Yadunandan & Jawed 2023, supplement). Forces are constant during a try, so that this is
explicit; where drag dominates inertia many tries are needed.
"""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.pytree import Indices, pytree, static
from ...rods.kinematics import positions
from ...rods.rod import Rod, State
from ...solve.contributions import Dofs, Load
from ..term import Role, Stage, Term
from .segments import between, closest


@pytree
class SpillmannTeschner(Term):
    """Constant forces on touching rods, corrected try by try (see `contact_corrected_euler`).

    Attributes:
        radius: r_0, m, of the rod.
        mass: (n,) kg of the nodes.
        force: (d,) N, the sum of all corrections so far.
        pairs: (p, 2) the edges that may touch.
        tries: how often a step is taken again at most.
    """

    role: ClassVar[Role] = Role.CORRECTION

    radius: Float[Array, ""]
    mass: Float[Array, " n"]
    force: Dofs
    pairs: Indices = static()
    tries: int = static(default=100)

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: None) -> Load:
        return Load(self.force)

    def correction(self, rod: Rod, q: Dofs, length: Array) -> tuple[Dofs, Array]:
        """What to add to the forces after a try that ended at `q`; whether anything overlaps."""
        nodes = rod.topology.edge_nodes[self.pairs.array].reshape(-1, 4)
        pair = positions(rod.topology, q)[nodes]
        s, t = closest(pair)
        gap = between(pair, s, t)
        d = jnp.maximum(jnp.sqrt(jnp.sum(gap * gap, axis=1)), 1e-6 * self.radius)
        overlap = jnp.maximum(2.0 * self.radius - d, 0.0)
        weight = jnp.stack([1.0 - s, s, t - 1.0, -t], axis=1)
        push = weight * self.mass[nodes] * (overlap / (2.0 * d * length**2))[:, None]
        force = jnp.zeros_like(q).at[np.asarray(rod.topology.node_dofs(nodes))]
        return force.add(push[:, :, None] * gap[:, None, :]), jnp.any(overlap > 0.0)
