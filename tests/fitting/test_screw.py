"""Motions that are continued by screw motions: exact ones, transients, and a simulated robot."""

from dataclasses import replace

import numpy as np
import pytest

from fitting.model import Model, predict
from fitting.observe import interpolation
from fitting.screw import Motion, extended, is_steady, screw
from fitting.simulate import Simulator
from fitting.tracks import Dataset, Run

STEP, PERIOD = 0.05, 0.83
AXIS = np.array([0.96, 0.28, 0.0])
"""Of the exact motion; not an axis of coordinates. The period is no whole number of steps."""


def turned(angle: np.ndarray) -> np.ndarray:
    """(t, 3, 3) rotations about `AXIS`."""
    x, y, z = AXIS
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    s, c = np.sin(angle)[:, None, None], (1 - np.cos(angle))[:, None, None]
    return np.eye(3) + s * k + c * k @ k


def helix(times: np.ndarray, decaying: float = 0.0) -> Motion:
    """A head that moves along a helix and shakes once a period, after a transient of 1/e in 1 s."""
    rotation = turned(-0.4 * times)
    shaking = 1e-4 * np.sin(2 * np.pi * times / PERIOD)[:, None] * np.array([1.0, 2.0, 3.0])
    late = decaying * np.exp(-times)[:, None]
    place = np.einsum("tij,tj->ti", rotation, np.array([0.0, 0.0, 2e-3]) + shaking + late)
    place = place - 5e-4 * times[:, None] * AXIS + np.array([0.01, -0.02, 0.0])
    return Motion(np.concatenate([place, (-0.41 * times)[:, None]], axis=1), rotation)


def test_a_screw_motion_goes_on_for_ever() -> None:
    motion = helix(STEP * np.arange(90))
    times = np.array([0.0, 1.234, 4.3, 30.0, 61.7])
    expected = helix(times).observed
    found = extended(motion, STEP, PERIOD, times)
    # The path between steps is interpolated, where a step is a seventeenth of a period, and what
    # that is off by adds up over 70 turns, in which the head goes 31 mm.
    assert np.abs(found - expected)[:, :3].max() < 1e-5
    assert found[:, 3] == pytest.approx(expected[:, 3], abs=1e-9)
    one = screw(motion, STEP, PERIOD, 4.0)
    assert one.angle == pytest.approx(-0.41 * PERIOD)
    assert one.rotation @ AXIS == pytest.approx(AXIS, abs=1e-9)


def test_frames_that_were_simulated_are_interpolated() -> None:
    motion = helix(STEP * np.arange(90), decaying=1e-3)
    times = np.linspace(0.3, 4.2, 17)
    expected = interpolation(times, STEP)(motion.observed)
    assert np.array_equal(extended(motion, STEP, PERIOD, times), expected)


def test_a_transient_is_not_taken_for_steady() -> None:
    assert is_steady(helix(STEP * np.arange(90)), STEP, PERIOD, 60.0)
    assert not is_steady(helix(STEP * np.arange(90), decaying=0.05), STEP, PERIOD, 60.0)
    assert is_steady(helix(STEP * np.arange(400), decaying=0.05), STEP, PERIOD, 60.0)
    assert not is_steady(helix(STEP * np.arange(40)), STEP, PERIOD, 60.0)  # two turns only


@pytest.mark.slow
def test_previews_are_what_whole_simulations_give(scene, simulator: Simulator) -> None:
    times = np.linspace(1.0, 20.0, 20)
    run = Run("track", times, (0, 1, 2, 3), np.zeros((20, 4)))
    model = Model(Dataset(scene, (run,)), simulator.parameters)
    model.simulator = replace(simulator, steps_per_call=40)
    free = simulator.parameters.free({"C_t": 4.0, "C_r": 0.45})
    preview, whole = model.preview(free), model.whole(free)
    assert preview is not None
    assert whole is not None
    assert len(preview.model[0].time) < 0.6 * len(whole.model[0].time)
    for exposure in (0.0, 0.5):
        exposed = replace(run, exposure=exposure)
        short, long = (predict(exposed, t.model[0], scene.step, 1.0) for t in (preview, whole))
        way = np.abs(long.observed[-1, 0] - long.observed[0, 0])
        assert np.abs(short.observed - long.observed)[:, :3].max() < 1e-2 * way
        assert np.abs(short.observed - long.observed)[:, 3].max() < 0.1
        size = np.abs(long.sensitivity).max(axis=0)
        difference = np.abs(short.sensitivity - long.sensitivity).max(axis=0)
        assert (difference[[0, 3]] < 0.05 * size[[0, 3]].max(axis=-1, keepdims=True)).all()


def test_nothing_is_continued_that_does_not_repeat(scene, simulator: Simulator) -> None:
    run = Run("track", np.linspace(1.0, 20.0, 20), (0,), np.zeros((20, 1)))
    still = Model(Dataset(scene, (replace(run, motor_rpm=0.0),)), simulator.parameters)
    assert still.periods == [None]
    assert Model(Dataset(scene, (run,)), simulator.parameters).periods == [1.0]
