"""How a run is divided into steps and saved frames, where the scene file does not say."""

import math
from typing import NamedTuple

FRAMES_PER_TURN = 6
"""The least number of saved frames in a turn of the fastest motor."""

LEAST_FRAMES = 2
"""Of a run: what is measured over its second half needs its middle and its end."""

FRAMES_AT_REST = 200
"""Saved frames of a run whose motors stand still."""

MOST_STEPS = 2**31 - 1
"""Steps of a run, which are counted in 32 bits."""

ROUNDING = 1e-9
"""Relative error up to which two times are the same."""


class TimeGrid(NamedTuple):
    """The division of a run.

    Attributes:
        step: length of a step, or of the first one if steps adapt, s.
        steps_per_frame: steps of that length from one saved frame to the next.
        n_frames: saved frames, not counting the start.
    """

    step: float
    steps_per_frame: int
    n_frames: int


def usual_frame(end: float, fastest_rpm: float) -> float:
    """The time between frames (s) that shows the motion of a run of `end` seconds.

    It is the largest of the numbers ..., 0.1, 0.2, 0.5, 1, ... that is at most a sixth of a turn
    of the fastest motor, which turns at `fastest_rpm`; a two hundredth of the run if that is 0.
    """
    if fastest_rpm == 0:
        return end / FRAMES_AT_REST
    longest = 60 / fastest_rpm / FRAMES_PER_TURN * (1 + ROUNDING)
    power = math.floor(math.log10(longest))
    fitting = [float(f"{m}e{power}") for m in (1, 2, 5) if m * 10.0**power <= longest]
    return fitting[-1] if fitting else float(f"5e{power - 1}")


def time_grid(end: float, step: float | None, frame: float | None, fastest_rpm: float) -> TimeGrid:
    """The steps and frames of a run of `end` seconds; what is None is chosen by the motors.

    Frames are by default about as long as `usual_frame` says. Steps are by default half a
    frame, or less so that they are no longer than half a usual frame.

    Raises:
        ValueError: end, step and frame do not divide one another, or the steps are too many; the
            message begins with a key.
    """
    usual = usual_frame(end, fastest_rpm)
    shortest = step or min(frame or usual, usual) / 2
    if (count := end / shortest) > MOST_STEPS:
        given = f"end = {end:g}" if step is None else f"step = {step:g}"
        raise ValueError(f"{given}: {count:.2g} steps are too many")
    if step is None:
        if frame is None:
            n_frames = max(LEAST_FRAMES, _parts(end, usual))
            return TimeGrid(end / n_frames / 2, 2, n_frames)
        steps_per_frame = 2 * _parts(frame, usual)
        return TimeGrid(frame / steps_per_frame, steps_per_frame, _frames(end, frame))
    if step > end:
        raise ValueError(f"step = {step:g}: must not be longer than end = {end:g} s")
    n_steps = whole_number(end / step, f"end = {end:g}: must be a whole number of {step:g} s steps")
    if frame is None:
        most = min(round(usual / step), n_steps // LEAST_FRAMES)
        steps_per_frame = _largest_divisor(n_steps, max(1, most))
        return TimeGrid(step, steps_per_frame, n_steps // steps_per_frame)
    steps_per_frame = whole_number(
        frame / step, f"frame = {frame:g}: must be a whole number of {step:g} s steps"
    )
    return TimeGrid(step, steps_per_frame, _frames(end, frame))


def _frames(end: float, frame: float) -> int:
    """The number of frames of a given length."""
    return whole_number(
        end / frame, f"frame = {frame:g}: end = {end:g} s must be a whole number of frames"
    )


def _largest_divisor(number: int, most: int) -> int:
    """The largest divisor of a number that is at most `most`."""
    small = [k for k in range(1, math.isqrt(number) + 1) if number % k == 0]
    return max(d for k in small for d in (k, number // k) if d <= most)


def _parts(whole: float, longest: float) -> int:
    """The least number of equal parts that are no longer than `longest`."""
    return max(1, math.ceil(whole / longest * (1 - ROUNDING)))


def whole_number(ratio: float, otherwise: str) -> int:
    """`ratio` as the whole number that it is but for round-off."""
    whole = round(ratio)
    if whole < 1 or not math.isclose(ratio, whole, rel_tol=ROUNDING, abs_tol=1e-6):
        raise ValueError(otherwise)
    return whole
