"""Noise with outliers and memory: levels that are found, errors that are right, exact gradients."""

import numpy as np
import pytest

from fitting.noise import PRIOR, NoisyResiduals
from fitting.uncertainty import linear_fit, shifted, uncertainty

FRAMES, SERIES = 300, 2


def made(shape="gaussian", correlated=False, rho=0.0, outliers=0.0, seed=0, sigma=np.nan):
    """Noise of size 0.1 on two series, and a model of two numbers; the truth is zero."""
    rng = np.random.default_rng(seed)
    values = []
    for _ in range(SERIES):
        new = 0.1 * rng.normal(size=FRAMES)
        one = np.zeros(FRAMES)
        one[0] = new[0]
        for k in range(1, FRAMES):
            one[k] = rho * one[k - 1] + np.sqrt(1 - rho**2) * new[k]
        wrong = rng.random(FRAMES) < outliers
        one[wrong] += rng.normal(size=wrong.sum())
        values.append(one)
    time = np.linspace(0, 1, FRAMES)
    jacobian = np.concatenate([np.stack([np.ones(FRAMES), time], axis=1)] * SERIES)
    count = FRAMES * SERIES
    return NoisyResiduals(
        value=np.concatenate(values),
        jacobian=jacobian,
        kind=np.zeros(count, int),
        sigma=np.full(count, sigma),
        resolution=np.full(count, 1e-9),
        series=np.repeat(np.arange(SERIES), FRAMES),
        gap=np.ones(count),
        shape=shape,
        correlated=correlated,
    )


@pytest.mark.parametrize("shape", ["gaussian", "student", "huber"])
@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_the_gradient_of_the_loss_is_that_of_weighted_least_squares(shape, rho) -> None:
    residuals = made(shape, rho > 0, rho, outliers=0.02)
    r, jacobian = residuals.whitened()
    ends = [shifted(residuals, s * 1e-4 * np.array([1.0, -0.5])).loss() for s in (1, -1)]
    along = float(r @ jacobian @ np.array([1.0, -0.5]))
    assert (ends[0] - ends[1]) / 2e-4 == pytest.approx(along, rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_the_memory_of_noise_is_found(rho) -> None:
    level = made(correlated=True, rho=rho).levels[0]
    assert level.rho == pytest.approx(rho, abs=0.08)
    assert level.scale == pytest.approx(0.1, rel=0.25)


CASES = {
    "plain": ("gaussian", False, 0.0, 0.0),
    "memory": ("gaussian", True, 0.8, 0.0),
    "outliers": ("student", False, 0.0, 0.02),
    "outliers, Huber": ("huber", False, 0.0, 0.02),
    "both": ("student", True, 0.8, 0.02),
}


def coverage(shape: str, correlated: bool, rho: float, outliers: float) -> np.ndarray:
    hits = np.zeros(2)
    for seed in range(100):
        residuals = made(shape, correlated, rho, outliers, seed)
        change = linear_fit(residuals, 30)
        known = uncertainty(shifted(residuals, change), ["a", "b"])
        hits += np.abs(change) <= known.quantile * known.std
    return hits


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n == "both" else ()) for n in CASES]
)
def test_intervals_cover(name) -> None:
    assert (coverage(*CASES[name]) >= 90).all()


def test_intervals_that_ignore_memory_do_not() -> None:
    assert (coverage("gaussian", False, 0.8, 0.0) < 80).all()


def test_outliers_widen_errors_that_ignore_them() -> None:
    """A camera that is wrong in 2 % of frames: half of the error is gone with the right noise."""
    errors = {}
    for shape in ("gaussian", "student", "huber"):
        residuals = made(shape, outliers=0.02)
        fitted = shifted(residuals, linear_fit(residuals, 30))
        errors[shape] = uncertainty(fitted, ["a", "b"]).std
    assert (errors["student"] < 0.8 * errors["gaussian"]).all()
    assert (errors["huber"] < 0.8 * errors["gaussian"]).all()


def test_what_is_known_beforehand_counts_as_it_says() -> None:
    data = made(sigma=0.1)
    fields = {"value": [0.3], "kind": [PRIOR], "sigma": [0.001], "resolution": [0.0]}
    fields |= {"series": [9], "gap": [1.0]}
    joined = {name: np.r_[getattr(data, name), value] for name, value in fields.items()}
    both = NoisyResiduals(jacobian=np.r_[data.jacobian, [[1.0, 0.0]]], **joined)
    change = linear_fit(both)
    assert change[0] == pytest.approx(-0.3, abs=0.01)
    assert uncertainty(both, ["a", "b"]).std[0] == pytest.approx(0.001, rel=0.05)
    assert both.noise_given
    assert both.observed.value.size == data.value.size
