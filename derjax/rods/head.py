"""How the head of a robot moves: of states with a leading axis of time, as a rollout returns."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .kinematics import angles, positions
from .rod import State
from .topology import Head, Topology
from .vectors import cross, dot, parallel_transport, signed_angle, unit


def head_of(topology: Topology) -> Head:
    """The head of a robot.

    Raises:
        ValueError: it has none.
    """
    if topology.head is None:
        raise ValueError("this robot has no head")
    return topology.head


def head_position(topology: Topology, states: State) -> Float[Array, "t 3"]:
    """Position of the head node, m."""
    return positions(topology, states.q)[:, head_of(topology).node]


def head_axis(topology: Topology, states: State) -> Float[Array, "t 3"]:
    """Direction of the head, towards the flagella."""
    head, nodes = head_of(topology), positions(topology, states.q)
    if not head.ahead:
        return _line(head, nodes)
    return unit(jnp.mean(nodes[:, np.array(head.ahead)], axis=1) - nodes[:, head.node])


def head_angle(topology: Topology, states: State) -> Float[Array, " t"]:
    """Angle that the head has turned about its own axis since the first state, rad.

    Frames are carried along without twist. The line of a head that is not its axis is
    followed from state to state: it must turn by less than half a turn between them.
    """
    head = head_of(topology)
    if not head.ahead:
        turned = angles(topology, states.q) + 2 * jnp.pi * states.turns
        return jnp.mean(turned[:, np.array(head.edges)], axis=1)
    axis, line = head_axis(topology, states), _line(head, positions(topology, states.q))
    carried = parallel_transport(line[:-1], axis[:-1], axis[1:])
    return jnp.pad(jnp.cumsum(signed_angle(carried, line[1:], axis[1:])), (1, 0))


def head_angular_velocity(topology: Topology, states: State) -> Float[Array, "t 3"]:
    """All three components, rad/s: the change of direction of the head's line, and its spin."""
    head = head_of(topology)
    nodes, velocity = positions(topology, states.q), positions(topology, states.velocity)
    _, turning = jax.jvp(lambda x: _line(head, x), (nodes,), (velocity,))
    spin = jnp.mean(angles(topology, states.velocity)[:, np.array(head.edges)], axis=1)
    line = _line(head, nodes)
    return cross(line, turning) + spin[:, None] * line


def head_spin(topology: Topology, states: State) -> Float[Array, " t"]:
    """Component of the angular velocity of the head along its own axis, rad/s."""
    return dot(head_angular_velocity(topology, states), head_axis(topology, states))


def _line(head: Head, nodes: Float[Array, "t n 3"]) -> Float[Array, "t 3"]:
    start, end = head.line
    return unit(nodes[:, end] - nodes[:, start])
