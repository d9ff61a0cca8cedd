"""Where a search begins: what tracks say of themselves before they are compared with a gait.

The loss of a long track has many minima in the rates of a robot: one for every turn by which the
simulation comes out of step. So speed and head rate are read off each track by a straight line, and
the rate at which the robot turns about its way by a periodogram where the head's angle was not
tracked; the parameters are first fitted to these, which has one minimum. Then phases are looked for
on a grid, with the best origin for each.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from derjax import InputError, SolverError

from ..explore import explore
from ..levenberg import Evaluation, minimise
from ..noise import PRIOR
from ..observe import ANGLE
from ..uncertainty import Residuals
from .gait import RATES
from .maps import turned_about
from .parts import HEAD_RATE, SPEED, Point, RatesPart, TrackPart
from .periodogram import hidden_motions, turning
from .problem import Free, Problem

CRUDE = 0.01
"""Noise of rates that are read off a track, as a part of them."""

EXPECTED = 1.0
"""How far a parameter is expected from its start, in free numbers (logarithms, of positive ones).

Where speeds do not determine it, it stays there, for the tracks themselves to decide.
"""

PHASES = 24
"""Phases that are tried."""


@dataclass(frozen=True)
class Slope:
    """What a straight line says of a track.

    Attributes:
        speed: m/s, along x of the scene; None where no coordinate was tracked.
        head_rate: rad/s; None where the angle was not tracked.
        direction: (3,) m/s, of the way, zero where a coordinate was not tracked.
        turning: rad/s, of the robot about its way; None where it is not seen, or not needed.
    """

    speed: float | None
    head_rate: float | None
    direction: np.ndarray
    turning: float | None = None


def slope(part: TrackPart) -> Slope:
    """Speed and head rate of a track, by straight lines that outliers do not turn."""
    run = part.run
    direction, head_rate = np.zeros(3), None
    for column, channel in enumerate(run.channels):
        line = _line(run.time, run.values[:, column])
        if channel == ANGLE:
            head_rate = line
        else:
            direction[channel] = line
    places = [c for c in run.channels if c != ANGLE]
    if not places:
        return Slope(None, head_rate, direction)
    along = direction[0] if 0 in places else direction[places[0]]
    speed = float(np.copysign(np.linalg.norm(direction), along))
    return Slope(speed if 0 in places else None, head_rate, direction)


def _line(time: np.ndarray, values: np.ndarray) -> float:
    """The slope of a straight line, by least squares with less weight for what is far off."""
    weights = np.ones(len(time))
    fitted = np.zeros(2)
    for _ in range(10):
        fitted = np.polyfit(time, values, 1, w=np.sqrt(weights))
        off = np.abs(values - np.polyval(fitted, time))
        weights = 1.0 / (1.0 + (off / max(3.0 * float(np.median(off)), 1e-300)) ** 2)
    return float(fitted[0])


def beginning(problem: Problem) -> Free | None:
    """Free numbers from which a search for the best goes downhill; None if there are none."""
    free = problem.unknowns.start()
    slopes = {
        k: slope(part)
        for k, part in enumerate(problem.parts)
        if isinstance(part, TrackPart) and part.source is not None
    }
    if slopes or any(isinstance(part, RatesPart) for part in problem.parts):
        point = problem.point(free)
        if point is None:
            return None
        _compare_senses(problem, point, slopes)
        _average_what_is_hidden(problem, point)
        slopes = {k: _with_turning(problem, point, k, line) for k, line in slopes.items()}
        found = _by_rates(problem, slopes, free)
        if found is None:
            return None
        free = found
    elif problem.rest:
        free = _explored(problem, free)
        if free is None:
            return None
    try:
        point = problem.point(free)
    except SolverError:
        return None
    if point is None:
        return None
    free = free.copy()
    for number, part in enumerate(problem.parts):
        if isinstance(part, TrackPart):
            _place(problem, part, number, free, slopes.get(number))
    return free


def _average_what_is_hidden(problem: Problem, point: Point) -> None:
    """Takes phases out of the search whose motions are far below the noise.

    The head of a robot with flagella all alike stays on its way, and no phase fits better than
    another. A search would follow the noise from one to the next.
    """
    parts = list(problem.parts)
    for number, part in enumerate(parts):
        if not isinstance(part, TrackPart) or part.source is None:
            continue
        hidden = hidden_motions(part.run, point.gaits[part.source].gait)
        new = tuple(
            place is not None and one for place, one in zip(part.start, hidden, strict=True)
        )
        if not any(new):
            continue
        averaged = (part.averaged[0] or new[0], part.averaged[1] or new[1])
        phase, roll = (None if one else place for place, one in zip(part.start, new, strict=True))
        parts[number] = replace(part, start=(phase, roll), averaged=averaged)
        which = [
            what
            for what, one in zip(("in a turn of the motors", "round its way"), new, strict=True)
            if one
        ]
        problem.said += (
            f"{part.name}: how the head moves {' and '.join(which)} is too little to be seen "
            "beside the noise, and is averaged over: it has no phase",
        )
    problem.parts = tuple(parts)


def _with_turning(problem: Problem, point: Point, number: int, line: Slope) -> Slope:
    """With the rate of turning, where no angle tells it."""
    part = problem.parts[number]
    if line.head_rate is not None or not isinstance(part, TrackPart) or part.source is None:
        return line
    return replace(line, turning=turning(part.run, part.known(point).gait))


def _compare_senses(problem: Problem, point: Point, slopes: dict[int, Slope]) -> None:
    """Finds out whether robots swim the way that they are said to.

    Raises:
        InputError: a track goes the other way than the robot swims.
    """
    parts = list(problem.parts)
    for number, part in enumerate(parts):
        if isinstance(part, RatesPart):
            predicted, data = part.predicted(point)[0], part.data()[0]
            against = [
                bool(np.all((p * d < 0) | ~np.isfinite(d)) and np.isfinite(d).any())
                for p, d in zip(predicted.T, data.T, strict=True)
            ]
            if any(against):
                parts[number] = replace(part, senses=tuple(-1.0 if a else 1.0 for a in against))
                which = " and ".join(
                    n for n, a in zip(("v", "head_rate"), against, strict=True) if a
                )
                problem.said += (
                    f"{part.name}: {which} have the opposite sign of the robot of the scene, and "
                    "are taken as sizes",
                )
        elif (line := slopes.get(number)) is not None and part.source is not None:
            gait = point.gaits[part.source].gait
            for what, seen, would in (
                ("goes along x", line.speed, gait[0]),
                ("turns its head", line.head_rate, gait[RATES - 2]),
            ):
                if seen is not None and seen * would < 0 and abs(seen) > 0.1 * abs(would):
                    raise InputError(
                        f"{part.name}: the track {what} with {seen:.3g} (SI units), the robot of "
                        f"the scene with motors at {part.run.motor_rpm} rpm the other way "
                        f"({would:.3g}): change the sign of motor_rpm or of the column (a minus "
                        "before its name), or [robot] handedness"
                    )
    problem.parts = tuple(parts)


def _by_rates(problem: Problem, slopes: dict[int, Slope], free: Free) -> Free | None:
    """What is fitted, from speeds and head rates alone."""
    start = problem.unknowns.start()

    def evaluate(free: Free) -> Evaluation | None:
        point = problem.point(free)
        if point is None:
            return None
        value, jacobian, kind, sigma = [], [], [], []
        for number, part in enumerate(problem.parts):
            if isinstance(part, RatesPart):
                rows = part.rows(point)
                value += rows.value.tolist()
                jacobian += list(rows.jacobian)
                kind += rows.kind.tolist()
                crude = CRUDE * np.maximum(np.abs(rows.resolution / 1e-6), 1e-12)
                sigma += np.maximum(np.nan_to_num(rows.sigma), crude).tolist()
            elif (line := slopes.get(number)) is not None and part.source is not None:
                known = point.gaits[part.source]
                for which, seen, of in (
                    (0, line.speed, SPEED),
                    (1, line.turning, HEAD_RATE),
                    (RATES - 2, line.head_rate, HEAD_RATE),
                ):
                    if seen is None or seen == 0:
                        continue
                    row = np.zeros(len(free))
                    row[list(part.varied)] = known.jacobian[which] * point.slopes[list(part.varied)]
                    value.append(known.gait[which] - seen)
                    jacobian.append(row)
                    kind.append(of)
                    sigma.append(CRUDE * abs(seen))
        priors = problem.priors(point)
        value += priors.value.tolist()
        jacobian += list(priors.jacobian)
        kind += [PRIOR] * len(priors.value)
        sigma += priors.sigma.tolist()
        count = len(free)
        value += (free - start).tolist()
        jacobian += list(np.eye(count))
        kind += [PRIOR] * count
        sigma += [EXPECTED] * count
        n = len(value)
        residuals = Residuals(
            np.array(value), np.array(jacobian), np.array(kind), np.array(sigma), np.zeros(n)
        )
        return Evaluation(residuals, point)

    found = minimise(evaluate, free, max_iterations=30, step_tolerance=1e-3, gain_tolerance=1e-2)
    if found is None:
        return None
    if found.status == "interrupted":
        raise KeyboardInterrupt
    return found.free


def _explored(problem: Problem, free: Free) -> Free | None:
    """What is fitted, from tracks from rest alone, nuisances being what they are expected to be."""
    free = free.copy()
    for group in problem.rest:
        count = len(group.varied) - 0
        places = list(group.varied[:count])
        runs = tuple(
            replace(run, free_origin=True, drift=run.drift or bool(run.nuisances.drift))
            for run in group.model.dataset.runs
        )
        found = explore(
            lambda at, runs=runs, group=group: group.model.preview(at, runs), free[places]
        )
        if found is None:
            problem.failure = group.model.failure
            return None
        if found.optima[0].status == "interrupted":
            raise KeyboardInterrupt
        free[places] = found.optima[0].free
    return free


def _place(problem: Problem, part: TrackPart, number: int, free: Free, line: Slope | None) -> None:
    """Direction, phase and origin of a track, put into the free numbers."""
    point = problem.point(free)
    assert point is not None
    places = _named_places(part)
    if line is not None and line.speed:
        way = line.direction * np.sign(line.speed)
        size = np.linalg.norm(way)
        for label, angle in (("about z", way[1] / size), ("about y", -way[2] / size)):
            if (k := places.get(f"orientation {label}")) is not None and abs(angle) < 0.7:
                _set(problem, free, k, float(np.arcsin(angle)))
    if any(k is not None for k in part.start):
        _set_phases(problem, part, number, free)
    observed, _ = part.predicted(_moved(problem, point, free), number)
    for column, channel in enumerate(part.run.channels):
        label = "angle_origin" if channel == ANGLE else f"origin {('x', 'y', 'z')[channel]}"
        if (k := places.get(label)) is not None:
            apart = np.median(part.run.values[:, column] - observed[:, channel])
            now = float(problem.unknowns.values(free)[k])
            _set(problem, free, k, now + float(apart))


def _set_phases(problem: Problem, part: TrackPart, number: int, free: Free) -> None:
    """The phase and the roll with which what is left of the track is least."""
    assert part.source is not None
    point = problem.point(free)
    assert point is not None
    known = part.known(point)
    time = jnp.asarray(part.clock(part.run.time))
    channels = list(part.run.channels)
    grids = [
        np.linspace(0, 2 * np.pi, PHASES, endpoint=False) if k is not None else [0.0]
        for k in part.start
    ]
    length = float(np.ptp(part.run.values[:, ~part.run.is_angle], axis=0).max(initial=0.0))
    best, lowest = (0.0, 0.0), np.inf
    lines = np.stack([np.ones(len(time)), np.asarray(time)], axis=1)
    project = np.linalg.pinv(lines)
    scale = np.maximum(np.where(part.run.is_angle, 1.0, length), 1e-12)
    for phase in grids[0]:
        tracks = turned_about(jnp.asarray(known.gait), time, phase, jnp.asarray(grids[1]))
        for roll, track in zip(grids[1], np.asarray(tracks), strict=True):
            apart = part.run.values - track[:, channels]
            left = apart - lines @ (project @ apart)
            size = float(np.sum((left / scale) ** 2))
            if size < lowest:
                best, lowest = (float(phase), float(roll)), size
    for k, value in zip(part.start, best, strict=True):
        if k is not None:
            _set(problem, free, k, value)


def _named_places(part: TrackPart) -> dict[str, int]:
    labels: Sequence[str] = [
        f"{one.name} {label}".rstrip() for one in part.maps for label in one.labels
    ]
    return dict(zip(labels, part.mapped, strict=True))


def _set(problem: Problem, free: Free, place: int, value: float) -> None:
    free[place] = problem.unknowns.every[place].transform.free(value)


def _moved(problem: Problem, point: Point, free: Free) -> Point:
    """The point with other numbers of maps, gaits as they were."""
    values, slopes = problem.unknowns.values(free), problem.unknowns.slopes(free)
    return replace(point, values=values, slopes=slopes)
