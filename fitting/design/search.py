"""The search for the best design: a kept optimiser, from several starts.

Everything is in units of one size: variables from 0 to 1, the objective over its size at the start,
quantities with limits over these. A design that fails counts as bad, so that a step that led
there is shortened.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import jax.numpy as jnp
import numpy as np

from derjax import InputError, SolverError

from .problem import Designs, Point, check_effects
from .variables import Vector

if TYPE_CHECKING:  # slow to import
    from scipy.optimize import NonlinearConstraint

Method = Literal["slsqp", "trust-constr", "adam"]

BAD = 1e3
"""What a design that fails has for an objective that is about -1 where it is good."""


class Stop(Exception):
    """The search is to end here."""


@dataclass(frozen=True)
class Search:
    """How to look for the best design.

    Attributes:
        method: SciPy's "slsqp" or "trust-constr", or optax's "adam", which knows no limits.
        starts: how many; the first is the scene as it is.
        most: iterations from each.
        tolerance: of the objective, relative to its size.
        seed: of the other starts.
    """

    method: Method = "slsqp"
    starts: int = 4
    most: int = 60
    tolerance: float = 1e-8
    seed: int = 0


@dataclass(frozen=True)
class Attempt:
    """What came of one start.

    Attributes:
        start: the design it began with.
        end: the best design that it came to and that keeps to all limits; None if there is none.
        status: "converged", "max_iterations", "stalled", "failed" or "interrupted".
        message: of the optimiser, or why the start failed.
        path: all designs that it looked at, in order.
    """

    start: Point
    end: Point | None
    status: str
    message: str
    path: tuple[Point, ...]


class _Scaled:
    """The designs as an optimiser sees them: numbers of size one, to be made small."""

    def __init__(self, designs: Designs, size: float) -> None:
        self.designs, self.size = designs, size
        self.sign = designs.problem.sign
        self.path: list[Point] = []

    def point(self, x: Vector) -> Point:
        point = self.designs(x)
        if not self.path or self.path[-1] is not point:
            self.path.append(point)
        return point

    def objective(self, x: Vector) -> float:
        point = self.point(x)
        return -self.sign * point.objective / self.size if point.ok else BAD

    def gradient(self, x: Vector) -> Vector:
        point = self.point(x)
        return -self.sign * point.gradient / self.size if point.ok else np.zeros_like(x)

    def margins(self, x: Vector) -> np.ndarray:
        return self.designs.margins(self.point(x))

    def margin_slopes(self, x: Vector) -> np.ndarray:
        return self.designs.margin_slopes(self.point(x))


def starts_of(designs: Designs, search: Search) -> list[Vector]:
    """Where to start: the scene as it is, and others spread over the bounds."""
    variables = designs.problem.variables
    first = variables.vector(variables.start)
    if search.starts == 1:
        return [first]
    from scipy.stats import qmc  # slow to import

    power = int(np.ceil(np.log2(search.starts)))
    spread = qmc.Sobol(variables.size, rng=np.random.default_rng(search.seed)).random_base2(power)
    return [first, *spread[: search.starts - 1]]


def searched(designs: Designs, search: Search) -> Iterator[Attempt]:
    """What comes of every start, one after the other.

    Raises:
        InputError: variables without effect, or a method that cannot take limits.
        SolverError: every start fails.
        Stop: one of the designs has asked for it.
    """
    if search.method == "adam" and designs.problem.limits:
        raise InputError("[search] method = 'adam': knows no constraints; 'slsqp' does")
    failures, checked = [], False
    for x in starts_of(designs, search):
        start = designs(x)
        if start.ok and not checked:
            check_effects(designs.problem, start)
            checked = True
        failures += [] if start.ok else [start.failure]
        attempt = attempted(designs, search, start)
        yield attempt
        if attempt.status == "interrupted":
            raise Stop
    if not checked:
        raise SolverError(f"every start fails; the scene as it is: {failures[0]}")


def attempted(designs: Designs, search: Search, start: Point) -> Attempt:
    """The search from one start."""
    if not start.ok:
        return Attempt(start, None, "failed", start.failure, (start,))
    size = abs(start.objective) or 1.0
    scaled = _Scaled(designs, size)
    try:
        status, message = (
            _adam(scaled, search, start.x)
            if search.method == "adam"
            else _scipy(scaled, search, start.x)
        )
    except (Stop, KeyboardInterrupt):
        status, message = "interrupted", "stopped"
    return Attempt(start, designs.best(scaled.path), status, message, tuple(scaled.path))


def _scipy(scaled: _Scaled, search: Search, x: Vector) -> tuple[str, str]:
    from scipy.optimize import minimize

    kept = [_not_negative(scaled.margins, scaled.margin_slopes)] if scaled.designs.sides else []
    options: dict[str, Any] = {"maxiter": search.most}
    if search.method == "slsqp":
        options["ftol"] = search.tolerance
    else:
        options |= {"gtol": search.tolerance, "xtol": search.tolerance}
    found = minimize(
        scaled.objective,
        x,
        jac=scaled.gradient,
        bounds=[(0.0, 1.0)] * len(x),
        constraints=kept,
        method={"slsqp": "SLSQP", "trust-constr": "trust-constr"}[search.method],
        options=options,
    )
    if found.success or (search.method == "trust-constr" and found.status in (1, 2)):
        return "converged", str(found.message)
    over = found.nit >= search.most
    return ("max_iterations" if over else "stalled"), str(found.message)


def _not_negative(left: Callable[[Vector], np.ndarray], slopes: Any) -> "NonlinearConstraint":
    from scipy.optimize import NonlinearConstraint

    return NonlinearConstraint(left, 0.0, np.inf, jac=slopes)


ADAM_RATE = 0.05
"""Of the range of a variable: about the first step."""


def _adam(scaled: _Scaled, search: Search, x: Vector) -> tuple[str, str]:
    """Adam with a cosine schedule, kept within the bounds; after a failure from the best again."""
    import optax  # slow to import

    schedule = optax.cosine_decay_schedule(-ADAM_RATE, search.most, alpha=0.02)
    adam = optax.chain(optax.scale_by_adam(), optax.scale_by_schedule(schedule))
    now, memory = jnp.asarray(x), adam.init(jnp.asarray(x))
    best, lowest = now, np.inf
    for _ in range(search.most):
        point = scaled.point(np.asarray(now))
        if not point.ok:
            now = 0.5 * (now + best)
            continue
        if (value := scaled.objective(np.asarray(now))) < lowest:
            best, lowest = now, value
        step, memory = adam.update(jnp.asarray(scaled.gradient(np.asarray(now))), memory)
        now = jnp.clip(now + jnp.asarray(step), 0.0, 1.0)
    return "converged", f"{search.most} steps"


def nearest_to_limits(designs: Designs, most: int) -> Point:
    """The design whose worst margin is the best, looked for from the best that is known."""
    from scipy.optimize import minimize

    scaled = _Scaled(designs, 1.0)

    def worst(point: Point) -> float:
        return float(np.min(designs.margins(point)))

    nearest = max((p for p in designs.points.values() if p.ok), key=worst)

    def margins(z: Vector) -> np.ndarray:
        return scaled.margins(z[:-1]) + z[-1]

    def slopes(z: Vector) -> np.ndarray:
        return np.pad(scaled.margin_slopes(z[:-1]), ((0, 0), (0, 1)), constant_values=1.0)

    minimize(
        lambda z: z[-1],
        [*nearest.x, -worst(nearest)],
        jac=lambda z: np.append(np.zeros(len(z) - 1), 1.0),
        bounds=[(0.0, 1.0)] * len(nearest.x) + [(0.0, None)],
        constraints=[_not_negative(margins, slopes)],
        method="SLSQP",
        options={"maxiter": most},
    )
    return max((nearest, *(p for p in scaled.path if p.ok)), key=worst)


def contradiction(designs: Designs, nearest: Point) -> str:
    """Which limits cannot be kept to together: those that share the worst margin where it is best.

    Args:
        designs: none of which keeps to all limits.
        nearest: the one that comes nearest to it.
    """
    margins = designs.margins(nearest)
    at_fault = [
        f"{side} (there {nearest.limits[side.row]:.4g})"
        for side, margin in zip(designs.sides, margins, strict=True)
        if margin <= SHARED * np.min(margins)
    ]
    numbers = designs.numbers(nearest)
    place = ", ".join(f"{k} = {v:.4g}" for k, v in numbers.items() if np.ndim(v) == 0)
    which = " and ".join(dict.fromkeys(at_fault))
    return f"no design within the bounds keeps to {which}; the nearest has {place}"


SHARED = 0.9
"""Margins that are so many times the worst are counted as that."""
