"""Branches of steady states or equilibria, followed around folds by pseudo-arclength.

A branch is a curve in the space of the unknowns z and one parameter p. From a point on it, and in
the direction of its tangent, Newton's method looks for the next one at a given distance,

    F(z, p) = 0,   tangent . (z - z0, p - p0) = distance,

which has a solution also where the branch turns back in p (Keller 1977). Lengths are measured over
that of the rod, and parameters over the range that is asked for.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..core.pytree import pytree
from ..core.status import Status
from ..integrate.step import Scene
from .equilibrium import still
from .motion import Symmetry, symmetry_of
from .solve import ROUNDING, Equations, Steady, newton, solved_by, steady, unknowns_of
from .stability import Threshold, stability, threshold

FIRST, SMALLEST, LONGEST = 0.02, 1e-6, 0.1
"""Distances between points."""

QUICK = 6
"""Newton steps: after fewer the next point may be farther away."""


@dataclass(frozen=True)
class Branch:
    """Points along a branch, in order.

    Attributes:
        name: of the parameter that changes along it.
        values: (n,) of that parameter.
        states: the n steady states.
        folds: numbers of the points at which the branch turns back in the parameter.
        message: how it ended.
        complete: whether it reached the end of the range, on either side.
    """

    name: str
    values: Float[np.ndarray, " n"]
    states: tuple[Steady, ...]
    folds: tuple[int, ...]
    message: str
    complete: bool

    def growth_rates(self) -> Float[np.ndarray, " n"]:
        """1/s, of the leading mode at every point."""
        return np.array([stability(state).growth_rate for state in self.states])

    def thresholds(self) -> tuple[Threshold, ...]:
        """Where the leading mode begins to grow, or to decay, on the way along the branch.

        Not between points that have a fold between them: there a mode changes its sign at the fold.
        """
        growth, found = self.growth_rates(), []
        for k in np.flatnonzero(np.sign(growth[:-1]) != np.sign(growth[1:])):
            if {int(k), int(k) + 1} & set(self.folds):
                continue
            part = growth[k] / (growth[k] - growth[k + 1])
            near = self.values[k] + part * (self.values[k + 1] - self.values[k])
            state = self.states[k]
            found.append(threshold(state.scene, self.name, float(near), known=state))
        return tuple(found)


@pytree
class _Point:
    """A point of a branch: unknowns, parameter over its range, tangent, and how it was found."""

    y: Float[Array, " m"]
    tangent: Float[Array, " m"]
    status: Array
    tries: Array
    residual: Array


@dataclass(frozen=True)
class _Family:
    """Scenes that differ in one parameter; what stays the same in all programs for them."""

    name: str
    held: bool

    def equations(self, scene: Scene, symmetry: Symmetry, value: Array) -> Equations:
        scene = scene.replace(**{self.name: value})
        return still(scene) if self.held else Equations(scene, symmetry)


class _Extended:
    """The equations of a branch, with the distance from the point before."""

    def __init__(self, family: _Family, scene: Scene, symmetry: Symmetry, scale: Array) -> None:
        self.family, self.scene, self.symmetry, self.scale = family, scene, symmetry, scale

    def forces(self, y: Array, before: Array) -> Array:
        """What should vanish but for the distance; unknowns in units of `scale`."""
        y, before = y * self.scale, before * self.scale
        equations = self.family.equations(self.scene, self.symmetry, y[-1])
        return equations.near(lax.stop_gradient(before[:-1])).residual(y[:-1])

    def stiffness(self, y: Array) -> Array:
        """The part of their derivative that changes quickly."""
        scaled = y * self.scale
        equations = self.family.equations(self.scene, self.symmetry, scaled[-1])
        by_unknowns = equations.stiffness(scaled[:-1]) * self.scale[:-1]
        return jnp.pad(by_unknowns, (0, 1))

    def through(self, start: Array, tangent: Array) -> "_Plane":
        return _Plane(self, start, tangent)


@dataclass(frozen=True)
class _Plane:
    """Points of a branch at some distance from one of its points."""

    branch: _Extended
    start: Array
    tangent: Array

    def residual(self, z: Array, part: Array) -> Array:
        """Forces, and how far z is from the distance `part`."""
        ahead = self.tangent @ (z - self.start) - part
        return jnp.append(self.branch.forces(z, self.start), ahead)

    def stiffness(self, z: Array, part: Array) -> Array:
        """The same for every distance."""
        return self.branch.stiffness(z)


@partial(jax.jit, static_argnums=0)
def _next(
    family: _Family,
    scene: Scene,
    symmetry: Symmetry,
    scale: Array,
    start: Array,
    tangent: Array,
    distance: Array,
) -> _Point:
    """The point at some distance from one that is known, and the tangent there."""
    plane = _Extended(family, scene, symmetry, scale).through(start, tangent)
    tolerance = scene.newton.tolerance
    found = newton(plane, start + distance * tangent, distance, tolerance)
    good = found.size <= ROUNDING * tolerance
    status = jnp.where(good, Status.OK, Status.MAX_ITERATIONS).astype(jnp.int32)
    matrix = jax.jacfwd(plane.residual)(found.z, distance)
    along = jnp.linalg.solve(matrix, jnp.zeros_like(start).at[-1].set(1.0))
    return _Point(found.z, along / jnp.linalg.norm(along), status, found.tries, found.size)


@partial(jax.jit, static_argnums=0)
def _state(
    family: _Family, scene: Scene, symmetry: Symmetry, scale: Array, point: _Point
) -> Steady:
    y = point.y * scale
    equations = family.equations(scene, symmetry, y[-1])
    found = equations.checked((y[:-1], jnp.ones(()), point.status, point.tries, point.residual))
    return solved_by(equations, found)


def branch(
    scene: Scene,
    name: str,
    stop: float,
    known: Steady | None = None,
    *,
    most: int = 500,
    longest: float = LONGEST,
) -> Branch:
    """The branch of steady states through that of a scene, as one parameter changes.

    It is followed around folds, until the parameter reaches `stop`, or comes back to where it
    started from. On the host: not for scenes that JAX traces.

    Args:
        scene: where the branch starts; a robot that swims, or with `known` an equilibrium.
        name: of the parameter.
        stop: value of the parameter at which to end.
        known: the steady state, or the equilibrium, of the scene; None to find the first.
        most: points.
        longest: distance between points: a tenth is, for one, a tenth of the range of the
            parameter.

    Returns:
        The points, folds among them; `message` says how it ended.

    Raises:
        KeyError: a parameter that the scene does not have.
        SolverError: there is no steady state to start from.
    """
    first = scene.number(name)
    if known is None:
        known = steady(scene)
    known.raise_if_failed()
    held = known.scene.motor is None
    family = _Family(name, held)
    symmetry = known.symmetry if held else symmetry_of(scene)
    equations = still(scene) if held else Equations(scene, symmetry)
    z = unknowns_of(equations, known)
    scale = _scales(equations, z, abs(stop - first))
    walk = _Walk(family, scene, symmetry, scale, longest)
    y = jnp.append(z, first) / scale
    ahead = jnp.zeros_like(y).at[-1].set(jnp.sign(stop - first))
    points = walk.points(y, ahead, stop / float(scale[-1]), most)
    found = [(point, fold) for point, fold in points]
    states = tuple(_state(family, scene, symmetry, scale, point) for point, _ in found)
    values = np.array([float(point.y[-1] * scale[-1]) for point, _ in found])
    folds = tuple(k for k, (_, fold) in enumerate(found) if fold)
    return Branch(name, values, states, folds, walk.message, walk.complete)


def _scales(equations: Equations, z: Array, span: float) -> Array:
    """What unknowns are measured in: lengths, angles, velocities, the range of the parameter."""
    topology = equations.scene.rod.topology
    length = float(jnp.sum(equations.scene.rod.rest_length))
    many = np.sqrt(len(equations.free))
    q = np.where(equations.free < 3 * topology.n_nodes, length, 1.0) * many
    rate = max(abs(float(equations.rate(1.0))), 1e-9)
    symmetry = equations.symmetry
    motion = [length * rate] * (3 if symmetry.moves else 0) + [rate] * len(symmetry.axes)
    return jnp.asarray(np.concatenate([q, motion, [span]]))


class _Walk:
    """Along a branch, point by point."""

    def __init__(
        self, family: _Family, scene: Scene, symmetry: Symmetry, scale: Array, longest: float
    ) -> None:
        self.fixed = family, scene, symmetry, scale
        self.longest = longest
        self.message, self.complete = "", False

    def next(self, point: _Point, distance: float) -> _Point:
        return _next(*self.fixed, point.y, point.tangent, jnp.asarray(distance))

    def points(
        self, y: Array, tangent: Array, stop: float, most: int
    ) -> Iterator[tuple[_Point, bool]]:
        """Points, and whether each is a fold."""
        here = _next(*self.fixed, y, tangent, jnp.zeros(()))
        begin, distance = float(here.y[-1]), min(FIRST, self.longest)
        low, high = min(begin, stop), max(begin, stop)
        yield here, False
        for _ in range(most):
            ahead = self.next(here, distance)
            while not self.good(here, ahead):
                distance *= 0.4
                if distance < SMALLEST:
                    self.message = "the branch could not be followed any further"
                    return
                ahead = self.next(here, distance)
            if float(here.tangent[-1]) * float(ahead.tangent[-1]) < 0.0:
                yield self.fold(here, ahead, distance), True
            value = float(ahead.y[-1])
            if not low <= value <= high:
                end = stop if abs(value - stop) < abs(value - begin) else begin
                yield self.at(here, ahead, distance, end), False
                self.complete = True
                self.message = "reached the end" if end == stop else "came back to the start"
                return
            yield ahead, False
            if int(ahead.tries) <= QUICK:
                distance = min(1.6 * distance, self.longest)
            here = ahead
        self.message = f"ended after {most} points"

    def good(self, here: _Point, ahead: _Point) -> bool:
        """Whether a point is one, and follows on the one before: else it may be another branch."""
        same_way = float(here.tangent @ ahead.tangent) > 0.5
        return int(ahead.status) == Status.OK and same_way

    def fold(self, here: _Point, ahead: _Point, distance: float) -> _Point:
        """Where the tangent has no part along the parameter."""
        return self.located(here, ahead, distance, lambda point: float(point.tangent[-1]))

    def at(self, here: _Point, ahead: _Point, distance: float, value: float) -> _Point:
        """Where the parameter has some value."""
        return self.located(here, ahead, distance, lambda point: float(point.y[-1]) - value)

    def located(self, here: _Point, ahead: _Point, distance: float, function: Any) -> _Point:
        """Where a function of points vanishes between two of them, by regula falsi (Illinois)."""
        low, high = (0.0, function(here)), (distance, function(ahead))
        point = ahead
        for _ in range(30):
            middle = (low[0] * high[1] - high[0] * low[1]) / (high[1] - low[1])
            point = self.next(here, middle)
            value = function(point)
            if abs(value) < 1e-10 or abs(high[0] - low[0]) < 1e-12:
                break
            low = high if value * high[1] < 0.0 else (low[0], 0.5 * low[1])
            high = middle, value
        return point
