"""Kinematics of one hinge, seen from the start of a step.

Reference frames are transported in time from the known state, so that within a step the
strains are true functions of the new degrees of freedom and their derivatives exact.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .geometry import parallel_transport, unit
from .pytree import pytree
from .rod import Rod, State, curvature, hinge_tangents, material_directors, positions
from .rod import reference_twist as wrap_twist
from .rod import tangents as edge_tangents


@pytree
class HingeFrames:
    """Frames of the two edges of each hinge at the start of a step.

    Attributes:
        tangent: (b, 2, 3) pointing along the hinge.
        director: (b, 2, 3) first reference director.
        sign: (b, 2) +1 where the edge runs along the hinge.
        reference_twist: (b,) rad.
    """

    tangent: Float[Array, "*b 2 3"]
    director: Float[Array, "*b 2 3"]
    sign: Float[Array, "*b 2"]
    reference_twist: Float[Array, "*b"]


def hinge_frames(rod: Rod, state: State) -> HingeFrames:
    """The frames from which the hinges of `rod` measure their strains during a step."""
    topology = rod.topology
    tangent = edge_tangents(topology, positions(topology, state.q))
    return HingeFrames(
        tangent=jnp.stack(hinge_tangents(topology, tangent), axis=1),
        director=state.reference_director[topology.hinge_edges],
        sign=jnp.asarray(topology.hinge_signs),
        reference_twist=state.reference_twist,
    )


def strains(
    local: Float[Array, " 11"], frames: HingeFrames
) -> tuple[Float[Array, " 2"], Float[Array, ""]]:
    """Integrated curvature (2,) and twist (rad) of one hinge.

    `local` holds its three nodes (m) and two angles (rad). The twist is
    theta_1 - theta_0 + reference twist.
    """
    nodes, theta = local[:9].reshape(3, 3), frames.sign * local[9:]
    tangent = unit(nodes[1:] - nodes[:-1])
    director = parallel_transport(frames.director, frames.tangent, tangent)
    m1, m2 = material_directors(director, tangent, theta)
    kappa = curvature(tangent[0], tangent[1], (m1[0], m1[1]), (m2[0], m2[1]))
    twist = wrap_twist(
        director[0], director[1], tangent[0], tangent[1], frames.reference_twist
    )
    return kappa, theta[1] - theta[0] + twist
