"""What residuals say of a fit: noise is called noise, and nothing else is."""

import numpy as np
import pytest

from fitting.goodness import goodness
from fitting.residuals import Predicted, run_residuals
from fitting.tracks import Run

TIMES = np.arange(60.0)
SIZE = 0.1
"""m, length of the robot."""

NOISE = np.array([1e-4, 1e-4, 0.02])


def judged(value: np.ndarray, sigma: float | None = None, sigma_angle: float | None = None):
    """The judgement on residuals (f, 3) of x, y and the angle."""
    run = Run("track", TIMES, (0, 1, 3), -value, 60.0, sigma, sigma_angle)
    predicted = Predicted(np.zeros((len(TIMES), 4)), np.zeros((len(TIMES), 4, 2)))
    return goodness(run_residuals(run, predicted), [run], [value], SIZE)


def noise(seed: int) -> np.ndarray:
    return NOISE * np.random.default_rng(seed).normal(size=(len(TIMES), 3))


def test_white_noise_is_good() -> None:
    given = [judged(noise(seed), 1e-4, 0.02) for seed in range(300)]
    estimated = [judged(noise(seed)) for seed in range(300)]
    # One in ten thousand for every kind of test.
    assert sum(not one.good for one in given) <= 2
    assert sum(not one.good for one in estimated) <= 2
    assert all(one.inflation == 1.0 for one in given if one.good)
    p_values = np.array([one.p_value for one in given])
    assert np.mean(p_values < 0.5) == pytest.approx(0.5, abs=0.1)


def test_p_values_of_order_are_those_of_chance() -> None:
    p_values = [order.p_value for seed in range(300) for order in judged(noise(seed)).orders]
    # The smaller of two probabilities, doubled: conservative where the two agree.
    assert np.mean(np.array(p_values) < 0.1) < 0.12
    assert np.mean(np.array(p_values) < 0.01) < 0.02


def test_noise_larger_than_given() -> None:
    one = judged(1.5 * noise(1), 1e-4, 0.02)
    assert "residuals exceed the noise that was given" in one.findings[0]
    assert "degrees of freedom" in one.sentence()
    assert one.chi2 is not None
    assert one.inflation == pytest.approx(np.sqrt(one.chi2 / one.degrees_of_freedom))
    assert 1.2 < one.inflation < 1.8
    assert one.p_value is not None
    assert one.p_value < 1e-6


def test_noise_far_smaller_than_given() -> None:
    """That is no misfit: nothing is wrong but the noise that was given."""
    one = judged(0.2 * noise(1), 1e-4, 0.02)
    assert one.good
    assert one.exaggeration == pytest.approx(5.0, rel=0.2)
    assert "times larger than the residuals" in one.remark()
    assert "sigma or sigma_angle is too large" in one.remark()
    assert one.inflation == 1.0
    assert judged(noise(1), 1e-4, 0.02).remark() == ""
    assert judged(0 * noise(1), 1e-4, 0.02).exaggeration > 1e6


def test_a_slow_swing_is_no_noise() -> None:
    swing = noise(1)
    swing[:, 1] += 3e-4 * np.sin(0.2 * TIMES)
    one = judged(swing)
    assert not one.good
    assert "residuals of y in track are not noise" in one.sentence()
    found = {order.channel: order for order in one.orders}
    assert found["y"].autocorrelation > 0.6
    assert found["y"].runs < found["y"].expected_runs - 10
    assert found["x"].p_value > 0.01
    assert one.inflation > 1.5


def test_residuals_larger_than_those_of_a_camera() -> None:
    one = judged(noise(1) * np.array([20.0, 20.0, 10.0]))
    assert one.relative_rms == pytest.approx(0.02, rel=0.2)
    said = one.sentence()
    assert "% of the robot's length" in said
    assert "the head_angle is off by" in said


def test_the_order_of_what_no_camera_sees_does_not_matter() -> None:
    swing = np.outer(np.sin(0.2 * TIMES), [1e-6, 1e-6, 1e-4])
    assert judged(swing).good
