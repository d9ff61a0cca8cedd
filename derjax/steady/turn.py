"""What one turn of the motors makes of a state, and of small displacements of it.

A turn begins without history, so that it depends on nothing but the state, and ends moved and
turned back as a whole. Its derivative is known by its products only, from rollouts in forward mode.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from ..core.pytree import pytree, replace
from ..integrate.frames import RolloutStats, march_frames
from ..integrate.step import Scene, enlarge
from ..rods.head import head_angle
from ..rods.kinematics import angles, positions, tangents
from ..rods.rod import State, moved, no_history, transport_frames
from ..rods.vectors import signed_angle
from .motion import prescribed


@pytree
class Turn:
    """What one turn of the motors makes of a state.

    Attributes:
        change: (2 d,) m, rad, m/s and rad/s, of the state, once it is moved back.
        state: at the end, moved back.
        turn, shift: how it has moved: x to turn x + shift (m).
        speed: m/s, along the axis of `turn`, which points as the shape spins.
        head_rate: rad/s, at which the head has turned about its own axis.
        states: where it began and after every step, with a leading axis.
        stats: how the steps went.
    """

    change: Float[Array, " d2"]
    state: State
    turn: Float[Array, "3 3"]
    shift: Float[Array, " 3"]
    speed: Float[Array, ""]
    head_rate: Float[Array, ""]
    states: State
    stats: RolloutStats


def beginning(scene: Scene, state: State, z: Array) -> State:
    """A state that is displaced by z (2 d,) (m, rad, m/s, rad/s), without history.

    Else a turn would depend on more than where it begins.
    """
    apart, faster = jnp.split(z, 2)
    return replace(
        transport_frames(scene.rod, state, state.q + apart),
        velocity=state.velocity + faster,
        turns=jnp.zeros_like(state.turns),
        history=no_history(state.q),
    )


def _marched(steps: int, scene: Scene, begin: State, period: Array) -> tuple[State, RolloutStats]:
    return march_frames(replace(scene, control=None, step_length=period / steps), begin, steps, 1)


@partial(jax.jit, static_argnums=0)
def states_of_turn(steps: int, scene: Scene, state: State, period: Array) -> State:
    """The states of a turn, after every step of time, with a leading axis."""
    begin = beginning(scene, state, jnp.zeros(2 * state.q.size))
    return _marched(steps, scene, begin, period)[0]


@partial(jax.jit, static_argnums=0)
def one_turn(steps: int, scene: Scene, state: State, period: Array, z: Array) -> Turn:
    """A turn of some period (s) that begins displaced by z (2 d,) (m, rad, m/s, rad/s)."""
    topology = scene.rod.topology
    begin = beginning(scene, state, z)
    states, stats = _marched(steps, scene, begin, period)
    end = jax.tree.map(lambda leaf: leaf[-1], states)
    turn, shift = jnp.eye(3), jnp.zeros(3)
    if not topology.fixed_dofs:
        turn, shift = fitted(positions(topology, state.q), positions(topology, end.q))
    back = moved(topology, end, turn.T, -turn.T @ shift)
    spin = angles(topology, end.q) + 2 * jnp.pi * end.turns - angles(topology, begin.q)
    # The same shape in the frames of the state that the turn began with.
    here = transport_frames(scene.rod, state, back.q)
    n = 3 * topology.n_nodes
    along = tangents(topology, positions(topology, back.q))
    other = signed_angle(here.reference_director, back.reference_director, along)
    by = angles(topology, back.q) + other - angles(topology, state.q)
    by = by - 2 * jnp.pi * jnp.round(by / (2 * jnp.pi))
    change = jnp.concatenate([(back.q - state.q)[:n], by, back.velocity - state.velocity])
    back = replace(back, time=state.time)
    axis = _axis(turn)
    axis = axis * lax.stop_gradient(jnp.sign(jnp.sum(spin @ along * axis)))
    every = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), begin, states)
    turned = jnp.zeros(2) if topology.head is None else head_angle(topology, every)
    rates = shift @ axis / period, (turned[-1] - turned[0]) / period
    return Turn(change, back, turn, shift, *rates, every, stats)


def fitted(before: Float[Array, "n 3"], after: Float[Array, "n 3"]) -> tuple[Array, Array]:
    """The rigid motion that takes a shape nearest to another one (Kabsch 1976)."""
    a, b = before.mean(axis=0), after.mean(axis=0)
    u, _, vt = jnp.linalg.svd((after - b).T @ (before - a))
    signs = jnp.ones(3).at[2].set(lax.stop_gradient(jnp.sign(jnp.linalg.det(u @ vt))))
    turn = (u * signs) @ vt
    return turn, b - turn @ a


def _axis(turn: Float[Array, "3 3"]) -> Float[Array, " 3"]:
    """A unit vector that a rotation leaves as it is; zero if it leaves all of them."""
    skew = jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return skew / jnp.sqrt(skew @ skew + 1e-30)


@partial(jax.jit, static_argnums=3)
def _push(scene: Scene, state: State, period: Array, steps: int, z: Array) -> Array:
    """What a turn makes of a small displacement."""
    still = jnp.zeros_like(z)
    return jax.jvp(lambda z: one_turn(steps, scene, state, period, z).change, (still,), (z,))[1]


@partial(jax.jit, static_argnums=3)
def rates_along(
    scene: Scene, state: State, period: Array, steps: int, z: Array
) -> tuple[Array, Array]:
    """How speed and head rate change with the state at which a turn begins."""

    def rates(z: Array) -> tuple[Array, Array]:
        done = one_turn(steps, scene, state, period, z)
        return done.speed, done.head_rate

    return jax.jvp(rates, (jnp.zeros_like(z),), (z,))[1]


@partial(jax.jit, static_argnums=(0, 1, 4))
def by_parameter(
    name: str, enlarged: int, scene: Scene, state: State, steps: int, period: Array
) -> tuple[Array, Array, Array]:
    """How the end of a turn, speed and head rate change with a parameter, the beginning fixed."""

    def turned(value: Array) -> tuple[Array, Array, Array]:
        still = jnp.zeros(2 * state.q.size)
        done, _ = turn_with({name: value}, enlarged, scene, state, steps, period, still)
        return done.change, done.speed, done.head_rate

    value = jnp.asarray(scene.parameters[name], float)
    return jax.jvp(turned, (value,), (jnp.ones_like(value),))[1]


def turn_with(
    numbers: dict[str, Array],
    enlarged: int,
    scene: Scene,
    state: State,
    steps: int,
    period: Array,
    z: Array,
) -> tuple[Turn, Array]:
    """A turn of a scene with other numbers, that begins displaced by z, and its period (s).

    Args:
        numbers: parameters by name.
        enlarged: how often the lists of contacts are to be made longer.
        scene: with the numbers that `state` and `period` are of.
        state: where the turn begins.
        steps: of time in a turn.
        period: s.
        z: (2 d,) m, rad, m/s, rad/s.
    """
    other = scene.replace(**numbers)
    for _ in range(enlarged):
        other = enlarge(other)
    # Motors at another rate are round in another time, and what is held may stand elsewhere.
    time = period * _fastest(scene) / _fastest(other)
    held = np.array(scene.rod.topology.fixed_dofs, int)
    apart = (other.start.q - scene.start.q)[held]
    return one_turn(steps, other, state, time, z.at[held].add(apart)), time


def _fastest(scene: Scene) -> Array:
    """rad/s, of the motors."""
    return jnp.max(jnp.abs(prescribed(scene).rate))


class TurnDerivative:
    """Products with the derivative of a turn, in free unknowns that are about of one size."""

    def __init__(self, scene: Scene, state: State, period: float, steps: int) -> None:
        topology = scene.rod.topology
        self.scene, self.state, self.period, self.steps = scene, state, period, steps
        free = topology.free_dofs
        self.size = 2 * topology.n_dofs
        self.free = np.concatenate([free, topology.n_dofs + free])
        length = float(jnp.sum(scene.rod.rest_length))
        unit = np.where(free < 3 * topology.n_nodes, length, 1.0)
        self.unit = np.concatenate([unit, 2 * np.pi / period * unit])
        self.products = 0

    def whole(self, z: np.ndarray) -> Array:
        """(2 d,) m, rad, m/s and rad/s."""
        return jnp.zeros(self.size).at[self.free].set(z * self.unit)

    def of_one_size(self, change: Array) -> np.ndarray:
        """Free unknowns, from those with units."""
        return np.asarray(change)[self.free] / self.unit

    def product(self, z: np.ndarray) -> np.ndarray:
        """What a turn makes of a displacement."""
        self.products += 1
        pushed = _push(self.scene, self.state, self.period, self.steps, self.whole(z))
        return self.of_one_size(pushed)

    def eigenvalues(self, count: int) -> Complex[np.ndarray, " k"]:
        """The largest, by Arnoldi's method."""
        size = len(self.unit)
        operator = _sparse().LinearOperator((size, size), matvec=self.product, dtype=float)
        start = np.random.default_rng(0).standard_normal(size)
        found = _sparse().eigs(
            operator, k=count, v0=start, return_eigenvectors=False, tol=1e-4, ncv=2 * count + 8
        )
        return found[np.argsort(-np.abs(found))]

    def solve(self, b: np.ndarray, tolerance: float) -> np.ndarray:
        """The z with z - product(z) = b."""
        sparse = _sparse()
        if not np.any(b):
            return np.zeros_like(b)
        size = len(b)
        operator = sparse.LinearOperator(
            (size, size), matvec=lambda z: z - self.product(z), dtype=float
        )
        return sparse.gmres(operator, b, rtol=tolerance, restart=60, maxiter=1)[0]


def _sparse() -> Any:
    """SciPy's iterative methods, which take long to import; their types are not those they take."""
    import scipy.sparse.linalg

    return scipy.sparse.linalg
