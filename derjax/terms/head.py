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
    local: Float[Array, " k"], data: tuple[Array, Array, Array, Array, Array]
) -> Float[Array, ""]:
    """h Phi of one head (J).

    `local` holds the head node, the start and end of the head's line (m), and its angles.
    """
    old, translation, spin, tilt, h = data
    displacement = local[:3] - old[:3]
    turn = jnp.mean(local[9:] - old[9:])
    change = unit(local[6:9] - local[3:6]) - unit(old[6:9] - old[3:6])
    rate = translation * dot(displacement, displacement) + spin * turn**2
    return 0.5 / h * (rate + tilt * dot(change, change))


@pytree
class HeadDrag:
    """`Phi = 1/2 C_t 6 pi mu r_h |u|^2 + 1/2 C_r 8 pi mu r_h^3 |omega|^2`.

    `u` is the velocity of the head node and `omega` the physical angular velocity of the head
    (see `Head`): the spin of its frame about its line (the rate of its angles, as reference
    frames transported in time do not spin) and the change of direction of that line.

    Attributes:
        translation: 6 pi mu r_h C_t, N s/m.
        spin: 8 pi mu r_h^3 C_r, N m s: resistance to turning about the head's line.
        tilt: N m s: resistance to a change of direction of that line. The paper's model of
            one flagellum has none; a head that is a sphere has the same as for spin.
    """

    translation: Float[Array, ""]
    spin: Float[Array, ""]
    tilt: Float[Array, ""]

    def contribution(self, rod: Rod, state: State, interval: Interval) -> Elements:
        topology = rod.topology
        if topology.head is None:
            raise ValueError("a scene with head drag needs a rod with a head")
        head = topology.head
        nodes = topology.node_dofs([head.node, *head.line]).ravel()
        dofs = np.append(nodes, topology.edge_dofs(head.edges))
        coefficients = (self.translation, self.spin, self.tilt, interval.length)
        data = (state.q[dofs][None], *(jnp.asarray(c)[None] for c in coefficients))
        return Elements(Indices(dofs[None]), Autodiff(dissipation), data)
