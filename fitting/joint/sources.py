"""Gaits as functions of the numbers of a scene, with exact derivatives.

One flagellum swims in a steady state, which is solved for; several have periodic orbits, and so has
one on the motor of the published model, which bends differently in every part of a turn. Both are
looked for from where the last one was found, so that a fit pays for its first evaluation and little
for the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from derjax import InputError, Scene, SceneFile, SolverError, State, Steady, build, orbit
from derjax import steady as steady_state
from derjax.steady.orbit import Orbit, period_of
from derjax.steady.solve import steady_as
from derjax.steady.turn import TurnDerivative, beginning, turn_with

from .gait import gait_of_steady, gait_of_turn
from .krylov import solved

STEPS, MOST_STEPS = 50, 400
"""Of time in a turn of an orbit, twice as many as long as one of them fails."""

TOLERANCE = 1e-6
"""Of what may change in a turn, over the length of the robot."""

ACCURACY = 1e-4
"""To how much derivatives of orbits are solved for; a fit needs no more, nor do its errors."""


@dataclass(frozen=True)
class Known:
    """A gait and its derivatives.

    Attributes:
        gait: (g,) `Gait.packed`.
        jacobian: (g, k) its derivatives by the numbers that vary.
    """

    gait: Float[np.ndarray, " g"]
    jacobian: Float[np.ndarray, "g k"]


class Source(Protocol):
    """Finds the gait at some values of the numbers that vary.

    Attributes:
        names: of these numbers, in the scene.
    """

    names: tuple[str, ...]

    def __call__(self, values: Float[np.ndarray, " k"]) -> Known:
        """The gait.

        Raises:
            SolverError: there is none.
        """
        ...

    def in_words(self) -> str:
        """What is solved for."""
        ...

    def last(self) -> tuple[Scene, State] | None:
        """The scene that was asked for last, and a state in which it swims; None before."""
        ...


def source(file: SceneFile, rpm: float | tuple[float, ...], names: Sequence[str]) -> Source:
    """What finds gaits of a robot with motors at some rate.

    Args:
        file: of the robot.
        rpm: of its motors.
        names: of the numbers that vary.

    Raises:
        InputError: the robot has no gait: weight, a motor that follows a table, no head.
    """
    if file.motor_table is not None:
        raise InputError("the motor follows a table: a steady gait needs one rate")
    if file.gravity is not None:
        raise InputError("with [gravity] a robot sinks as it swims; it has no steady gait here")
    if np.any(np.asarray(rpm) == 0):
        raise InputError("a motor stands still; a steady gait needs motors that turn")
    scene = build(file, {**file.parameters, "rpm": np.asarray(rpm, float)})
    if scene.rod.topology.head is None:
        raise InputError("the robot has no head that could be tracked")
    if file.robot.count == 1 and file.motor.hinge != "published":
        return SteadySource(scene, tuple(names))
    period_of(scene)
    return OrbitSource(scene, tuple(names))


class SteadySource:
    """The gait of a steady state."""

    def __init__(self, scene: Scene, names: tuple[str, ...]) -> None:
        self.scene, self.names = scene, names
        self._found: Steady | None = None

    def in_words(self) -> str:
        return "a steady state"

    def last(self) -> tuple[Scene, State] | None:
        return None if self._found is None else (self._found.scene, self._found.state)

    def __call__(self, values: Float[np.ndarray, " k"]) -> Known:
        numbers = dict(zip(self.names, map(jnp.asarray, values), strict=True))
        found = steady_state(self.scene.replace(**numbers), self._found)
        if not found.ok:
            raise SolverError(found.message())
        self._found = found
        gait, jacobian = _of_steady(self.names, self.scene, jnp.asarray(values), found)
        return Known(np.asarray(gait), np.asarray(jacobian))


@partial(jax.jit, static_argnums=0)
def _of_steady(
    names: tuple[str, ...], scene: Scene, values: Array, known: Steady
) -> tuple[Array, Array]:
    def gait(values: Array) -> Array:
        numbers = {name: values[k] for k, name in enumerate(names)}
        return gait_of_steady(steady_as(scene.replace(**numbers), known)).packed()

    return gait(values), jax.jacfwd(gait)(values)


class OrbitSource:
    """The gait of a periodic orbit, in `STEPS` steps of time or more.

    Attributes:
        steps: of time in a turn.
    """

    def __init__(self, scene: Scene, names: tuple[str, ...]) -> None:
        self.scene, self.names = scene, names
        self.steps = STEPS
        self._found: Orbit | None = None
        self._ways: tuple[np.ndarray, np.ndarray] | None = None

    def in_words(self) -> str:
        return "a periodic orbit"

    def last(self) -> tuple[Scene, State] | None:
        return None if self._found is None else (self._found.scene, self._found.state)

    def __call__(self, values: Float[np.ndarray, " k"]) -> Known:
        numbers = {name: float(value) for name, value in zip(self.names, values, strict=True)}
        scene = self.scene.replace(**numbers)
        found = self._found = self._orbit(scene, values)
        units = TurnDerivative(found.scene, found.state, found.period, self.steps)
        static: tuple[Any, ...] = (self.names, found.enlarged, self.steps)
        now = scene, found.state, jnp.asarray(found.period), jnp.asarray(values, float)
        count = len(self.names)
        fixed = jnp.zeros((count, count))

        def product(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            ways = jnp.stack([units.whole(row) for row in rows])
            _, pushed, moved = _of_orbit(*static, *now, fixed, ways)
            return np.stack([units.of_one_size(row) for row in moved]), np.asarray(pushed)

        still = jnp.zeros((count, units.size))
        gait, along, moved = _of_orbit(*static, *now, jnp.eye(count), still)
        b = np.stack([units.of_one_size(row) for row in moved])
        z, by_way = solved(product, b, ACCURACY)
        jacobian = np.asarray(along) + by_way
        if not np.isfinite(jacobian).all():
            raise SolverError("the derivative of an orbit is not finite")
        ways = np.stack([np.asarray(units.whole(row)) for row in z])
        self._ways = np.array(values, float), ways
        return Known(np.asarray(gait), jacobian.T)

    def _orbit(self, scene: Scene, values: np.ndarray) -> Orbit:
        """The orbit, from where the last one points to, in more steps where few fail."""
        start = None
        if self._found is not None and self._ways is not None:
            before, ways = self._ways
            start = beginning(scene, self._found.state, jnp.asarray((values - before) @ ways))
        while True:
            try:
                return orbit(scene, start, steps=self.steps, tolerance=TOLERANCE)
            except SolverError:
                if start is not None:
                    start = None  # once more from rest
                elif 2 * self.steps > MOST_STEPS:
                    raise
                else:
                    self.steps *= 2


@partial(jax.jit, static_argnums=(0, 1, 2))
def _of_orbit(
    names: tuple[str, ...],
    enlarged: int,
    steps: int,
    scene: Scene,
    state: State,
    period: Array,
    values: Array,
    alongs: Float[Array, "k k"],
    ways: Float[Array, "k z"],
) -> tuple[Array, Array, Array]:
    """The gait of a turn, and how it and the end of the turn change with numbers.

    Args:
        names: of the numbers.
        enlarged: how often the lists of contacts were made longer.
        steps: of time in a turn.
        scene, state, period: of the orbit.
        values: of the numbers.
        alongs: directions in which the numbers change.
        ways: how the beginning of the turn moves with each.

    Returns:
        (g,), (k, g) and (k, z).
    """

    def turned(values: Array, z: Array) -> tuple[Array, Array]:
        numbers = {name: values[k] for k, name in enumerate(names)}
        done, time = turn_with(numbers, enlarged, scene, state, steps, period, z)
        gait = gait_of_turn(scene.rod.topology, done.states, done.turn, done.shift, time)
        return gait.packed(), done.change

    still = jnp.zeros(ways.shape[1])

    def push(along: Array, way: Array) -> Any:
        return jax.jvp(turned, (values, still), (along, way))

    (gait, _), (moved, change) = jax.vmap(push, out_axes=((None, None), (0, 0)))(alongs, ways)
    return gait, moved, change
