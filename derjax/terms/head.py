"""Drag on the head of the robot."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..geometry import cross, dot, norm, unit
from ..potential import Autodiff, Elements
from ..pytree import Indices, pytree, replace
from ..rod import Head, Rod, State, positions
from .term import Interval, Outlook, Term


def dissipation(
    local: Float[Array, " k"], data: tuple[Array, Array, Array, Array, Array, Array, Array]
) -> Float[Array, ""]:
    """h Phi of one head (J).

    `local` holds the head node, the start and end of the head's line (m), and its angles.
    """
    old, line, before, translation, spin, tilt, h = data
    moved = local - old
    displacement, change = moved[:3], moved[6:9] - moved[3:6]
    # Frames are transported from the start of the step, so that a change of the line turns
    # them a little about it: by the holonomy of that transport. It makes hardly any angle, but
    # the torque on the spin is felt as a force on the line, without which the head drifts
    # aside by an error of first order in the step.
    direction, first = unit(line), unit(before)
    holonomy = cross(direction, first) / (norm(line) * (1.0 + dot(first, direction)))
    turn = jnp.mean(moved[9:]) + dot(holonomy, change)
    change = (change - dot(change, direction) * direction) / norm(line)
    rate = translation * dot(displacement, displacement) + spin * turn**2
    return 0.5 / h * (rate + tilt * dot(change, change))


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
        line: (3,) m, the head's line where drag is taken; None for that at the start of a step.
    """

    translation: Float[Array, ""]
    spin: Float[Array, ""]
    tilt: Float[Array, ""]
    line: Float[Array, " 3"] | None = None

    def prepared(self, rod: Rod, state: State, outlook: Outlook) -> "HeadDrag":
        return replace(self, line=_line(rod, outlook.configuration))

    def contribution(self, rod: Rod, state: State, interval: Interval) -> Elements:
        topology = rod.topology
        head = _head(rod)
        nodes = topology.node_dofs([head.node, *head.line]).ravel()
        dofs = np.append(nodes, topology.edge_dofs(head.edges))
        before = _line(rod, state.q)
        line = before if self.line is None else self.line
        origin = interval.origin_from(state)[dofs]
        data = (origin, line, before, self.translation, self.spin, self.tilt, interval.length)
        return Elements(
            Indices(dofs[None]), Autodiff(dissipation), tuple(jnp.asarray(x)[None] for x in data)
        )


def _head(rod: Rod) -> Head:
    if rod.topology.head is None:
        raise ValueError("a scene with head drag needs a rod with a head")
    return rod.topology.head


def _line(rod: Rod, q: Float[Array, " d"]) -> Float[Array, " 3"]:
    start, end = _head(rod).line
    x = positions(rod.topology, q)
    return x[end] - x[start]
