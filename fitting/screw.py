"""A robot that swims steadily moves, in every turn of its motors, by one and the same screw motion.

Once the transient of the start is over, the state one turn later is the state turned and shifted
as a whole: the fluid is the same everywhere and in all directions. So the rest of a track follows
from two turns of it, without simulating it. This is what makes it cheap to look at many sets of
parameters before any is simulated to the end.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .observe import ANGLE, interpolation

FEWEST_TURNS = 3
"""Turns before a motion may be taken for steady."""

SAME_PLACE, SAME_ANGLE = 1e-3, 0.02
"""How far the tracks that follow from the last turn and from the one before may be apart at
their ends: as a part of the way that the robot goes, and rad."""


class Motion(NamedTuple):
    """What has been simulated, at steps 0, 1, 2, ...

    Attributes:
        observed: (t, 4) channels, m and rad.
        orientation: (t, 3, 3) rotation matrices of the head; columns are its axes.
    """

    observed: Float[np.ndarray, "t 4"]
    orientation: Float[np.ndarray, "t 3 3"]


class Screw(NamedTuple):
    """A rigid motion x -> rotation x + shift, and the angle that the head turns meanwhile."""

    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, " 3"]
    angle: float

    def powers(self, count: int) -> "Powers":
        """The motion 0, 1, ..., `count` times in a row."""
        rotations, shifts = [np.eye(3)], [np.zeros(3)]
        for _ in range(count):
            rotations.append(self.rotation @ rotations[-1])
            shifts.append(self.rotation @ shifts[-1] + self.shift)
        return Powers(np.stack(rotations), np.stack(shifts), self.angle * np.arange(count + 1))


class Powers(NamedTuple):
    """Several rigid motions, with a leading axis."""

    rotation: np.ndarray
    shift: np.ndarray
    angle: np.ndarray


def screw(motion: Motion, step: float, period: float, end: float) -> Screw:
    """The screw motion of the turn that ends at `end` (s).

    Args:
        motion: simulated in steps of `step` (s), at least up to `end`.
        step: s.
        period: s, of a turn of the motors.
        end: s.
    """
    at = interpolation(np.array([end - period, end]), step)
    before, after = at(motion.orientation)
    u, _, vt = np.linalg.svd(after @ before.T)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    start, stop = at(motion.observed)
    shift = stop[:ANGLE] - rotation @ start[:ANGLE]
    return Screw(rotation, shift, float(stop[ANGLE] - start[ANGLE]))


def extended(
    motion: Motion, step: float, period: float, times: Float[np.ndarray, " f"]
) -> Float[np.ndarray, "f 4"]:
    """Channels at `times` (s), those after the last step by screw motions.

    Args:
        motion: simulated in steps of `step` (s), over at least one `period`.
        step: s.
        period: s, of a turn of the motors.
        times: s.
    """
    end = _end(motion, step)
    turns = np.maximum(np.ceil((times - end) / period - 1e-9), 0).astype(int)
    base = interpolation(times - turns * period, step)(motion.observed)
    if not turns.any():
        return base
    powers = screw(motion, step, period, end).powers(int(turns.max()))
    place = np.einsum("fij,fj->fi", powers.rotation[turns], base[:, :ANGLE]) + powers.shift[turns]
    return np.concatenate([place, base[:, ANGLE:] + powers.angle[turns][:, None]], axis=1)


def _end(motion: Motion, step: float) -> float:
    """The time (s) up to which a motion can be interpolated: some steps must lie beyond."""
    return step * (len(motion.observed) - 3)


def is_steady(motion: Motion, step: float, period: float, until: float) -> bool:
    """Whether the last two turns say the same about where the robot is at time `until` (s)."""
    end = _end(motion, step)
    if end < FEWEST_TURNS * period:
        return False
    count = max(1, int(np.ceil((until - end) / period)))
    last, before = (screw(motion, step, period, end - k * period) for k in (0, 1))
    powers = [one.powers(count) for one in (last, before)]
    here = interpolation(np.array([end]), step)(motion.observed)[0, :ANGLE]
    places = [one.rotation[-1] @ here + one.shift[-1] for one in powers]
    way = np.linalg.norm(places[0] - motion.observed[0, :ANGLE])
    turned = powers[0].rotation[-1] @ powers[1].rotation[-1].T
    tilt = np.linalg.norm(turned - np.eye(3)) / np.sqrt(2.0)
    return bool(
        np.linalg.norm(places[0] - places[1]) <= SAME_PLACE * way
        and abs(powers[0].angle[-1] - powers[1].angle[-1]) <= SAME_ANGLE
        and tilt <= SAME_ANGLE
    )
