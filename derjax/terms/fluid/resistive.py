"""Resistive force theory: local, anisotropic drag."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.pytree import Indices, pytree
from ...rods.kinematics import positions
from ...rods.rod import Rod, State
from ...rods.topology import Topology
from ...rods.vectors import dot, unit
from ...solve.contributions import Elements
from ...solve.local import QuadraticForm
from ..term import Prediction, Role, Stage, Term


def gray_hancock(
    viscosity: Array, pitch: Array, rod_radius: Array, helix_radius: Array
) -> tuple[Array, Array]:
    """Drag per length (Pa s) along and across a slender helix (Gray & Hancock 1955)."""
    del helix_radius
    ratio = jnp.log(2.0 * pitch / rod_radius)
    return (
        2.0 * jnp.pi * viscosity / (ratio - 0.5),
        4.0 * jnp.pi * viscosity / (ratio + 0.5),
    )


def lighthill(
    viscosity: Array, pitch: Array, rod_radius: Array, helix_radius: Array
) -> tuple[Array, Array]:
    """Drag per length (Pa s) along and across a slender helix (Lighthill 1976).

    The length scale is 0.18 of the contour of one turn, pitch / cos(helix angle).
    """
    turn = jnp.sqrt(pitch**2 + (2.0 * jnp.pi * helix_radius) ** 2)
    ratio = jnp.log(0.18 * turn / rod_radius)
    return 2.0 * jnp.pi * viscosity / ratio, 4.0 * jnp.pi * viscosity / (ratio + 0.5)


@pytree
class ResistiveDrag(Term):
    """`Phi = sum over nodes of l/2 v . (zeta_par t t + zeta_perp (1 - t t)) v`.

    Attributes:
        parallel: drag per length along the rod, Pa s; or (f,) one for each filament.
        normal: drag per length across the rod, Pa s; or (f,) one for each filament.
    """

    role: ClassVar[Role] = Role.DRAG

    parallel: Float[Array, "*f"]
    normal: Float[Array, "*f"]

    def prepare(self, rod: Rod, state: State, prediction: Prediction) -> Float[Array, " d"]:
        """Where tangents are taken."""
        return prediction.configuration

    def contribution(
        self, rod: Rod, state: State, stage: Stage, cache: Float[Array, " d"]
    ) -> Elements:
        topology = rod.topology
        x = positions(topology, cache)
        nodes, tangent, length = [], [], []
        for path in topology.filaments:
            edge = x[np.array(path[1:])] - x[np.array(path[:-1])]
            half = 0.5 * jnp.sqrt(dot(edge, edge))
            nodes += path
            length.append(jnp.pad(half, (0, 1)) + jnp.pad(half, (1, 0)))
            direction = unit(edge)
            tangent.append(
                unit(jnp.pad(direction, ((0, 1), (0, 0))) + jnp.pad(direction, ((1, 0), (0, 0))))
            )
        dofs = topology.node_dofs(nodes)
        weight = jnp.concatenate(length)[:, None, None]
        tangent = jnp.concatenate(tangent)
        along = tangent[:, :, None] * tangent[:, None, :]
        parallel, normal = (_of_nodes(topology, z) for z in (self.parallel, self.normal))
        resistance = weight * (normal * jnp.eye(3) + (parallel - normal) * along)
        data = stage.fluid_origin_from(state)[dofs], resistance / stage.length
        return Elements(Indices(dofs), QuadraticForm(), data)


def _of_nodes(topology: Topology, each: Float[Array, "*f"]) -> Array:
    """A number of each filament as one of each of their nodes, to multiply matrices with."""
    if each.ndim == 0:
        return each
    counts = np.array([len(path) for path in topology.filaments])
    return jnp.repeat(each, counts, total_repeat_length=int(counts.sum()))[:, None, None]
