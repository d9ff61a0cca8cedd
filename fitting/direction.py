"""Which way a track goes, beside the way that the motor drives the robot.

A helix that turns pushes its robot along its axis in a direction that only depends on its hand and
on the sense of the motor, and the head turns against the motor whatever the hand. A track that
goes the other way was read with another axis or sense, or has the wrong sign of `motor_rpm`.
"""

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float

from derjax import InputError, SceneFile
from derjax.core.errors import InputWarning

from .datasetfile import RunFile
from .observe import ANGLE, CHANNELS

CLEAR = 10.0
"""How many times its own uncertainty the slope of a channel is, for its sign to be sure."""

ENOUGH_PITCH, ENOUGH_ANGLE = 0.05, 0.5
"""Way, as a part of the pitch, and angle (rad) that count as motion."""

TURNS = 3.0
"""Turns of the motor that a track has to cover."""

_HANDS = {"left": 1.0, "right": -1.0}


def check_direction(
    path: Path,
    scene: SceneFile,
    keys: RunFile,
    time: Float[np.ndarray, " f"],
    values: Float[np.ndarray, "f c"],
    channels: tuple[int, ...],
) -> None:
    """Refuse a track that goes the other way in all that tells; warn if only in some of it.

    Args:
        path: of the track.
        scene: the robot and, unless `keys` has a rate, its motor.
        keys: of the run.
        time: (f,) s.
        values: (f, c) m and rad.
        channels: (c,) what they are.

    Raises:
        InputError: with the keys that would make it right.
    """
    expected = _expected(scene, keys)
    if expected is None or keys.backwards:
        return
    rate, senses = expected
    if abs(rate) / 60.0 * float(time[-1] - time[0]) < TURNS:
        return
    enough = {0: ENOUGH_PITCH * max(scene.robot.each("pitch")), ANGLE: ENOUGH_ANGLE}
    agree = {
        channel: np.sign(way) == senses[channel]
        for k, channel in enumerate(channels)
        if channel in senses and (way := _way(time, values[:, k])) and abs(way) > enough[channel]
    }
    wrong = [channel for channel, right in agree.items() if not right]
    if not wrong:
        return
    names = " and ".join(CHANNELS[channel] for channel in wrong)
    minus = ", ".join(
        f'{CHANNELS[c]} = "-{keys.tracked.get(CHANNELS[c], "...")}"'.replace('"--', '"')
        for c in wrong
    )
    said = (
        f"{path}: by {names} the robot {'swims' if 0 in wrong else 'turns'} the other way than its "
        f"motor drives it: with motor_rpm = {rate:g} and the [robot] handedness it should "
        + " and ".join(_should(channel, senses[channel]) for channel in wrong)
    )
    if len(wrong) < len(agree):
        warnings.warn(
            f"{said}; a minus turns it: columns = {{ {minus} }}", InputWarning, stacklevel=2
        )
        return
    raise InputError(
        f"{said}. Right would be motor_rpm = {-rate:g}, the other handedness, or other senses of "
        f"the axes (axes, y_down, or a minus: columns = {{ {minus} }}); if it does swim so, say "
        "backwards = true"
    )


def _expected(scene: SceneFile, keys: RunFile) -> tuple[float, dict[int, float]] | None:
    """The rate (rpm), and the signs of the way along x and of the head's angle that go with it.

    None where they are not clear: motors with different senses, or other things that drive.
    """
    if scene.motor_table is not None or scene.gravity is not None or keys.drift:
        return None
    if scene.robot.shape != "helix":
        return None
    given = scene.parameters["rpm"] if keys.motor_rpm is None else keys.motor_rpm
    rates = np.broadcast_to(np.asarray(given, float), scene.robot.count)
    if not (np.all(rates > 0) or np.all(rates < 0)):
        return None
    sense = float(np.sign(rates[0]))
    senses = {ANGLE: -sense}
    hands = {_HANDS[hand] for hand in scene.robot.hands}
    if len(hands) == 1:
        senses[0] = -sense * hands.pop()
    return float(rates[0]), senses


def _should(channel: int, sense: float) -> str:
    if channel == ANGLE:
        return f"turn its head {'forwards' if sense > 0 else 'backwards'} (head_angle)"
    return f"go towards {'+' if sense > 0 else '-'}x"


def _way(time: Float[np.ndarray, " f"], value: Float[np.ndarray, " f"]) -> float:
    """How far a channel has gone by its mean slope; 0 if the sign of that is not sure."""
    slope, mean = np.polyfit(time - time.mean(), value, 1)
    rest = value - mean - slope * (time - time.mean())
    spread = np.sqrt(np.sum(rest**2) / max(len(time) - 2, 1) / np.sum((time - time.mean()) ** 2))
    return float(slope * np.ptp(time)) if abs(slope) > CLEAR * spread else 0.0
