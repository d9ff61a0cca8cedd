"""Rigid bodies of filaments: the 6 x 6 resistance that derjax's drag terms amount to."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from derjax import at_rest, chain
from derjax.solve.potential import assemble
from derjax.terms import ResistiveDrag, Stage, StokesletSegments
from derjax.terms.term import contributions


def rigid_motions(nodes: Float[Array, "n 3"]) -> Float[Array, "3n 6"]:
    """Velocities of `nodes` (m) in unit translations along, and rotations about, x, y and z.

    The rotations are about the origin.
    """
    x, y, z = jnp.asarray(nodes).T
    zero = jnp.zeros_like(x)
    about = jnp.stack(
        [
            jnp.stack([zero, -z, y], axis=1),
            jnp.stack([z, zero, -x], axis=1),
            jnp.stack([-y, x, zero], axis=1),
        ],
        axis=2,
    )
    along = jnp.broadcast_to(jnp.eye(3), (len(x), 3, 3))
    return jnp.concatenate([along, about], axis=2).reshape(-1, 6)


def rigid_resistance(
    nodes: Float[Array, "n 3"], resistance: Float[Array, "3n 3n"]
) -> Float[Array, "6 6"]:
    """Takes (velocity, rate of rotation) of a rigid body to the (force, torque) of its drag."""
    motions = rigid_motions(nodes)
    return motions.T @ resistance @ motions


def stokeslet_resistance(
    nodes: Float[Array, "n 3"],
    viscosity: float,
    regularization: float,
    end_nodes: str = "half",
    drag_matrix: str = "symmetric",
) -> Float[Array, "3n 3n"]:
    """Resistance matrix (N s/m) of one filament by regularized Stokeslet segments."""
    path = tuple(range(len(nodes)))
    term = StokesletSegments(
        viscosity=jnp.asarray(viscosity),
        regularization=jnp.asarray(regularization),
        solved=(path,),
        dragged=path,
        end_nodes=end_nodes,
        drag_matrix=drag_matrix,
    )
    return term.resistance(jnp.asarray(nodes))


def resistive_resistance(
    nodes: Float[Array, "n 3"], parallel: float, normal: float
) -> Float[Array, "3n 3n"]:
    """Resistance matrix (N s/m) of one filament by local drag per length (Pa s)."""
    n = len(nodes)
    rod, state = at_rest(chain(n, filaments=(tuple(range(n)),)), nodes)
    term = ResistiveDrag(jnp.asarray(parallel), jnp.asarray(normal))
    second = Stage(jnp.ones(()), jnp.ones(()), jnp.zeros(0))
    return assemble(contributions([term], rod, state, second)).hessian(state.q)[: 3 * n, : 3 * n]


def propulsion(matrix: Float[Array, "6 6"]) -> dict[str, float]:
    """Force along x per rate of rotation about x (N s), and torque (N m s) and drag (N s/m)."""
    matrix = np.asarray(matrix)
    return {"thrust": abs(matrix[0, 3]), "torque": matrix[3, 3], "drag": matrix[0, 0]}
