"""What a further run would tell: Fisher information of tracks that are not filmed yet.

Errors of a fit follow from derivatives and noise alone, so they are known before a run is made. A
candidate is a track of a robot that swims steadily, with a rate of the motor, a duration, and
channels; what would not be known of it (origin, direction, phase, and nuisances as those of the
runs that there are) is estimated with the rest.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from derjax import InputError, SolverError

from ..joint.assemble import assemble
from ..joint.fit import Solved
from ..joint.parts import TrackPart
from ..joint.unknowns import Unknowns
from ..observe import ANGLE
from ..tracks import Run

CHANNELS: dict[str, tuple[int, ...]] = {
    "x, y, z, angle": (0, 1, 2, ANGLE),
    "x, y, z": (0, 1, 2),
    "x, y, angle": (0, 1, ANGLE),
    "x, y": (0, 1),
    "angle": (ANGLE,),
}
"""What may be tracked."""

TYPICAL = (1e-4, 0.02)
"""Noise (m, rad) of what no run has tracked so far: that of a good camera."""

FEWEST = 10
"""Frames of a candidate."""


@dataclass(frozen=True)
class Candidate:
    """A run that might be made.

    Attributes:
        rpm: of the motors.
        duration: s, of its track.
        channels: key of `CHANNELS`.
        std: standard errors of the parameters after it, as parts of their values.
    """

    rpm: float
    duration: float
    channels: str
    std: dict[str, float]


@dataclass(frozen=True)
class Plan:
    """What further runs would tell.

    Attributes:
        now: standard errors of the parameters with the data that there are, as parts of their
        values.
        candidates: as asked for.
        interval: s, between frames.
        noise: of positions (m) and the angle (rad) that was assumed.
    """

    now: dict[str, float]
    candidates: tuple[Candidate, ...]
    interval: float
    noise: tuple[float, float]

    def best(self, name: str) -> Candidate:
        """The candidate after which a parameter is known best."""
        return min(self.candidates, key=lambda one: one.std[name])


def plan(
    solved: Solved,
    rates: Sequence[float],
    durations: Sequence[float],
    interval: float,
    on_rate: Callable[[float], None] = lambda rpm: None,
) -> Plan:
    """What further runs would tell.

    Args:
        solved: the fit of the data that there are.
        rates: of the motors, rpm.
        durations: of tracks, s.
        interval: between frames, s.
        on_rate: called with every rate that is done.

    Raises:
        InputError: tracks with fewer than ten frames, or a robot that does not swim steadily.
    """
    if min(durations) < FEWEST * interval:
        raise InputError(
            f"--durations {min(durations):g}: fewer than {FEWEST} frames, {interval:g} s apart"
        )
    noise = _noise(solved)
    names = list(solved.problem.unknowns.names)
    _, known = solved.residuals.standardised()
    free = dict(zip(names, solved.optimum.free, strict=True))
    fitted = [u.name for u in solved.problem.unknowns.every if u.fitted]
    found = []
    for rpm in rates:
        unknowns, rows, times, channels, priors = _derivatives(
            solved, rpm, max(durations), interval, free
        )
        union = [*names, *(n for n in unknowns.names if n not in names)]
        places = [union.index(name) for name in unknowns.names]
        before = np.zeros((len(known), len(union)))
        before[:, : len(names)] = known
        for duration in durations:
            for label, tracked in CHANNELS.items():
                chosen = (times <= duration + 1e-9) & np.isin(channels, tracked)
                size = np.where(channels[chosen] == ANGLE, noise[1], noise[0])
                new = np.zeros((int(chosen.sum()), len(union)))
                new[:, places] = rows[chosen] / size[:, None]
                extra = np.zeros((len(priors), len(union)))
                for k, (place, row) in enumerate(priors):
                    if unknowns.names[place] not in names:
                        extra[k, places] = row
                std = errors(np.concatenate([before, new, extra]), union, fitted)
                found.append(Candidate(rpm, duration, label, std))
        on_rate(rpm)
    return Plan(errors(known, names, fitted), tuple(found), interval, noise)


def errors(
    rows: Float[np.ndarray, "m p"], names: Sequence[str], fitted: Sequence[str]
) -> dict[str, float]:
    """Standard errors of free numbers, from derivatives in units of the noise; infinite if lost."""
    size = np.linalg.norm(rows, axis=0)
    scale = np.where(size > 0, size, 1.0)
    _, singular, vt = np.linalg.svd(rows / scale, full_matrices=False)
    null = singular < 1e-7 * singular.max(initial=1e-300)
    inverse = np.where(null, 0.0, 1.0 / np.where(null, 1.0, singular))
    std = np.sqrt(np.sum((vt.T * inverse) ** 2, axis=1)) / scale
    lost = (np.abs(vt[null]) > 1e-3).any(axis=0) | (size == 0)
    return {
        name: float(np.inf if lost[k] else std[k]) for k, name in enumerate(names) if name in fitted
    }


def _noise(solved: Solved) -> tuple[float, float]:
    """Of positions and angles as it counts: more if it goes on from frame to frame."""
    sizes = list(TYPICAL)
    for kind, level in solved.residuals.levels.items():
        if kind < 2:
            rows = solved.residuals.kind == kind
            size = float(np.sqrt(np.median(solved.residuals.variances()[rows])))
            sizes[kind] = size * float(np.sqrt((1 + level.rho) / (1 - level.rho)))
    return sizes[0], sizes[1]


def _derivatives(
    solved: Solved, rpm: float, duration: float, interval: float, free: Mapping[str, float]
) -> tuple[Unknowns, np.ndarray, np.ndarray, np.ndarray, list[tuple[int, np.ndarray]]]:
    """Derivatives of all channels of a candidate, their times and channels, and its priors."""
    dataset = solved.problem.dataset
    time = np.arange(0.0, duration + 1e-9, interval)
    like = next((run for run in dataset.runs if run.steady), None)
    run = Run(
        "candidate",
        time,
        (0, 1, 2, ANGLE),
        np.zeros((len(time), 4)),
        rpm,
        sigma=1.0,
        sigma_angle=1.0,
        steady=True,
        free_origin=True,
    )
    if like is not None:
        run = replace(run, nuisances=like.nuisances, drift=like.drift)
    problem = assemble(replace(dataset, runs=(run,), rates=()), solved.problem.names, {})
    at = problem.unknowns.start()
    for k, name in enumerate(problem.unknowns.names):
        at[k] = free.get(name, at[k])
    point = problem.point(at)
    if point is None:
        raise SolverError(f"{rpm:g} rpm: {problem.failure}")
    part = problem.parts[0]
    assert isinstance(part, TrackPart)
    rows = part.rows(point)
    priors = problem.priors(point)
    places = [k for k, u in enumerate(problem.unknowns.every) if u.std is not None]
    known = [
        (place, row / sigma)
        for place, row, sigma in zip(places, priors.jacobian, priors.sigma, strict=True)
    ]
    count = len(run.channels)
    return (
        problem.unknowns,
        rows.jacobian,
        np.tile(time, count),
        np.repeat(run.channels, len(time)),
        known,
    )
