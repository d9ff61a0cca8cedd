"""The quantities of a design, and their derivatives by its numbers.

Through a steady state, by the implicit function theorem, or through a run in time. Whether a
rollout is differentiated in forward or in reverse mode depends on how many numbers and how many
quantities there are.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any, Literal, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from derjax import (
    InputError,
    Scene,
    SolverError,
    Status,
    Steady,
    rollout,
    stability,
    steady,
    threshold,
)
from derjax.integrate.frames import RolloutStats
from derjax.integrate.step import enlarge
from derjax.steady.solve import steady_as
from derjax.steady.stability import growth_slopes

from .motion import Rest, RunMotion, SteadyMotion
from .quantities import Quantity

Through = Literal["steady", "run", "rest"]
Numbers = Mapping[str, Any]
"""Parameters of a scene by name: single numbers, or arrays."""

NO_NUMBERS: Numbers = MappingProxyType({})

Functions = tuple[Callable[[Any], Array], ...]
"""Of a motion, to one number each."""

Slopes = tuple[Float[Array, " q"], dict[str, Array]]
"""Values of functions, and their derivatives by numbers, with a leading axis of functions."""

REVERSE_COSTS = 12
"""Derivatives by so many numbers in forward mode cost what those of one quantity cost in reverse
mode (`benchmarks/gradient_cost.py`)."""


@dataclass(frozen=True)
class Evaluation:
    """What a design achieves.

    Attributes:
        values: of the quantities, by name; empty if there is none.
        slopes: derivatives of each by each of the numbers, in their shapes.
        failure: why there is none; "" if there is.
    """

    values: dict[str, float]
    slopes: dict[str, dict[str, np.ndarray]]
    failure: str = ""

    @property
    def ok(self) -> bool:
        """Whether there are values."""
        return not self.failure


class Evaluator(Protocol):
    """Finds the quantities of a scene with some of its numbers replaced.

    Nothing is differentiated by the `others`: designs of one scene and of others that are like it
    share a compiled program.
    """

    def __call__(self, numbers: Numbers, others: Numbers = NO_NUMBERS) -> Evaluation: ...


class ThroughRest:
    """Quantities of robots that do not move, such as their resistance in the fluid."""

    def __init__(self, scene: Scene, quantities: Sequence[Quantity]) -> None:
        self.scene, self.quantities = scene, quantities

    def __call__(self, numbers: Numbers, others: Numbers = NO_NUMBERS) -> Evaluation:
        if wrong := _cannot_be(self.scene, {**numbers, **others}):
            return wrong
        functions = tuple(q.function for q in self.quantities)
        found = _rest_slopes(functions, self.scene.replace(**others), _arrays(numbers))
        return _evaluation([q.name for q in self.quantities], numbers, *found)


@partial(jax.jit, static_argnums=0)
def _rest_slopes(functions: Functions, scene: Scene, numbers: dict[str, Array]) -> Slopes:
    return _in_forward_mode(functions, lambda p: Rest(scene.replace(**p)), numbers)


class ThroughSteady:
    """Quantities of steady states. Each is looked for from the nearest one that is known.

    Args:
        scene: with one motor of constant rate.
        quantities: of motions and eigenvalues.
    """

    def __init__(self, scene: Scene, quantities: Sequence[Quantity]) -> None:
        self.scene = scene
        self.of_motion = [q for q in quantities if q.function is not None]
        self.eigenvalues = [q.name for q in quantities if q.function is None]
        self._known: list[tuple[np.ndarray, Steady]] = []
        self._limit: float | None = None

    def state(self, numbers: Numbers) -> Steady:
        """The steady state, with its status."""
        place = np.concatenate([np.ravel(value) for value in numbers.values()])
        alike = [known for known in self._known if known[0].shape == place.shape]
        near = min(alike, key=lambda k: float(_apart(k[0], place)), default=(None, None))
        found = steady(self.scene.replace(**numbers), near[1])
        if found.ok:
            self._known = [*self._known[-MOST_KNOWN:], (place, found)]
        return found

    def __call__(self, numbers: Numbers, others: Numbers = NO_NUMBERS) -> Evaluation:
        if wrong := _cannot_be(self.scene, {**numbers, **others}):
            return wrong
        functions = tuple(q.function for q in self.of_motion)
        try:
            state = self.state({**numbers, **others})
            state.raise_if_failed()
            found = _steady_slopes(functions, state, _arrays(numbers))
            evaluation = _evaluation([q.name for q in self.of_motion], numbers, *found)
            for name in self.eigenvalues if evaluation.ok else ():
                value, slopes = self._eigenvalue(name, state, list(numbers))
                evaluation.values[name] = value
                evaluation.slopes[name] = {k: np.asarray(v) for k, v in slopes.items()}
        except SolverError as error:
            return _failed(error)
        return evaluation

    def _eigenvalue(
        self, name: str, state: Steady, numbers: list[str]
    ) -> tuple[float, dict[str, float]]:
        """A growth rate, or the rate of the motor at which it vanishes, and its derivatives."""
        if name == "growth_rate":
            modes = stability(state)
            return modes.growth_rate, growth_slopes(modes, numbers)
        start = self._limit or 60 / (2 * np.pi) * float(state.motor_rate)
        limit = threshold(state.scene, "rpm", start=start)
        self._limit = limit.value
        slopes = limit.derivatives([number for number in numbers if number != "rpm"])
        return limit.value, {"rpm": 0.0, **slopes} if "rpm" in numbers else slopes


MOST_KNOWN = 64
"""Steady states that are kept to start from."""


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    """How far two designs are from each other, relative to each number."""
    return float(np.sum(((a - b) / np.maximum(np.abs(a) + np.abs(b), 1e-300)) ** 2))


@partial(jax.jit, static_argnums=0)
def _steady_slopes(functions: Functions, state: Steady, numbers: dict[str, Array]) -> Slopes:
    def motion(p: dict[str, Array]) -> SteadyMotion:
        return SteadyMotion(steady_as(state.scene.replace(**p), state))

    return _in_forward_mode(functions, motion, numbers)


def _in_forward_mode(
    functions: Functions, motion: Callable[[dict[str, Array]], Any], numbers: dict[str, Array]
) -> Slopes:
    """Functions of a motion, and their derivatives by the numbers that it is of."""

    def of(numbers: dict[str, Array]) -> tuple[Array, Array]:
        found = motion(numbers)
        values = jnp.stack([function(found) for function in functions])
        return values, values

    slopes, values = jax.jacfwd(of, has_aux=True)(numbers)
    return values, slopes


class ThroughRun:
    """Quantities of runs in time, from the scene's start to the end that its file has.

    Args:
        scene: built from a scene file.
        quantities: of motions and runs.
        begin: s, from which on means are taken.
    """

    def __init__(self, scene: Scene, quantities: Sequence[Quantity], begin: float) -> None:
        file = scene.source.file
        self.scene, self.quantities = scene, quantities
        self.first = min(round(begin / (file.step * file.steps_per_frame)), file.n_frames - 1)
        self.enlargements = 0

    def __call__(self, numbers: Numbers, others: Numbers = NO_NUMBERS) -> Evaluation:
        if wrong := _cannot_be(self.scene, {**numbers, **others}):
            return wrong
        functions = tuple(q.function for q in self.quantities)
        scene = self.scene.replace(**others)
        while True:
            values, slopes, stats = run_slopes(
                functions, self.first, self.enlargements, scene, _arrays(numbers)
            )
            if stats.status != Status.CAPACITY:
                break
            self.enlargements += 1
        if not stats.ok:
            return Evaluation({}, {}, stats.message())
        return _evaluation([q.name for q in self.quantities], numbers, values, slopes)


@partial(jax.jit, static_argnums=(0, 1, 2))
def run_slopes(
    functions: Functions, first: int, enlargements: int, scene: Scene, numbers: dict[str, Array]
) -> tuple[Float[Array, " q"], dict[str, Array], RolloutStats]:
    """Functions of a run, their derivatives by some numbers, and how the steps went.

    Args:
        functions: of a `RunMotion`.
        first: the frame from which on means are taken.
        enlargements: how often lists of contacts are made twice as long.
        scene: built from a scene file.
        numbers: that are replaced, and differentiated by.
    """
    entries = sum(leaf.size for leaf in jax.tree.leaves(numbers))
    forward = entries <= REVERSE_COSTS * len(functions)

    def of(numbers: dict[str, Array]) -> tuple[Array, tuple[Array, RolloutStats]]:
        here = scene.replace(**numbers)
        for _ in range(enlargements):
            here = enlarge(here)
        run = rollout(here, reverse_mode=not forward)
        values = jnp.stack([function(RunMotion(run, first)) for function in functions])
        return values, (values, run.stats)

    if forward:
        slopes, (values, stats) = jax.jacfwd(of, has_aux=True)(numbers)
        return values, slopes, stats
    values, back, (_, stats) = jax.vjp(of, numbers, has_aux=True)
    (slopes,) = lax.map(back, jnp.eye(len(functions)))  # one after the other: memory for one
    return values, slopes, stats


def _arrays(numbers: Numbers) -> dict[str, Array]:
    return {name: jnp.asarray(value, float) for name, value in numbers.items()}


def _evaluation(
    names: list[str], numbers: Numbers, values: Array, slopes: dict[str, Array]
) -> Evaluation:
    """Values and slopes by name, if all of them are numbers."""
    found = dict(zip(names, np.asarray(values).tolist(), strict=True))
    by_name = {
        name: {number: np.asarray(slopes[number])[k] for number in numbers}
        for k, name in enumerate(names)
    }
    for name in names:
        if not np.isfinite(found[name]):
            return Evaluation({}, {}, f"{name} is {found[name]}")
        for number, slope in by_name[name].items():
            if not np.all(np.isfinite(slope)):
                return Evaluation({}, {}, f"the derivative of {name} by {number} is not finite")
    return Evaluation(found, by_name)


def _cannot_be(scene: Scene, numbers: Numbers) -> Evaluation | None:
    """Why there is no robot with these numbers, which are not known while JAX traces them."""
    try:
        scene.replace(**numbers)
    except InputError as error:
        return _failed(error)
    return None


def _failed(error: Exception) -> Evaluation:
    return Evaluation({}, {}, str(error))
