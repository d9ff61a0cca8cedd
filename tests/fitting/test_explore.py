"""The search beyond the basin of the start, on models whose loss is known everywhere."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fitting.explore import explore
from fitting.levenberg import Evaluation, minimise
from fitting.uncertainty import Residuals

TIMES = np.arange(1.0, 61.0)
WOBBLE = 0.1
"""Radius of the circle on which a head moves, in units of the speed of 1."""

TRUTH = np.log([1.0, 0.4])


def model(
    predict: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    noise: float,
    seed: int = 1,
    truth: np.ndarray = TRUTH,
) -> Callable[[np.ndarray], Evaluation[None]]:
    """Residuals against what `predict` says of the truth, plus noise that is not given."""
    exact, _ = predict(truth)
    data = exact + noise * np.random.default_rng(seed).normal(size=exact.size)

    def evaluate(free: np.ndarray) -> Evaluation[None]:
        evaluate.count += 1
        value, jacobian = predict(free)
        count = value.size
        unknown = np.full(count, np.nan)
        return Evaluation(
            Residuals(value - data, jacobian, np.zeros(count, int), unknown, np.full(count, 1e-9)),
            None,
        )

    evaluate.count = 0
    return evaluate


def wobbling(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A head that swims at a speed and turns at a rate, seen from its positions alone."""
    speed, rate = np.exp(free)
    phase = rate * TIMES
    value = np.concatenate([speed * TIMES, WOBBLE * np.cos(phase), WOBBLE * np.sin(phase)])
    zero = np.zeros_like(TIMES)
    by_speed = np.concatenate([speed * TIMES, zero, zero])
    by_rate = np.concatenate(
        [zero, -WOBBLE * phase * np.sin(phase), WOBBLE * phase * np.cos(phase)]
    )
    return value, np.stack([by_speed, by_rate], axis=1)


@pytest.mark.parametrize("factor", [0.3, 3.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_best_of_many_minima_is_found(factor: float, seed: int) -> None:
    evaluate = model(wobbling, noise=0.1, seed=seed)
    start = TRUTH + np.log(factor)
    downhill = minimise(evaluate, start)
    found = explore(evaluate, start)
    assert downhill is not None
    assert found is not None
    assert abs(downhill.free[1] - TRUTH[1]) > 0.1  # what goes downhill ends elsewhere
    assert found.optima[0].free == pytest.approx(TRUTH, abs=0.02)
    assert found.optima[0].loss < downhill.loss - 5.0
    assert found.walked == (False, True)
    assert found.held == (False, False)


def test_minima_that_noise_makes_are_all_accepted() -> None:
    """With noise ten times the wobble the rate cannot be told, and many rates are as good."""
    found = explore(model(wobbling, noise=1.0), TRUTH)
    assert found is not None
    rates = np.array([free[1] for free in found.accepted(2.0)])
    assert rates.min() < TRUTH[1] - 1.0
    assert rates.max() > TRUTH[1] + 1.0


def test_a_valley_has_no_end() -> None:
    def product(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value = np.exp(free.sum()) * TIMES
        return value, np.stack([value, value], axis=1)

    found = explore(model(product, noise=0.1), TRUTH + 1.0)
    assert found is not None
    assert found.held == (False, False)
    assert found.walked == (True, True)
    for k in range(2):
        reached = np.array([free[k] for free in found.accepted(2.0)])
        assert reached.min() < found.limits[k, 0] + 0.1
        assert reached.max() > found.limits[k, 1] - 0.1
    assert found.optima[0].free.sum() == pytest.approx(TRUTH.sum(), abs=0.01)


def test_what_hardly_matters_is_held_and_spoils_nothing() -> None:
    def faint(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        first, second = np.exp(free)
        shape = np.sin(TIMES)
        value = first * TIMES + 1e-3 * second * (TIMES + shape)
        return value, np.stack([first * TIMES, 1e-3 * second * (TIMES + shape)], axis=1)

    start = TRUTH + np.array([1.5, 1.0])
    found = explore(model(faint, noise=0.1), start)
    assert found is not None
    assert found.held == (False, True)
    best = found.optima[0]
    assert best.free[1] == start[1]
    # What the second parameter adds is taken from the first, and is part of its error.
    assert best.free[0] == pytest.approx(TRUTH[0], abs=2 * found.spread[0])
    assert 1e-3 < found.spread[0] < 0.02


def test_a_loss_with_one_minimum_costs_little() -> None:
    def plain(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        speed, rate = np.exp(free)
        value = np.concatenate([speed * TIMES, rate * TIMES])
        zero = np.zeros_like(TIMES)
        columns = [np.concatenate([speed * TIMES, zero]), np.concatenate([zero, rate * TIMES])]
        return value, np.stack(columns, axis=1)

    evaluate = model(plain, noise=0.1)
    found = explore(evaluate, TRUTH + np.log([5.0, 0.2]))
    assert found is not None
    assert found.optima[0].free == pytest.approx(TRUTH, abs=0.01)
    assert found.points == ()
    assert evaluate.count <= 16


def saturating(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Something that only ever falls with one parameter, and a second one."""
    first, second = np.exp(free)
    value = np.concatenate([TIMES / first, second * TIMES])
    zero = np.zeros_like(TIMES)
    columns = [np.concatenate([-TIMES / first, zero]), np.concatenate([zero, second * TIMES])]
    return value, np.stack(columns, axis=1)


@pytest.mark.parametrize("noise", [0.1, 3.0])
def test_a_search_that_runs_away_ends_soon(noise: float) -> None:
    """Data of the other sign are fitted the better the larger the parameter."""

    inner = model(saturating, noise)

    def evaluate(free: np.ndarray) -> Evaluation[None]:
        trial = inner(free)
        shift = np.concatenate([2.0 * TIMES, 0.0 * TIMES])
        moved = replace(trial.residuals, value=trial.residuals.value + shift)
        return replace(trial, residuals=moved)

    found = explore(evaluate, TRUTH)
    assert found is not None
    assert found.optima[0].status == "diverged"
    assert found.optima[0].free[0] > TRUTH[0] + np.log(30.0)
    assert found.optima[0].free[1] == pytest.approx(TRUTH[1], abs=0.1)
    assert found.held == (False, False)
    assert inner.count <= 40


def test_an_optimum_near_the_start_is_found_though_the_search_runs_away() -> None:
    """From the start the way down leads to a plateau; the optimum is at the other side."""

    def bump(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        (x,) = free
        hill, step = np.exp(-2.0 * (x + 1.0) ** 2), 1.0 / (1.0 + np.exp(-2.0 * (x - 1.0)))
        slope = -4.0 * (x + 1.0) * hill + 0.6 * step * (1.0 - step)
        return (hill + 0.3 * step) * TIMES, (slope * TIMES)[:, None]

    evaluate = model(bump, noise=0.1, truth=np.array([-1.1]))
    start = np.array([0.6])
    downhill = minimise(evaluate, start)
    assert downhill is not None
    assert downhill.free[0] > 4.0
    found = explore(evaluate, start)
    assert found is not None
    assert found.optima[0].status == "converged"
    assert found.optima[0].loss < downhill.loss - 50.0
    assert -1.3 < found.optima[0].free[0] < -0.7
    assert all(optimum.free[0] < 3.0 for optimum in found.optima)


def test_a_start_that_fails() -> None:
    assert explore(lambda free: None, TRUTH) is None


def test_ctrl_c_gives_the_best_so_far() -> None:
    inner = model(wobbling, noise=0.1)

    def evaluate(free: np.ndarray) -> Evaluation[None]:
        if inner.count == 20:
            raise KeyboardInterrupt
        return inner(free)

    found = explore(evaluate, TRUTH + 1.0)
    assert found is not None
    assert [o.status for o in found.optima] == ["interrupted"]
