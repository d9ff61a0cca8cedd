"""Drag on the head of the robot."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..geometry import dot, unit
from ..potential import Autodiff, Elements
from ..pytree import Indices, pytree
from ..rod import Rod, State
from .term import Interval


def dissipation(
    local: Float[Array, " 7"], data: tuple[Array, Array, Array, Array, Array]
) -> Float[Array, ""]:
    """h Phi of one head (J): translation of its node, rotation of its edge."""
    old, translation, spin, tilt, h = data
    displacement = local[:3] - old[:3]
    turn = local[6] - old[6]
    tangent, old_tangent = unit(local[3:6] - local[:3]), unit(old[3:6] - old[:3])
    change = tangent - old_tangent
    rate = translation * dot(displacement, displacement) + spin * turn**2
    return 0.5 / h * (rate + tilt * dot(change, change))


@pytree
class HeadDrag:
    """`Phi = 1/2 C_t 6 pi mu r_h |u|^2 + 1/2 C_r 8 pi mu r_h^3 |omega|^2`.

    `u` is the velocity of the head node and `omega` the physical angular velocity of the
    head's material frame: the spin of the head edge about itself (the rate of its angle, as
    reference frames transported in time do not spin) and the change of its direction.

    Attributes:
        translation: 6 pi mu r_h C_t, N s/m.
        spin: 8 pi mu r_h^3 C_r, N m s: resistance to turning about the head's axis.
        tilt: N m s: resistance to a change of direction of that axis. The paper's model has
            none; a head that is a sphere has the same as for spin.
    """

    translation: Float[Array, ""]
    spin: Float[Array, ""]
    tilt: Float[Array, ""]

    def contribution(self, rod: Rod, state: State, interval: Interval) -> Elements:
        topology = rod.topology
        if topology.head_edge is None:
            raise ValueError("a scene with head drag needs a rod with a head")
        nodes = topology.edge_nodes[topology.head_edge]
        dofs = np.append(topology.node_dofs(nodes), topology.edge_dofs([topology.head_edge]))
        coefficients = (self.translation, self.spin, self.tilt, interval.length)
        data = (state.q[dofs][None], *(jnp.asarray(c)[None] for c in coefficients))
        return Elements(Indices(dofs[None]), Autodiff(dissipation), data)
