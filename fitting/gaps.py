"""Positions that were not found, positions that were found several times, and angles that wrap."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from derjax import InputError

SENTINELS = (-1.0, 0.0)
"""Numbers that some programs write where they have found nothing."""

ROUNDING = 1e-9
"""Part of a turn by which angles may be off."""

FAR = 10.0
"""Usual ways from frame to frame by which such a place is away from the others, at least."""

AMBIGUOUS, MOST_AMBIGUOUS = 0.4, 0.1
"""A turn by more than this part of a period may be one the other way round; how many may be."""

Values = Float[np.ndarray, "r c"]
Rows = Bool[np.ndarray, " r"]


def lost(position: Values, sentinels: tuple[float, ...] | None) -> tuple[Rows, float | None]:
    """Which rows say that nothing was found, and by which value if it had to be guessed.

    Args:
        position: (r, c) in the order of time, NaN where there is none.
        sentinels: what stands for nothing; None: it is one of `SENTINELS`, in all of at least two
            coordinates, in rows far from those around them.
    """
    if sentinels is not None:
        return np.asarray(np.isin(position, sentinels).any(axis=1)), None
    none = np.zeros(len(position), bool)
    if position.shape[1] < 2:
        return none, None
    for value in SENTINELS:
        rows = (position == value).all(axis=1)
        others = position[~rows & np.isfinite(position).all(axis=1)]
        if not rows.any() or len(others) < 2:
            continue
        usual = np.median(np.linalg.norm(np.diff(others, axis=0), axis=1))
        if np.linalg.norm(others - value, axis=1).min() > FAR * usual:
            return rows, value
    return none, None


def one_each(
    time: Float[np.ndarray, " r"],
    position: Values,
    seen: Rows,
    area: Float[np.ndarray, " r"] | None,
) -> Rows:
    """Of several rows of one time that were seen, one: the largest, or the nearest to the last.

    Args:
        time: (r,) increasing, with repetitions.
        position: (r, c).
        seen: rows to choose from.
        area: (r,) sizes, if the largest is wanted.

    Raises:
        ValueError: the nearest are wanted, and there are several at every time.
    """
    places = np.flatnonzero(seen)
    groups = np.split(places, np.flatnonzero(np.diff(time[places])) + 1) if len(places) else []
    if area is not None:
        chosen = [
            group[int(np.argmax(np.nan_to_num(area[group], nan=-np.inf)))] for group in groups
        ]
    else:
        sure = next((k for k, group in enumerate(groups) if len(group) == 1), None)
        if sure is None and groups:
            raise ValueError("there are several in every frame")
        chosen = [-1] * len(groups)
        for order in (range(sure or 0, len(groups)), range((sure or 0) - 1, -1, -1)):
            last = position[groups[sure or 0][0]]
            for k in order:
                away = np.linalg.norm(position[groups[k]] - last, axis=1)
                chosen[k] = int(groups[k][int(np.argmin(away))])
                last = position[chosen[k]]
    kept = np.zeros(len(time), bool)
    kept[chosen] = True
    return kept


def unwrapped(
    path: Path,
    angle: Float[np.ndarray, " f"],
    period: float | None,
    unit: float,
    lines: Int[np.ndarray, " f"],
) -> Float[np.ndarray, " f"]:
    """Head angles (rad) that are continuous.

    Args:
        path: of the file, for messages.
        angle: in the order of time.
        period: rad, up to which they are known; None: they should be continuous already.
        unit: rad, in which keys give angles, for messages.
        lines: of the file, for messages.

    Raises:
        InputError: they are not, or which way the head turns cannot be told.
    """
    if period is None:
        _check_continuous(path, angle, unit, lines)
        return angle
    whole = np.unwrap(angle, period=period)
    steps = np.abs(np.diff(whole))
    if np.mean(steps > AMBIGUOUS * period) > MOST_AMBIGUOUS:
        line = lines[int(np.argmax(steps)) + 1]
        raise InputError(
            f"{path}: line {line}: the head angle turns by {steps.max():.3g} rad between two "
            f"frames, about half of angle_period = {period / unit:.6g}: which way it turns cannot "
            "be told; track more frames, or leave head_angle out of columns"
        )
    return whole


def _check_continuous(
    path: Path, angle: Float[np.ndarray, " f"], unit: float, lines: Int[np.ndarray, " f"]
) -> None:
    """Angles given within one turn, or half a turn, jump where they leave it."""
    jumps = np.abs(np.diff(angle))
    if not len(jumps):
        return
    span, line = np.ptp(angle), lines[int(np.argmax(jumps)) + 1]
    for part, words in ((1.0, "one turn"), (0.5, "half a turn, as that of an ellipse")):
        turn = 2 * np.pi * part
        if span <= turn * (1 + ROUNDING) and jumps.max() > 0.5 * turn:
            raise InputError(
                f"{path}: line {line}: the head angle jumps by {jumps.max():.3g} rad: it seems to "
                f"be given within {words}; say angle_period = {turn / unit:.7g} to have it "
                "unwrapped"
            )
