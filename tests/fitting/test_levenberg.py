"""The search on its own: small problems with known answers, failures, interruptions."""

import itertools

import numpy as np
import pytest

from fitting.levenberg import Trial, minimise
from fitting.uncertainty import Residuals


def trial_of(value: np.ndarray, jacobian: np.ndarray) -> Trial[None]:
    m = value.size
    one = np.ones(m)
    return Trial(Residuals(value, jacobian, np.zeros(m, int), one, 1e-9 * one), None)


def rosenbrock(free: np.ndarray) -> Trial[None]:
    x, y = free
    return trial_of(np.array([10 * (y - x**2), 1 - x]), np.array([[-20 * x, 10.0], [-1.0, 0.0]]))


def test_a_curved_valley_is_followed_to_its_minimum() -> None:
    found = minimise(rosenbrock, np.array([-1.2, 1.0]), gain_tolerance=1e-16, max_iterations=60)
    assert found is not None
    assert found.status == "converged"
    assert found.free == pytest.approx([1.0, 1.0], abs=1e-6)
    losses = [iteration.loss for iteration in found.history]
    assert all(b <= a for a, b in itertools.pairwise(losses))
    assert any(not iteration.accepted for iteration in found.history)


def test_failed_models_are_avoided() -> None:
    def evaluate(free):
        return None if free[0] > 1.5 else trial_of(free**2 - 1.0, np.diag(2 * free))

    found = minimise(evaluate, np.array([0.25]), gain_tolerance=1e-14)
    assert found is not None
    assert found.status == "converged"
    assert not found.history[1].accepted  # the first step leads too far
    assert found.free == pytest.approx([1.0], abs=1e-5)


def test_a_start_that_fails() -> None:
    assert minimise(lambda free: None, np.zeros(1)) is None


def test_iterations_are_limited() -> None:
    found = minimise(rosenbrock, np.array([-1.2, 1.0]), gain_tolerance=1e-16, max_iterations=3)
    assert found is not None
    assert found.status == "max_iterations"
    assert len(found.history) == 4


def test_a_wrong_jacobian_stalls() -> None:
    found = minimise(
        lambda free: trial_of(1.0 + free**2, -2 * np.diag(free) - 1.0),
        np.array([0.5]),
        max_iterations=100,
    )
    assert found is not None
    assert found.status == "stalled"


def test_an_interruption_keeps_the_best() -> None:
    calls = 0

    def evaluate(free):
        nonlocal calls
        calls += 1
        if calls == 4:
            raise KeyboardInterrupt
        return rosenbrock(free)

    found = minimise(evaluate, np.array([-1.2, 1.0]), gain_tolerance=1e-16)
    assert found is not None
    assert found.status == "interrupted"
    assert found.trial.residuals.loss() == min(i.loss for i in found.history)
    assert found.trial.residuals.loss() < rosenbrock(np.array([-1.2, 1.0])).residuals.loss()


def test_a_parameter_without_effect_does_no_harm() -> None:
    jacobian = np.array([[1.0, 0.0], [2.0, 0.0]])
    found = minimise(
        lambda free: trial_of(jacobian @ free - np.array([1.0, 2.0]), jacobian),
        np.array([5.0, 7.0]),
    )
    assert found is not None
    assert found.status == "converged"
    assert found.free == pytest.approx([1.0, 7.0], abs=0.05)
