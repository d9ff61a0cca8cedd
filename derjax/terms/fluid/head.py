"""Drag on the head of the robot."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.pytree import Indices, pytree
from ...rods.kinematics import positions
from ...rods.rod import Rod, State
from ...rods.topology import Head
from ...rods.vectors import holonomy, norm, unit
from ...solve.contributions import Elements
from ...solve.local import QuadraticForm
from ..term import Prediction, Role, Stage, Term


@pytree
class HeadDrag(Term):
    """`Phi = 1/2 C_t 6 pi mu r_h |u|^2 + 1/2 C_r 8 pi mu r_h^3 |omega|^2`.

    `u` is the velocity of the head node and `omega` the physical angular velocity of the head
    (see `Head`): the spin of its frame about its line (the rate of its angles, as reference
    frames transported in time do not spin) and the change of direction of that line.

    Attributes:
        translation: 6 pi mu r_h C_t, N s/m.
        spin: 8 pi mu r_h^3 C_r, N m s: resistance to turning about the head's line.
        tilt: N m s: resistance to a change of direction of that line. The paper's model of
            one flagellum has none; a head that is a sphere has the same as for spin.
        radius: r_h, m; the drag has it in it already.
    """

    role: ClassVar[Role] = Role.DRAG

    translation: Float[Array, ""]
    spin: Float[Array, ""]
    tilt: Float[Array, ""]
    radius: Float[Array, ""]

    def prepare(self, rod: Rod, state: State, prediction: Prediction) -> Float[Array, " 3"]:
        """The head's line (m) where drag is taken."""
        return _line(rod, prediction.configuration)

    def contribution(
        self, rod: Rod, state: State, stage: Stage, cache: Float[Array, " 3"]
    ) -> Elements:
        topology = rod.topology
        head, first = _head(rod), _line(rod, state.q)
        nodes = topology.node_dofs([head.node, *head.line]).ravel()
        dofs = np.append(nodes, topology.edge_dofs(head.edges))
        resistance = self.resistance(cache, first, len(head.edges))
        data = stage.fluid_origin_from(state)[dofs][None], resistance[None] / stage.length
        return Elements(Indices(dofs[None]), QuadraticForm(), data)

    def resistance(
        self, line: Float[Array, " 3"], first: Float[Array, " 3"], n_edges: int
    ) -> Float[Array, "k k"]:
        """Matrix (N s/m) that takes velocities to drag.

        Of the head's node, of the start and the end of its line (m/s), and of the angles of its
        edges (rad/s).

        Args:
            line: m, from start to end.
            first: m, at the start of the step.
            n_edges: number of edges of the head.
        """
        move, turn = np.eye(3, 9 + n_edges), np.zeros(9 + n_edges)
        turn[9:] = 1.0 / n_edges
        change = np.eye(3, 9 + n_edges, 6) - np.eye(3, 9 + n_edges, 3)
        # Frames are transported from the start of the step, so that a change of the line turns
        # them a little about it: by the holonomy of that transport. It makes hardly any angle, but
        # the torque on the spin is felt as a force on the line, without which the head drifts
        # aside by an error of first order in the step.
        direction, before = unit(line), unit(first)
        spin = jnp.asarray(turn) + holonomy(before, direction) / norm(line) @ change
        tilt = (jnp.eye(3) - jnp.outer(direction, direction)) @ change / norm(line)
        return (
            self.translation * move.T @ move
            + self.spin * jnp.outer(spin, spin)
            + self.tilt * tilt.T @ tilt
        )


def _head(rod: Rod) -> Head:
    if rod.topology.head is None:
        raise ValueError("a scene with head drag needs a rod with a head")
    return rod.topology.head


def _line(rod: Rod, q: Float[Array, " d"]) -> Float[Array, " 3"]:
    start, end = _head(rod).line
    x = positions(rod.topology, q)
    return x[end] - x[start]
