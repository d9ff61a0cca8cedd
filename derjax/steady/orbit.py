"""Relative periodic orbits: how robots with several flagella swim steadily.

Flagella on one head pass each other in every turn of their motors, so that no shape stays as it is.
But after a turn the robot may be what it was, moved and turned as a whole: with Phi the motion
during one turn and g that rigid motion, a state s with

    s = g^-1 Phi(s)

is looked for by Newton's method. Its matrix is known by what it does only, from derivatives of a
rollout in forward mode, and as most displacements die out within a turn a few products do
(shooting with GMRES: Viswanath, J. Fluid Mech. 580, 339, 2007). Contact may be active. The
eigenvalues of the same map are the Floquet multipliers: what a turn makes of a small displacement.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from ..core.errors import InputError
from ..core.pytree import pytree, replace
from ..core.status import SolverError, Status
from ..integrate.frames import RolloutStats, march_frames
from ..integrate.step import Scene, enlarge
from ..rods.head import head_angle
from ..rods.kinematics import angles, positions, tangents
from ..rods.rod import State, moved, no_history, transport_frames
from ..rods.vectors import signed_angle

SLOWEST = 6
"""Turns of the slower motors within which all motors must be back where they were."""

GMRES = 1e-3
"""To how much of the residual a step of Newton's method is solved for."""

PARTS = (1.0, 0.3, 0.1, 0.0)
"""Of a step of Newton's method, tried one after another."""

EXACT = 1e-8
"""To how much derivatives by parameters are."""


@pytree
class _Turn:
    """What one turn of the motors makes of a state.

    Attributes:
        change: (2 d,) m, rad, m/s and rad/s, of the state, once it is moved back.
        state: at the end, moved back.
        turn, shift: how it has moved: x to turn x + shift (m).
        speed: m/s, along the axis of `turn`, which points as the shape spins.
        head_rate: rad/s, at which the head has turned about its own axis.
        stats: how the steps went.
    """

    change: Float[Array, " d2"]
    state: State
    turn: Float[Array, "3 3"]
    shift: Float[Array, " 3"]
    speed: Float[Array, ""]
    head_rate: Float[Array, ""]
    stats: RolloutStats


@dataclass(frozen=True)
class Orbit:
    """A steady motion that comes back to itself in every turn of the motors.

    Attributes:
        scene: whose motion.
        state: where a turn begins.
        period: s, of a turn.
        steps: of time in a turn.
        turn, shift: what a turn makes of the robot as a whole: x to turn x + shift (m).
        speed: m/s, along the axis about which the robot is turned, in the sense in which flagella
            spin: how fast it gets on.
        head_rate: rad/s, at which the head turns about its own axis, on average.
        residual: what a turn changes otherwise, over the length of the robot.
        iterations: Newton steps.
        turns: of the motors that were computed, a product with the derivative counted as one.
        enlarged: how often the lists of contacts of the scene were made longer.
    """

    scene: Scene
    state: State
    period: float
    steps: int
    turn: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, " 3"]
    speed: float
    head_rate: float
    residual: float
    iterations: int
    turns: int
    enlarged: int

    def one_turn(self) -> State:
        """The states of a turn, after every step of time, with a leading axis."""
        return _states_of_turn(self.steps, self.scene, self.state, self.period)

    def multipliers(self, count: int = 4) -> Complex[np.ndarray, " k"]:
        """The largest Floquet multipliers, by Arnoldi's method.

        What a turn makes of small displacements, rigid motions excluded: all are smaller than one
        where the orbit attracts.
        """
        sparse = _sparse()
        program = _Program(self.scene, self.state, self.period, self.steps)
        size = len(program.unit)
        operator = sparse.LinearOperator((size, size), matvec=program.product, dtype=float)
        start = np.random.default_rng(0).standard_normal(size)
        found = sparse.eigs(
            operator, k=count, v0=start, return_eigenvectors=False, tol=1e-4, ncv=2 * count + 8
        )
        return found[np.argsort(-np.abs(found))]

    def derivatives(self, names: Sequence[str]) -> dict[str, dict[str, float]]:
        """Of speed (m/s) and head rate (rad/s) by parameters of the scene, by name.

        Exact for the steps of time that are taken, by the implicit function theorem.

        Raises:
            KeyError: a parameter that the scene does not have.
            ValueError: one with several values.
        """
        program = _Program(self.scene, self.state, self.period, self.steps)
        found = {}
        for name in names:
            self.scene.number(name)
            along = _by_parameter(
                name, self.enlarged, self.scene, self.state, self.steps, self.period
            )
            z = program.solve(program.of_one_size(along[0]), EXACT)
            speed, head_rate = _rates_along(
                self.scene, self.state, self.period, self.steps, program.whole(z)
            )
            found[name] = {
                "speed": float(along[1] + speed),
                "head_rate": float(along[2] + head_rate),
            }
        return found


def orbit(
    scene: Scene,
    state: State | None = None,
    *,
    steps: int = 50,
    turns: int = 4,
    tolerance: float = 1e-6,
    most: int = 12,
) -> Orbit:
    """The relative periodic orbit of a robot whose motors turn at constant rates.

    Unknown are positions, angles and their rates where a turn begins; what a step knows of those
    before it (`State.history`) is left out, and so are accelerations, which only masses feel. On
    the host; `Orbit.derivatives` has derivatives.

    Args:
        scene: of one flagellum or more. Its own scheme is used, with steps of one length.
        state: where the search starts; None for the end of some `turns` from rest.
        steps: of time in a turn.
        turns: of the motors before the search begins.
        tolerance: of what may change in a turn, over the length of the robot.
        most: Newton steps.

    Raises:
        InputError: the rates of the motors change, or they have no short period in common.
        SolverError: a step of time failed, or no orbit was found: it may not be periodic.
    """
    search = _Search(scene, period_of(scene), steps)
    begin = scene.start if state is None else state
    for _ in range(turns if state is None else 0):
        begin = search.turn(begin).state
    residual, before = np.inf, np.inf
    for iteration in range(most):
        done = search.turn(begin)
        program = _Program(search.scene, begin, search.period, steps)
        change = program.of_one_size(done.change)
        residual = float(np.max(np.abs(change)))
        if residual <= tolerance:
            return search.found(begin, done, residual, iteration)
        if residual > max(2.0 * before, 0.1):
            break
        before = residual
        z = program.solve(change, GMRES)
        search.turns += program.products
        begin = search.nearer(begin, program.whole(z))
    raise SolverError(
        f"no orbit was found in {most} Newton steps: in a turn the robot still changes by "
        f"{residual:.1e} of its length. Its motion may not be periodic, as with flagella that "
        "bundle and part again; try more turns first, or a state of a long run."
    )


def _sparse() -> Any:
    """SciPy's iterative methods, which take long to import; their types are not those they take."""
    import scipy.sparse.linalg

    return scipy.sparse.linalg


class _Search:
    """Turn by turn, with longer lists of contacts where they are needed."""

    def __init__(self, scene: Scene, period: float, steps: int) -> None:
        self.scene, self.period, self.steps = scene, period, steps
        self.enlarged, self.turns = 0, 0

    def turn(self, begin: State, z: Array | None = None) -> _Turn:
        """A turn from a state that is displaced by z."""
        z = jnp.zeros(2 * begin.q.size) if z is None else z
        self.turns += 1
        done = _one_turn(self.steps, self.scene, begin, self.period, z)
        while int(done.stats.status) == Status.CAPACITY:
            self.scene, self.enlarged = enlarge(self.scene), self.enlarged + 1
            done = _one_turn(self.steps, self.scene, begin, self.period, z)
        if not done.stats.ok:
            raise SolverError(f"in a turn of {self.period:.4g} s: {done.stats.message()}")
        return done

    def nearer(self, begin: State, z: Array) -> State:
        """The end of a turn from where Newton's method leads, or less far where that fails.

        As rods overlap there, say. With no step at all it is one more turn.
        """
        for part in PARTS:
            try:
                return self.turn(begin, part * z).state
            except SolverError:
                if part == 0.0:
                    raise
        raise AssertionError("the last part is zero")

    def found(self, begin: State, done: _Turn, residual: float, iterations: int) -> Orbit:
        return Orbit(
            scene=self.scene,
            state=begin,
            period=self.period,
            steps=self.steps,
            turn=np.asarray(done.turn),
            shift=np.asarray(done.shift),
            speed=float(done.speed),
            head_rate=float(done.head_rate),
            residual=residual,
            iterations=iterations,
            turns=self.turns,
            enlarged=self.enlarged,
        )


def period_of(scene: Scene) -> float:
    """s, after which all motors are back where they were.

    Raises:
        InputError: they stand still, their rates change, or that would take too many turns.
    """
    motor = scene.motor
    if motor is None or motor.time.shape[0] != 1 or not np.any(motor.rate):
        raise InputError("an orbit needs motors that turn at constant rates")
    rates = np.abs(np.asarray(motor.rate[0]))
    rates = rates[rates > 0.0]
    turns = [Fraction(float(r / rates.min())).limit_denominator(SLOWEST) for r in rates]
    exact = all(
        abs(float(t) * rates.min() - r) < 1e-9 * r for t, r in zip(turns, rates, strict=True)
    )
    common = int(np.lcm.reduce([t.denominator for t in turns]))
    if not exact or common > SLOWEST:
        rpm = ", ".join(f"{r * 30 / np.pi:.6g}" for r in rates)
        raise InputError(
            f"motors at {rpm} rpm have no period of at most {SLOWEST} turns in common: their "
            "motion does not come back to itself; simulate it in time"
        )
    return float(2 * np.pi * common / rates.min())


@partial(jax.jit, static_argnums=0)
def _states_of_turn(steps: int, scene: Scene, state: State, period: Array) -> State:
    begin = _beginning(scene, state, jnp.zeros(2 * state.q.size))
    return _marched(steps, scene, begin, period)[0]


def _beginning(scene: Scene, state: State, z: Array) -> State:
    """A state that is displaced by z, without history.

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
def _one_turn(steps: int, scene: Scene, state: State, period: Array, z: Array) -> _Turn:
    topology = scene.rod.topology
    begin = _beginning(scene, state, z)
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
    return _Turn(change, back, turn, shift, *rates, stats)


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
    return jax.jvp(lambda z: _one_turn(steps, scene, state, period, z).change, (still,), (z,))[1]


@partial(jax.jit, static_argnums=3)
def _rates_along(
    scene: Scene, state: State, period: Array, steps: int, z: Array
) -> tuple[Array, Array]:
    """How speed and head rate change with the state at which a turn begins."""

    def rates(z: Array) -> tuple[Array, Array]:
        done = _one_turn(steps, scene, state, period, z)
        return done.speed, done.head_rate

    return jax.jvp(rates, (jnp.zeros_like(z),), (z,))[1]


@partial(jax.jit, static_argnums=(0, 1, 4))
def _by_parameter(
    name: str, enlarged: int, scene: Scene, state: State, steps: int, period: Array
) -> tuple[Array, Array, Array]:
    """How the end of a turn, speed and head rate change with a parameter, the beginning fixed."""

    def turned(value: Array) -> tuple[Array, Array, Array]:
        other = scene.replace(**{name: value})
        for _ in range(enlarged):
            other = enlarge(other)
        # Motors at another rate are round in another time, and what is held may stand elsewhere.
        time = period * _fastest(scene) / _fastest(other)
        held = np.array(scene.rod.topology.fixed_dofs, int)
        apart = (other.start.q - scene.start.q)[held]
        z = jnp.zeros(2 * state.q.size).at[held].set(apart)
        done = _one_turn(steps, other, state, time, z)
        return done.change, done.speed, done.head_rate

    value = jnp.asarray(scene.parameters[name], float)
    return jax.jvp(turned, (value,), (jnp.ones_like(value),))[1]


def _fastest(scene: Scene) -> Array:
    """rad/s, of the motors."""
    return jnp.zeros(()) if scene.motor is None else jnp.max(jnp.abs(scene.motor.rate))


class _Program:
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
