"""Noise, covariance, intervals and degeneracy, against repeated experiments."""

from dataclasses import replace

import numpy as np
import pytest

from fitting.uncertainty import Residuals, coverage, linear_fit, shifted, uncertainty

SIGMA = np.array([2e-4, 0.03])
"""Noise of positions (m) and angles (rad)."""


@pytest.fixture
def linear() -> Residuals:
    """Forty frames of a position that grows with time and an angle, two parameters."""
    t = np.linspace(0.0, 1.0, 40)
    position = 1e-3 * np.stack([t, 0.3 * t**2], axis=1)
    angle = np.stack([0.1 * t, -t], axis=1)
    kind = np.repeat([0, 1], 40)
    return Residuals(
        value=np.zeros(80),
        jacobian=np.concatenate([position, angle]),
        kind=kind,
        sigma=np.full(80, np.nan),
        resolution=1e-7 * SIGMA[kind],
    )


def noisy(residuals: Residuals, seed: int) -> Residuals:
    noise = SIGMA[residuals.kind] * np.random.default_rng(seed).normal(size=residuals.kind.size)
    return replace(residuals, value=noise)


@pytest.mark.parametrize("given", [True, False])
def test_covariance_is_that_of_repeated_experiments(linear, given) -> None:
    if given:
        linear = replace(linear, sigma=SIGMA[linear.kind])
    fits, claimed = [], []
    for seed in range(400):
        trial = noisy(linear, seed)
        change = linear_fit(trial)
        known = uncertainty(shifted(trial, change), ("a", "b"))
        fits.append(change)
        claimed.append(np.append(known.std, known.correlation[0, 1]))
    covariance = np.cov(np.array(fits).T)
    std = np.sqrt(np.diag(covariance))
    # 400 experiments know a standard deviation to 3.5 %, a correlation to 0.05.
    mean = np.mean(claimed, axis=0)
    assert mean[:2] == pytest.approx(std, rel=0.12)
    assert mean[2] == pytest.approx(covariance[0, 1] / std.prod(), abs=0.15)


def test_estimated_noise_is_right(linear) -> None:
    variances = np.mean([noisy(linear, seed).variances()[[0, -1]] for seed in range(50)], axis=0)
    assert np.sqrt(variances) == pytest.approx(SIGMA, rel=0.05)


@pytest.mark.parametrize("given", [True, False])
def test_truth_lies_in_the_interval_as_often_as_claimed(linear, given) -> None:
    if given:
        linear = replace(linear, sigma=SIGMA[linear.kind])
    fraction = coverage(linear, SIGMA[linear.kind], range(1000))
    assert (abs(fraction - 0.95) < 0.025).all()


def test_coverage_notices_intervals_that_are_too_small(linear) -> None:
    overconfident = replace(linear, sigma=0.5 * SIGMA[linear.kind])
    assert (coverage(overconfident, SIGMA[linear.kind], range(200)) < 0.8).all()


def test_few_observations_widen_the_interval(linear) -> None:
    few = noisy(linear, 1)
    few = Residuals(
        *(getattr(few, f)[::16] for f in ("value", "jacobian", "kind", "sigma")),
        few.resolution[::16],
    )
    known = uncertainty(few, ("a", "b"))
    assert few.degrees_of_freedom == 3
    assert known.quantile == pytest.approx(3.18, abs=0.01)
    given = replace(few, sigma=SIGMA[few.kind])
    assert uncertainty(given, ("a", "b")).quantile == pytest.approx(1.96, abs=0.01)


@pytest.mark.parametrize("given", [True, False])
def test_the_gradient_of_the_loss_is_that_of_weighted_least_squares(linear, given) -> None:
    trial = noisy(linear, 3)
    if given:
        trial = replace(trial, sigma=SIGMA[linear.kind])
    r, jacobian = trial.whitened()
    gradient, h = jacobian.T @ r, 1e-5
    for i, along in enumerate(np.eye(2)):
        slope = (shifted(trial, h * along).loss() - shifted(trial, -h * along).loss()) / (2 * h)
        assert slope == pytest.approx(gradient[i], rel=1e-6)


def test_nothing_is_to_be_known_without_parameters(linear) -> None:
    known = uncertainty(replace(noisy(linear, 0), jacobian=np.empty((80, 0))), ())
    assert known.std.shape == (0,)
    assert known.quantile == pytest.approx(1.99, abs=0.01)


def test_a_parameter_without_effect_is_named(linear) -> None:
    jacobian = np.c_[linear.jacobian, np.zeros(80)]
    known = uncertainty(replace(noisy(linear, 0), jacobian=jacobian), ("a", "b", "density"))
    assert np.isinf(known.std[2])
    assert np.isfinite(known.std[:2]).all()
    (warning,) = known.warnings
    assert "density is not identifiable" in warning


def test_a_degenerate_pair_is_named_with_the_direction(linear) -> None:
    jacobian = np.c_[linear.jacobian, -2 * linear.jacobian[:, 1]]
    known = uncertainty(replace(noisy(linear, 0), jacobian=jacobian), ("a", "b", "c"))
    assert np.isinf(known.std).tolist() == [False, True, True]
    (warning,) = known.warnings
    assert "b and c are not identifiable together" in warning
    assert "stay as they are under b x 2, c x 1.41" in warning
    assert "scale" in warning


def test_a_weak_parameter_is_named(linear) -> None:
    weak = linear.jacobian * np.array([1.0, 1e-3])
    known = uncertainty(replace(noisy(linear, 0), jacobian=weak), ("a", "b"))
    assert 1 < known.std[1] < np.inf
    (warning,) = known.warnings
    assert "b is not identifiable: it hardly changes the tracks" in warning
    strong = uncertainty(noisy(linear, 0), ("a", "b"))
    assert strong.warnings == ()


def test_a_nearly_degenerate_pair_is_named(linear) -> None:
    shape = np.random.default_rng(0).normal(size=80) * SIGMA[linear.kind]
    jacobian = np.c_[linear.jacobian, 0.01 * shape - linear.jacobian[:, 1]]
    known = uncertainty(replace(noisy(linear, 0), jacobian=jacobian), ("a", "b", "c"))
    assert (known.std[1:] > 1).all()
    assert np.isfinite(known.std).all()
    assert known.correlation[1, 2] > 0.99
    (warning,) = known.warnings
    assert "change by less than their noise under b x 2, c x 2" in warning
