"""What the head's motion across the way tells: how fast the robot turns, and whether phases."""

import numpy as np
from jaxtyping import Float

from ..observe import ANGLE
from ..tracks import Run
from .gait import RATES

LINES = 3
"""Frequencies of the head's motion across the way that are looked for, the strongest ones."""

RANGE = 0.35, 2.5
"""Rates that are tried, as parts of the expected one."""

FINENESS = 0.2
"""rad, by which phases at the end of the track differ between rates that are tried."""

VISIBLE = 2.0
"""Standard errors of the size of a wave, from which on its phase is looked for."""

CLEAR = 0.2
"""Part of the square of what is seen across the way that the best rate must explain."""


def turning(run: Run, packed: Float[np.ndarray, " g"]) -> float | None:
    """rad/s, about the way; None if the track does not tell.

    A robot that turns has its head on circles about the way, or on what else its gait makes of them
    in a turn of the motors: seen from a side these are lines of a spectrum, whose frequencies are
    the rate of turning and those of the motors, added. The expected gait says which are strong.

    Args:
        run: the track.
        packed: the expected gait, whose rate of turning is only roughly known.
    """
    across = [k for k, channel in enumerate(run.channels) if channel not in (0, ANGLE)]
    expected, pace = float(packed[1]), float(packed[RATES - 1])
    time = run.time - run.time[0]
    if not across or not expected or len(time) < 4 * LINES + 4:
        return None
    orders = _strongest(packed[RATES:].reshape(-1, 4))
    seen = run.values[:, across]
    ground = np.stack([np.ones(len(time)), time / time[-1]], axis=1)
    step = FINENESS / (abs(expected) * time[-1])
    factors = np.arange(RANGE[0], RANGE[1], step)
    left = np.array(
        [_left(ground, seen, time, expected * f + pace * orders) for f in factors], float
    )
    without = _left(ground, seen, time, np.zeros(0))
    best = int(np.argmin(left))
    if without - left[best] < CLEAR * without or best in (0, len(factors) - 1):
        return None
    return expected * float(factors[best] + step * _offset(*left[best - 1 : best + 2]))


def hidden_motions(run: Run, packed: Float[np.ndarray, " g"]) -> tuple[bool, bool]:
    """Whether motions of the head are too small for their phases to be told from a track.

    Args:
        run: the track.
        packed: the expected gait.

    Returns:
        Of those in a turn of the motors, and of those round the way.
    """
    path = packed[RATES:].reshape(-1, 4)
    # Seen from a side, what goes round the way is in both coordinates across it.
    radius, waves = np.hypot(path[0, 1], path[0, 2]), np.linalg.norm(path[1:], axis=0)
    waves[1:3] = np.linalg.norm(waves[1:3])
    clear = VISIBLE * noise(run) / np.sqrt(len(run.time) / 2)
    across = [channel in (1, 2) for channel in run.channels]
    turns = bool(np.any(waves[list(run.channels)] > clear))
    return not turns, not np.any(
        np.append(radius, waves[1]) > np.min(clear[across], initial=np.inf)
    )


def noise(run: Run) -> Float[np.ndarray, " c"]:
    """About that of each channel (m and rad), from how far frames are off those beside them."""
    second = run.values[2:] - 2 * run.values[1:-1] + run.values[:-2]
    return np.median(np.abs(second), axis=0) / (0.6745 * np.sqrt(6.0))


def _strongest(path: Float[np.ndarray, "k 4"]) -> np.ndarray:
    """Orders of the motors' turns with which the head is farthest from the way."""
    constant, turns, half = path[:1], path[1:], (len(path) - 1) // 2
    plane = np.array([1.0, 1.0j])
    cosine, sine = turns[0::2, 1:3] @ plane, turns[1::2, 1:3] @ plane
    orders = np.concatenate([[0], np.arange(1, half + 1), -np.arange(1, half + 1)])
    waves = [constant[:, 1:3] @ plane, (cosine - 1j * sine) / 2, (cosine + 1j * sine) / 2]
    sizes = np.abs(np.concatenate(waves))
    strong = np.argsort(-sizes)[:LINES]
    return orders[strong[sizes[strong] > 0.05 * sizes.max()]]


def _left(ground: np.ndarray, seen: np.ndarray, time: np.ndarray, rates: np.ndarray) -> float:
    """Squares of what waves of these rates (rad/s) do not explain."""
    angles = time[:, None] * rates
    basis = np.concatenate([ground, np.cos(angles), np.sin(angles)], axis=1)
    return float(np.sum((seen - basis @ np.linalg.lstsq(basis, seen, rcond=1e-8)[0]) ** 2))


def _offset(before: float, here: float, after: float) -> float:
    """Where the parabola through three points is least, in steps from the middle one."""
    bend = before - 2 * here + after
    return 0.0 if bend <= 0 else 0.5 * (before - after) / bend
