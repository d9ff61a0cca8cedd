"""A design problem: what may change, what is to be good, and what must be kept to."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from derjax import InputError, Scene

from .evaluate import (
    NO_NUMBERS,
    Evaluation,
    Evaluator,
    Numbers,
    Through,
    ThroughRest,
    ThroughRun,
    ThroughSteady,
)
from .quantities import Quantity
from .uncertain import Uncertain
from .variables import Variables, Vector

HELD_TOLERANCE, MOST_RATES, LARGEST_CHANGE = 1e-9, 25, 2.0
"""Of the search for the rate at which a motor has some torque or power: relative error, tries, and
the factor by which the rate may change in one of them."""

KEPT = 1e-6
"""Parts of a limit by which a design may be beyond it."""

NO_EFFECT = 1e-13
"""A variable that changes nothing by more than this part over its whole range has no effect."""


KNOWN: dict[Through, tuple[str, ...]] = {
    "steady": ("own", "shape", "motion", "eigenvalue"),
    "run": ("own", "shape", "motion", "run"),
    "rest": ("own", "shape"),
}
"""Kinds of quantities that are known through each."""


@dataclass(frozen=True)
class Limit:
    """What a quantity must keep to.

    Attributes:
        quantity: which.
        low: the smallest that it may be, in its unit; None for no such bound.
        high: the largest.
    """

    quantity: Quantity
    low: float | None = None
    high: float | None = None

    def __str__(self) -> str:
        name, unit = self.quantity.name, self.quantity.unit
        said = [] if self.low is None else [f"{name} >= {self.low:g}"]
        said += [] if self.high is None else [f"{name} <= {self.high:g}"]
        return " and ".join(said) + (f" {unit}" if unit != "1" else "")


@dataclass(frozen=True)
class Side:
    """One bound of a limit.

    Attributes:
        limit: whose.
        row: of `Point.limits` that it is for.
        sign: 1.0 for the lower bound, -1.0 for the upper one.
        bound: in the unit of the quantity.
        size: what margins are parts of.
    """

    limit: Limit
    row: int
    sign: float
    bound: float
    size: float

    def __str__(self) -> str:
        return f"{self.limit.quantity.name} {'>=' if self.sign > 0 else '<='} {self.bound:g}"


@dataclass(frozen=True)
class Held:
    """The torque or the power that the motor has, whatever the design: its rate follows.

    Attributes:
        quantity: which of them.
        value: in its unit.
    """

    quantity: Quantity
    value: float


@dataclass(frozen=True)
class Problem:
    """A design problem.

    Attributes:
        scene: built from its file.
        variables: what may change.
        objective: what is to be good.
        sign: 1.0 if large is good, -1.0 if small is.
        limits: what must be kept to.
        through: steady states, runs in time, or the shape at rest.
        begin: s, from which on means over a run are taken.
        held: what the motor is held at; None for the rate that it has.
        uncertain: parameters that are known with an uncertainty. Limits are kept to at all their
            sigma points.
    """

    scene: Scene
    variables: Variables
    objective: Quantity
    sign: float
    limits: tuple[Limit, ...] = ()
    through: Through = "steady"
    begin: float = 0.0
    held: Held | None = None
    uncertain: Uncertain | None = None

    def __post_init__(self) -> None:
        others = self.uncertain.names if self.uncertain else ()
        if twice := [name for name in others if name in self.variables.names]:
            raise InputError(f"{twice[0]}: is varied, and uncertain as well: it can be one of them")
        if self.held is not None:
            rpm = self.scene.parameters.get("rpm")
            if rpm is None:
                raise InputError(
                    "[motor] stall_torque: a design at a given torque or power finds the rate "
                    "itself; give the scene an rpm to start from"
                )
            if "rpm" in self.variables.names or "rpm" in others:
                raise InputError(
                    f"rpm: follows from the {self.held.quantity.name} that the motor is held at, "
                    "so that it cannot be varied"
                )
            if np.ndim(rpm) > 0 or float(rpm) == 0.0:
                raise InputError(
                    f"at {self.held.quantity.name}: needs one rate for all motors, not zero, to "
                    "start from ([motor] rpm)"
                )
        for quantity in self.quantities:
            if quantity.kind not in KNOWN[self.through]:
                others = [way for way, kinds in KNOWN.items() if quantity.kind in kinds]
                raise InputError(
                    f"{quantity.name}: is not known with through = {self.through!r}, but with "
                    f"{' and '.join(map(repr, others))}"
                )

    @cached_property
    def quantities(self) -> tuple[Quantity, ...]:
        """All that are asked for, each once."""
        held = () if self.held is None else (self.held.quantity,)
        every = (self.objective, *(limit.quantity for limit in self.limits), *held)
        return tuple({quantity.name: quantity for quantity in every}.values())

    def evaluator(self) -> Evaluator:
        """What finds the quantities of a design."""
        ways: dict[Through, Callable[[], Evaluator]] = {
            "steady": lambda: ThroughSteady(self.scene, self.quantities),
            "run": lambda: ThroughRun(self.scene, self.quantities, self.begin),
            "rest": lambda: ThroughRest(self.scene, self.quantities),
        }
        found = ways[self.through]()
        return found if self.held is None else _AtHeld(found, self.held, self.scene)


class _AtHeld:
    """Quantities at the rate at which the motor has a given torque or power."""

    def __init__(self, evaluator: Evaluator, held: Held, scene: Scene) -> None:
        self.evaluator, self.held = evaluator, held
        self.rpm = float(scene.parameters["rpm"])

    def __call__(self, numbers: Numbers, others: Numbers = NO_NUMBERS) -> Evaluation:
        name, target, rpm = self.held.quantity.name, self.held.value, self.rpm
        for _ in range(MOST_RATES):
            found = self.evaluator({**numbers, "rpm": rpm}, others)
            if not found.ok:
                return Evaluation({}, {}, f"at {rpm:.6g} rpm: {found.failure}")
            left, slope = found.values[name] - target, float(found.slopes[name]["rpm"])
            if abs(left) <= HELD_TOLERANCE * abs(target):
                self.rpm = rpm
                return self._following(found, rpm)
            ahead = rpm - left / slope if slope else LARGEST_CHANGE * rpm
            part = np.clip(ahead / rpm, 1 / LARGEST_CHANGE, LARGEST_CHANGE)
            rpm = float(rpm * part)
        return Evaluation(
            {}, {}, f"at no rate of the motor its {name} is {target:g} {self.held.quantity.unit}"
        )

    def _following(self, found: Evaluation, rpm: float) -> Evaluation:
        """Derivatives with the rate that follows, by the implicit function theorem."""
        held = found.slopes[self.held.quantity.name]
        numbers = [name for name in held if name != "rpm"]
        follows = {name: -held[name] / held["rpm"] for name in numbers}
        slopes = {
            name: {n: slope[n] + slope["rpm"] * follows[n] for n in numbers}
            for name, slope in found.slopes.items()
        }
        return Evaluation(found.values | {"rpm": rpm}, slopes | {"rpm": follows})


@dataclass(frozen=True)
class Point:
    """A design that has been looked at.

    Attributes:
        x: (n,) the variables, from 0 to 1.
        objective: in its unit, as the statistic that is asked for; NaN if the design failed.
        gradient: (n,) of it.
        limits: (m,) quantities with limits, each at every sigma point.
        slopes: (m, n) of those.
        values: all quantities, at the mean of what is uncertain.
        failure: why there is nothing; "" if there is.
    """

    x: Vector
    objective: float
    gradient: Vector
    limits: Float[np.ndarray, " m"]
    slopes: Float[np.ndarray, "m n"]
    values: dict[str, float] = field(default_factory=dict)
    failure: str = ""

    @property
    def ok(self) -> bool:
        return not self.failure


class Designs:
    """Looks at designs, and remembers all that it has looked at.

    Args:
        problem: that they solve.
        known: designs that have been looked at before.
        on_point: called with each that is new.
    """

    def __init__(
        self,
        problem: Problem,
        known: list[Point] | None = None,
        on_point: Callable[[Point], None] = lambda point: None,
    ) -> None:
        self.problem, self.on_point = problem, on_point
        self.evaluator = problem.evaluator()
        self.points: dict[bytes, Point] = {_key(point.x): point for point in known or []}

    def __call__(self, x: Vector) -> Point:
        """The design at some variables (n,), from 0 to 1."""
        x = np.clip(np.asarray(x, float), 0.0, 1.0)
        point = self.points.get(_key(x))
        if point is None:
            point = self._looked_at(x)
            self.points[_key(x)] = point
            self.on_point(point)
        return point

    def _looked_at(self, x: Vector) -> Point:
        problem, variables = self.problem, self.problem.variables
        numbers, uncertain = variables.numbers(x), problem.uncertain
        others = [{}]
        if uncertain is not None:
            others = [dict(zip(uncertain.names, p, strict=True)) for p in uncertain.points()[0]]
        found = []
        for more in others:
            evaluation = self.evaluator(numbers, more)
            if not evaluation.ok:
                return failed(x, len(problem.limits) * len(others), evaluation.failure)
            found.append(evaluation)

        def of(name: str) -> tuple[np.ndarray, np.ndarray]:
            values = np.array([each.values[name] for each in found])
            return values, np.stack([variables.gradient(each.slopes[name]) for each in found])

        values, slopes = of(problem.objective.name)
        if uncertain is None:
            objective, gradient = float(values[0]), slopes[0]
        else:
            objective, gradient = uncertain.statistic(values, slopes)
        limits = [of(limit.quantity.name) for limit in problem.limits]
        return Point(
            x,
            objective,
            gradient,
            np.concatenate([np.zeros(0), *(v for v, _ in limits)]),
            np.concatenate([np.zeros((0, variables.size)), *(s for _, s in limits)]),
            found[0].values,
        )

    @property
    def start(self) -> Point:
        """The scene as it is."""
        variables = self.problem.variables
        return self(variables.vector(variables.start))

    @cached_property
    def sides(self) -> list[Side]:
        """The bounds of all limits, at every sigma point."""
        problem, found = self.problem, []
        count = 1 if problem.uncertain is None else len(problem.uncertain.points()[0])
        for k, limit in enumerate(problem.limits):
            size = max(abs(limit.low or 0.0), abs(limit.high or 0.0)) or 1.0
            for row in range(k * count, (k + 1) * count):
                for sign, bound in ((1.0, limit.low), (-1.0, limit.high)):
                    found += [] if bound is None else [Side(limit, row, sign, bound, size)]
        return found

    def margins(self, point: Point) -> Float[np.ndarray, " s"]:
        """How much is left to every bound, in parts of it; zero for a design that failed."""
        if not point.ok:
            return np.zeros(len(self.sides))
        return np.array([s.sign * (point.limits[s.row] - s.bound) / s.size for s in self.sides])

    def margin_slopes(self, point: Point) -> Float[np.ndarray, "s n"]:
        """The derivatives of `margins` by the variables."""
        if not point.ok:
            return np.zeros((len(self.sides), len(point.x)))
        slopes = [s.sign * point.slopes[s.row] / s.size for s in self.sides]
        return np.array(slopes).reshape(-1, len(point.x))

    def keeps(self, point: Point) -> bool:
        """Whether a design is one, and keeps to all limits."""
        return point.ok and bool(np.all(self.margins(point) >= -KEPT))

    def best(self, points: Iterable[Point] | None = None) -> Point | None:
        """The best of some designs, or of all, that keep to all limits."""
        every = self.points.values() if points is None else points
        good = [point for point in every if self.keeps(point)]
        return max(good, key=lambda point: self.problem.sign * point.objective, default=None)

    def numbers(self, point: Point) -> dict[str, Any]:
        """All parameters in which the scene of a design differs, a rate that follows included."""
        held = {} if self.problem.held is None else {"rpm": point.values["rpm"]}
        return self.problem.variables.numbers(point.x) | held


def failed(x: Vector, limits: int, why: str) -> Point:
    """A design of which nothing is known but why."""
    n, nan = len(x), float("nan")
    return Point(x, nan, np.full(n, nan), np.full(limits, nan), np.full((limits, n), nan), {}, why)


def check_effects(problem: Problem, point: Point) -> None:
    """Refuses variables on which nothing depends, and objectives that depend on none.

    Raises:
        InputError: naming them.
    """
    scale = np.concatenate([[point.objective], point.limits])
    slopes = np.concatenate([point.gradient[None], point.slopes])
    idle = np.all(np.abs(slopes) <= NO_EFFECT * np.abs(scale)[:, None], axis=0)
    names = [problem.objective.name, *(limit.quantity.name for limit in problem.limits)]
    if np.all(np.abs(point.gradient) <= NO_EFFECT * abs(point.objective)):
        raise InputError(
            f"{problem.objective.name}: does not change with {', '.join(problem.variables.names)}; "
            "if it should, it is not differentiable"
        )
    if np.any(idle):
        which = [label for label, no in zip(problem.variables.labels, idle, strict=True) if no]
        raise InputError(
            f"[vary] {which[0]}: has no effect on {', '.join(dict.fromkeys(names))}; leave it out"
        )


def _key(x: Vector) -> bytes:
    return np.asarray(x, float).tobytes()
