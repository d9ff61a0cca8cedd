"""Where a rod is expected to go, from how it has moved: the owner of `State.history`.

Newton's method needs few iterations from a good guess, and drag matrices are those of where the rod
is expected, so that its motion is extrapolated through the last three steps. A flagellum on a motor
goes along circles, which straight lines leave: a guess that turns it by some degrees along tangents
stretches it, and rods resist that more than all else. Every filament is therefore turned as a
rigid body, and what is extrapolated is how it turns, and how it moves beside that.
"""

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..rods.bodies import bodies, centres, turns
from ..rods.kinematics import positions
from ..rods.rod import History, State
from ..rods.topology import Topology
from ..rods.vectors import dot, rotation
from ..solve.contributions import Dofs


def has_moved(state: State) -> Array:
    """Whether a step has been taken, and is known of."""
    return state.history.lengths[0] > 0.0


def _differences(
    moves: Float[Array, "3 *k"], lengths: Float[Array, " 3"]
) -> tuple[Float[Array, "*k"], Float[Array, "*k"], Float[Array, "*k"]]:
    """Newton's divided differences of a path through its last points, of first to third order.

    Those of points before the start are as if it had been at rest there for no time.
    """
    h = lengths.reshape(-1, *([1] * (moves.ndim - 1)))
    v = moves / jnp.where(h > 0.0, h, 1.0)
    first = v[0]
    second = (v[0] - v[1]) / (h[0] + h[1])
    before = jnp.where(h[1] > 0.0, (v[1] - v[2]) / jnp.where(h[1] > 0, h[1] + h[2], 1.0), 0.0)
    return first, second, (second - before) / (h[0] + h[1] + h[2])


def mean_acceleration(state: State, length: Array, q: Dofs) -> Dofs:
    """From the middle of the last step to that of one to `q` (m/s^2 and rad/s^2)."""
    past = with_step(state, length, q)
    return 2.0 * _differences(past.moves, past.lengths)[1]


def jerk(state: State, length: Array, q: Dofs) -> Dofs:
    """d3q/dt3 (m/s^3 and rad/s^3), from a step to `q` and those before it."""
    past = with_step(state, length, q)
    return 6.0 * _differences(past.moves, past.lengths)[2]


def with_step(state: State, length: Array, q: Dofs) -> History:
    """The history after a step of some length (s) from `state` to `q`."""
    past = state.history
    return History(
        moves=jnp.concatenate([(q - state.q)[None], past.moves[:-1]]),
        lengths=jnp.concatenate([length[None], past.lengths[:-1]]),
    )


def _extrapolated(
    moves: Float[Array, "3 k"],
    lengths: Float[Array, " 3"],
    ahead: Array,
    unit: Float[Array, " k"] | float,
) -> Float[Array, " k"]:
    """How far a path goes on in some time (s).

    Only where it is smooth: after a jump, as at the start, velocity is taken as constant.
    """

    def size(velocity: Array) -> Array:
        return jnp.sum((unit * velocity) ** 2)

    h = jnp.where(lengths > 0.0, lengths, ahead)
    velocity, second, third = _differences(moves, jnp.where(lengths[0] > 0.0, lengths, h))
    first = (ahead + lengths[0]) * second
    second = (ahead + lengths[0]) * (ahead + lengths[0] + lengths[1]) * third
    first = jnp.where(size(first) < size(velocity), first, 0.0)
    second = jnp.where(size(second) < size(first), second, 0.0)
    return ahead * (velocity + first + second)


def _vector(turn: Float[Array, "g 3"]) -> Float[Array, "g 3"]:
    """The rotation vector (rad) of 2 tan(angle / 2) about an axis."""
    squared = 0.25 * dot(turn, turn)
    positive = squared > 1e-12
    half = jnp.sqrt(jnp.where(positive, squared, 1.0))
    return jnp.where(positive, jnp.arctan(half) / half, 1.0 - squared / 3.0)[:, None] * turn


def _half_tangent(angle: Float[Array, "g 3"]) -> Float[Array, "g 3"]:
    """2 tan(angle / 2) about the axis of a rotation vector (rad)."""
    squared = 0.25 * dot(angle, angle)
    positive = squared > 1e-12
    half = jnp.sqrt(jnp.where(positive, squared, 1.0))
    return jnp.where(positive, jnp.tan(half) / half, 1.0 + squared / 3.0)[:, None] * angle


@lru_cache(maxsize=32)
def _paths(topology: Topology) -> tuple[np.ndarray, np.ndarray]:
    """(n,) the root from which a node hangs, and (n, e) the edges on the way there.

    An edge counts 1 where it is gone along, -1 where it is gone against. A node that is held hangs
    from itself, and all others of a rod from what is held, from its head, or from its first.
    """
    n = topology.n_nodes
    held = {d // 3 for d in topology.fixed_dofs if d < 3 * n}
    root, way = np.full(n, -1), np.zeros((n, topology.n_edges))
    beside: list[list[tuple[int, int, float]]] = [[] for _ in range(n)]
    for k, (start, end) in enumerate(topology.edges):
        beside[start].append((end, k, 1.0))
        beside[end].append((start, k, -1.0))
    first = [topology.head.node] if topology.head is not None else []
    for begin in (*sorted(held), *first, *range(n)):
        if root[begin] >= 0:
            continue
        root[begin] = begin
        pending = [begin]
        while pending:
            node = pending.pop()
            for other, edge, sign in beside[node]:
                if root[other] >= 0 or other in held:
                    continue
                root[other], way[other] = root[node], way[node]
                way[other, edge] = sign
                pending.append(other)
    return root, way


def _applied(
    frames: Float[Array, "g 3 3"], vectors: Float[Array, "n 3"], body: np.ndarray
) -> Float[Array, "n 3"]:
    """Vectors turned with the bodies of their nodes."""
    return jnp.sum(frames[body] * vectors[:, None, :], axis=2)


def _of_kept_lengths(
    topology: Topology, now: Float[Array, "n 3"], goal: Float[Array, "n 3"]
) -> Float[Array, "n 3"]:
    """Nodes close to a goal, with edges as long as now: rods hardly stretch."""
    root, way = _paths(topology)
    start, end = topology.edge_nodes.T
    edges, before = goal[end] - goal[start], now[end] - now[start]
    kept = edges * jnp.sqrt(dot(before, before) / dot(edges, edges))[:, None]
    return goal[root] + way @ kept


def expected_displacement(topology: Topology, state: State, ahead: Array, unit: Dofs) -> Dofs:
    """How far (m, rad) a rod goes in some time (s), if motion goes on as it did.

    What is smooth shows in the power of the solver's units of force and torque, in which positions
    and angles count alike for robots of all sizes.

    Args:
        topology: of the rod.
        state: from which.
        ahead: s.
        unit: N and N m, of each degree of freedom.
    """
    past, n, body = state.history, 3 * topology.n_nodes, bodies(topology)
    now = positions(topology, state.q)
    # In the frame of every body as it is now: how has it turned, and how did its nodes move beside?
    x, frame = now, jnp.broadcast_to(jnp.eye(3), (body.max() + 1, 3, 3))
    turned, beside = [], []
    for move in past.moves[:, :n].reshape(3, -1, 3):
        turn = turns(topology, x, move)
        drift, arm = centres(topology, move), x - centres(topology, x)
        before = frame @ rotation(turn)
        shape, old = _applied(frame, arm, body), _applied(before, arm - move + drift, body)
        turned.append(jnp.einsum("gij,gj->gi", frame, _vector(turn)).ravel())
        beside.append((shape - old + drift).ravel())
        x, frame = x - move, before
    angle = _extrapolated(jnp.stack(turned), past.lengths, ahead, 1.0)
    moves = jnp.concatenate([jnp.stack(beside), past.moves[:, n:]], axis=1)
    move = _extrapolated(moves, past.lengths, ahead, unit)
    onward = move[:n].reshape(-1, 3)
    drift, centre = centres(topology, onward), centres(topology, now)
    turn = rotation(_half_tangent(angle.reshape(-1, 3)))
    goal = _applied(turn, now - centre + onward - drift, body) + centre + drift
    fixed = np.array(topology.fixed_dofs, int)
    # What is held may be led along, at a velocity that does not change.
    last = past.lengths[0]
    pace = jnp.where(last > 0.0, past.moves[0] / jnp.where(last > 0.0, last, 1.0), state.velocity)
    led = ahead * pace[fixed]
    goal = state.q.at[:n].set(goal.ravel()).at[fixed].set(state.q[fixed] + led)
    moved = _of_kept_lengths(topology, now, positions(topology, goal)) - now
    # Before the first step there is no mean, but there may be a velocity.
    result = jnp.concatenate([moved.ravel(), move[n:]])
    result = jnp.where(has_moved(state), result, ahead * state.velocity)
    return result.at[fixed].set(led)
