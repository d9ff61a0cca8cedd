"""Drag on the spin of rods about their own axes."""

from itertools import pairwise
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.pytree import Indices, pytree
from ...rods.kinematics import positions
from ...rods.rod import Rod, State
from ...rods.topology import Topology
from ...rods.vectors import holonomy, norm, unit
from ...solve.contributions import Elements
from ...solve.local import QuadraticForm
from ..term import Prediction, Role, Stage, Term


@pytree
class SpinDrag(Term):
    """`Phi = sum over the edges of filaments of l/2 zeta omega^2`, with zeta = 4 pi mu r_0^2.

    The torque per length is that on an infinite cylinder that turns in a viscous fluid (Lamb,
    Hydrodynamics, section 334). omega is the physical spin: the rate of an edge's angle, as
    reference frames transported in time do not spin.

    Attributes:
        resistance: zeta, drag per length on the spin, N s.
    """

    role: ClassVar[Role] = Role.DRAG

    resistance: Float[Array, ""]

    def prepare(self, rod: Rod, state: State, prediction: Prediction) -> Float[Array, " d"]:
        """Where tangents are taken."""
        return prediction.configuration

    def contribution(
        self, rod: Rod, state: State, stage: Stage, cache: Float[Array, " d"]
    ) -> Elements:
        topology, edges = rod.topology, _wet_edges(rod.topology)
        edge, before = (_edge_vectors(topology, edges, x) for x in (cache, state.q))
        # A change of the edge turns its frame, which is transported from the start of the step.
        turn = holonomy(unit(before), unit(edge)) / norm(edge)[:, None]
        spin = jnp.concatenate([-turn, turn, jnp.ones((len(edges), 1))], axis=1)
        zeta = self.resistance * rod.rest_length[edges] / stage.length
        dofs = np.concatenate(
            [topology.edge_stencil.array[edges], topology.edge_dofs(edges)[:, None]], axis=1
        )
        data = (
            stage.fluid_origin_from(state)[dofs],
            zeta[:, None, None] * spin[:, :, None] * spin[:, None, :],
        )
        return Elements(Indices(dofs), QuadraticForm(), data)


def _wet_edges(topology: Topology) -> np.ndarray:
    """(w,): the edges between the nodes of filaments."""
    ends = [set(pair) for path in topology.filaments for pair in pairwise(path)]
    return np.array([k for k, edge in enumerate(topology.edges) if set(edge) in ends])


def _edge_vectors(
    topology: Topology, edges: np.ndarray, q: Float[Array, " d"]
) -> Float[Array, "w 3"]:
    """From start to end of each edge, m."""
    start, end = topology.edge_nodes[edges].T
    x = positions(topology, q)
    return x[end] - x[start]
