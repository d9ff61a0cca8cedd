"""Designing a robot: from a problem to its best design, and what that is worth."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from derjax import InputError, Scene, SceneFile, SolverError, build, stability, steady

from .evaluate import Through
from .motion import SteadyMotion
from .problem import Designs, Held, Limit, Point, Problem
from .quantities import Direction, Quantity, from_function, named
from .search import (
    Attempt,
    Search,
    Stop,
    attempted,
    contradiction,
    nearest_to_limits,
    searched,
)
from .uncertain import Uncertain
from .variables import variables_of

DRAWS = 200
"""Of uncertain parameters, to see how the objective of the best design spreads."""

CURVATURE_STEP, MOST_CURVED = 0.01, 12
"""Of the differences of gradients that tell curvatures, in units of the ranges of the variables;
and the largest number of variables for which they are found."""

COST = 0.01
"""Part of the objective that a deviation of manufacture may cost."""


@dataclass(frozen=True)
class Sensitivity:
    """What becomes of the objective where one number is not quite that of the best design.

    Attributes:
        slope: of the objective, per unit of the number; zero at an optimum within the bounds.
        curvature: per its square.
        tolerance: by how much the number may be off for the objective to change by 1 %.
    """

    slope: float
    curvature: float
    tolerance: float


@dataclass(frozen=True)
class Design:
    """The best design met.

    Attributes:
        problem: that it solves.
        values: of the variables, by name, in the units of the scene.
        objective: of the best design, in its unit.
        quantities: all that were asked for, of the best design.
        start: the design that was started with; None if that fails.
        best: the best design.
        binding: the limits that it is at.
        at_bounds: the variables that are at a bound.
        attempts: from every start.
        points: all designs that were looked at.
        status: "converged"; "max_iterations"; "stalled"; "interrupted".
        sensitivities: of the objective at the best design, by variable.
        spread: of the objective over draws of uncertain parameters; empty without them.
        warnings: sentences on what speaks against taking the design as it stands.
    """

    problem: Problem
    values: dict[str, Any]
    objective: float
    quantities: dict[str, float]
    start: Point | None
    best: Point
    binding: tuple[str, ...]
    at_bounds: tuple[str, ...]
    attempts: tuple[Attempt, ...]
    points: tuple[Point, ...]
    status: str
    sensitivities: dict[str, Sensitivity]
    spread: Float[np.ndarray, " c"]
    warnings: tuple[str, ...]

    @property
    def numbers(self) -> dict[str, Any]:
        """All parameters in which it differs from the scene: a rate that follows, too."""
        if self.problem.held is None:
            return self.values
        return self.values | {"rpm": self.quantities["rpm"]}

    @property
    def scene(self) -> Scene:
        """The best design as a scene."""
        return self.problem.scene.replace(**self.numbers)


Objective = str | Quantity | Callable[[Any], Any]
"""A quantity by its name, or a function of a `derjax.Steady`, `Run` or, at rest, `Scene`."""

Bounds = tuple[float | None, float | None]


def design(
    scene: Scene,
    vary: Mapping[str, tuple[float, float]],
    *,
    maximise: Objective | None = None,
    minimise: Objective | None = None,
    limits: Mapping[str, Bounds] | Sequence[tuple[Objective, Bounds]] = (),
    through: Through = "steady",
    begin: float = 0.0,
    direction: Direction | None = None,
    at: tuple[str, float] | None = None,
    uncertain: Uncertain | None = None,
    search: Search | None = None,
) -> Design:
    """The numbers of a scene, within bounds, that make an objective as good as can be.

    Gradients are exact, through steady states or through runs in time. See `quantities` for what
    has a name.

    Args:
        scene: built from a scene file; its numbers are the first start.
        vary: (low, high) of each parameter that may change, as `{"pitch": (0.03, 0.08)}`.
        maximise: the objective; or
        minimise: the objective.
        limits: (low, high) of quantities, None for no bound, as `{"torque": (None, 2e-3)}`.
        through: "steady", for robots with one flagellum; "run": from the scene's start to its
            end, through contact and all else; or "rest", where nothing moves.
        begin: s, from which on means over a run are taken.
        direction: of objectives that have one.
        at: "torque" or "power", and its value, that the motor has whatever the design; its rate
            follows.
        uncertain: parameters that are known with an uncertainty.
        search: how to look for it.

    Raises:
        InputError: what was asked for cannot be, such as limits that contradict each other.
        SolverError: no start can be simulated.
    """
    problem = problem_of(
        scene, vary, maximise, minimise, limits, through, begin, direction, at, uncertain
    )
    return solved(Designs(problem), search or Search())


def problem_of(
    scene: Scene,
    vary: Mapping[str, tuple[float, float]],
    maximise: Objective | None,
    minimise: Objective | None,
    limits: Mapping[str, Bounds] | Sequence[tuple[Objective, Bounds]] = (),
    through: Through = "steady",
    begin: float = 0.0,
    direction: Direction | None = None,
    at: tuple[str, float] | None = None,
    uncertain: Uncertain | None = None,
) -> Problem:
    """The problem that the arguments of `design` state.

    Raises:
        InputError: it cannot be stated.
    """
    given = [each for each in (maximise, minimise) if each is not None]
    if len(given) != 1:
        raise InputError("[objective]: one of maximise and minimise must be given")
    objective = _quantity(given[0], scene, direction)
    each = limits.items() if isinstance(limits, Mapping) else limits
    kept = tuple(_limit(_quantity(name, scene), bounds) for name, bounds in each)
    if at is not None and at[0] not in ("torque", "power"):
        raise InputError(f"at {at[0]}: a motor is held at its torque or power, or at its rate")
    held = None if at is None else Held(named(at[0], scene), at[1])
    if held is not None and not held.value > 0.0:
        raise InputError(f"at {held.quantity.name} = {held.value:g}: must be more than zero")
    if through == "run" and not 0.0 <= begin < scene.source.file.time.end:
        raise InputError(f"begin = {begin:g}: must be within the run, from 0 to its end")
    sign = 1.0 if maximise is not None else -1.0
    variables = variables_of(scene, vary)
    if uncertain is not None:
        if unknown := [name for name in uncertain.names if name not in scene.parameters]:
            raise InputError(f"[uncertain] {unknown[0]}: the scene has no such parameter")
        scene = scene.replace(**dict(zip(uncertain.names, uncertain.mean.tolist(), strict=True)))
    return Problem(scene, variables, objective, sign, kept, through, begin, held, uncertain)


def _quantity(given: Objective, scene: Scene, direction: Direction | None = None) -> Quantity:
    if isinstance(given, Quantity):
        return given
    if isinstance(given, str):
        return named(given, scene, direction)
    return from_function(given, getattr(given, "__name__", "objective"))


def _limit(quantity: Quantity, bounds: Bounds) -> Limit:
    low, high = bounds
    if low is None and high is None:
        raise InputError(f"[constraints] {quantity.name}: give min, max or both")
    if low is not None and high is not None and low > high:
        raise InputError(
            f"[constraints] {quantity.name}: at least {low:g} and at most {high:g} contradict "
            "each other"
        )
    return Limit(quantity, low, high)


def solved(
    designs: Designs,
    search: Search,
    on_attempt: Callable[[int, Attempt], None] = lambda number, attempt: None,
) -> Design:
    """The best of the designs of a problem.

    Raises:
        InputError: the limits contradict each other, or variables have no effect.
        KeyboardInterrupt: it was stopped before there was a design that keeps to all limits.
        SolverError: no start can be simulated.
    """
    problem, attempts = designs.problem, list[Attempt]()
    sensitivities, spread, told, stopped = {}, np.zeros(0), (), True

    def ended(attempt: Attempt) -> None:
        attempts.append(attempt)
        on_attempt(len(attempts) - 1, attempt)

    with contextlib.suppress(Stop, KeyboardInterrupt):
        for attempt in searched(designs, search):
            ended(attempt)
        if designs.best() is None:
            nearest = nearest_to_limits(designs, search.most)
            if not designs.keeps(nearest):
                raise InputError(f"[constraints]: {contradiction(designs, nearest)}")
            ended(attempted(designs, search, nearest))
        if (best := designs.best()) is not None:
            sensitivities = _sensitivities(designs, best)
            spread = _spread(designs, best)
            told = tuple(_unstable(designs, attempts[0].start, best))
            stopped = False
    best = designs.best()
    if best is None:
        raise KeyboardInterrupt
    at_limit = designs.margins(best) < BINDING
    binding = [str(side) for side, at in zip(designs.sides, at_limit, strict=True) if at]
    at_bound = np.minimum(best.x, 1 - best.x) < EDGE
    return Design(
        problem=problem,
        values=problem.variables.numbers(best.x),
        objective=best.objective,
        quantities=best.values,
        start=attempts[0].start if attempts and attempts[0].start.ok else None,
        best=best,
        binding=tuple(dict.fromkeys(binding)),
        at_bounds=tuple(np.array(problem.variables.labels)[at_bound].tolist()),
        attempts=tuple(attempts),
        points=tuple(designs.points.values()),
        status="interrupted" if stopped else _status(attempts, best),
        sensitivities=sensitivities,
        spread=spread,
        warnings=told,
    )


BINDING, EDGE = 1e-4, 1e-6
"""Parts of a limit, and of a variable's range, within which a design is at it."""

NEUTRAL = 1e-5
"""1/s: growth rates of designs at the limit of their stability are as far from zero as a search
comes to it."""


def _status(attempts: Sequence[Attempt], best: Point) -> str:
    """That of the attempt which came to the best design."""
    return next((a.status for a in attempts if a.end is best), "converged")


def _unstable(designs: Designs, start: Point, best: Point) -> Iterator[str]:
    """Sentences on steady states that would not last."""
    problem = designs.problem
    if problem.through != "steady" or not problem.scene.rod.topology.motors:
        return
    for word, point in (("the start", start), ("the best design", best)):
        if not point.ok:
            continue
        state = steady(problem.scene.replace(**designs.numbers(point)))
        try:
            growth = stability(state).growth_rate
        except SolverError as error:
            yield f"whether {word} is stable could not be told: {error}"
            continue
        if growth > NEUTRAL:
            yield (
                f"{word} would not go on like this: its steady state is unstable, with a growth "
                f"rate of {growth:.3g} 1/s, and buckles. A constraint on growth_rate, of at most "
                "0, keeps away from that"
            )


def _sensitivities(designs: Designs, best: Point) -> dict[str, Sensitivity]:
    """Slopes and curvatures of the objective, from gradients at neighbours on both sides."""
    variables = designs.problem.variables
    if variables.size > MOST_CURVED:
        return {}
    found = {}
    for k, label in enumerate(variables.labels):
        sides = []
        for step in (CURVATURE_STEP, -CURVATURE_STEP):
            x = best.x.copy()
            x[k] = np.clip(x[k] + step, 0.0, 1.0)
            sides.append(designs(x))
        ahead, behind = sides
        scale = variables.scale[k]
        slope = best.gradient[k] / scale
        apart = (ahead.x[k] - behind.x[k]) * scale
        curvature = (ahead.gradient[k] - behind.gradient[k]) / scale / apart
        found[label] = Sensitivity(
            float(slope), float(curvature), _tolerance(slope, curvature, COST * best.objective)
        )
    return found


def _tolerance(slope: float, curvature: float, change: float) -> float:
    """Where |slope| d + |curvature| d^2 / 2 comes to the change; infinite if it never does."""
    a, b, c = 0.5 * abs(curvature), abs(slope), abs(change)
    return 2 * c / (b + np.sqrt(b**2 + 4 * a * c)) if a + b > 0 else float("inf")


def _spread(designs: Designs, best: Point) -> Float[np.ndarray, " c"]:
    """The objective of a design for parameters drawn at random; NaN where it fails."""
    problem = designs.problem
    if problem.uncertain is None:
        return np.zeros(0)
    numbers = problem.variables.numbers(best.x)
    found = []
    for draw in problem.uncertain.sample(DRAWS):
        more = dict(zip(problem.uncertain.names, draw.tolist(), strict=True))
        evaluation = designs.evaluator(numbers, more)
        found.append(evaluation.values.get(problem.objective.name, np.nan))
    return np.array(found)


def on_a_finer_mesh(design: Design) -> float:
    """The objective of the best design with edges half as long; NaN where that is not known.

    Of steady states only: what it costs to be wrong about the mesh is nearly that of a new search.
    """
    problem, function = design.problem, design.problem.objective.function
    if problem.through != "steady" or function is None or problem.uncertain is not None:
        return float("nan")
    file = problem.scene.source.file
    finer = {**file.model_dump(exclude_unset=True)}
    finer["robot"] = {**finer.get("robot", {}), "edge_length": 0.5 * file.robot.edge_length}
    state = steady(
        build(SceneFile.from_dict(finer), {**problem.scene.parameters, **design.numbers})
    )
    return float(function(SteadyMotion(state))) if state.ok else float("nan")
