"""The search on its own: small problems with known answers, failures, interruptions."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import least_squares

from fitting.levenberg import Evaluation, minimise
from fitting.uncertainty import Residuals


def trial_of(value: np.ndarray, jacobian: np.ndarray) -> Evaluation[None]:
    m = value.size
    one = np.ones(m)
    return Evaluation(Residuals(value, jacobian, np.zeros(m, int), one, 1e-9 * one), None)


def rosenbrock(free: np.ndarray) -> Evaluation[None]:
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


T = np.linspace(0.0, 2.0, 30)
RNG = np.random.default_rng(11)
NOISE = 0.01 * RNG.normal(size=T.size)


def decay(free: np.ndarray) -> Evaluation[None]:
    """A decay to a constant, with logarithms of amplitude and rate."""
    a, k = np.exp(free[:2])
    curve = a * np.exp(-k * T)
    value = curve + free[2] - (2.0 * np.exp(-1.5 * T) + 0.3 + NOISE)
    return trial_of(value, np.stack([curve, -k * T * curve, np.ones_like(T)], axis=1))


def wave(free: np.ndarray) -> Evaluation[None]:
    """Amplitude, frequency and phase of a sine."""
    a, w, p = free
    value = a * np.sin(w * T + p) - (1.2 * np.sin(3.0 * T + 0.5) + NOISE)
    inner = a * np.cos(w * T + p)
    return trial_of(value, np.stack([np.sin(w * T + p), T * inner, inner], axis=1))


@pytest.mark.parametrize(
    ("model", "start"),
    [(decay, (0.0, 0.0, 0.0)), (wave, (0.5, 2.6, 0.2)), (rosenbrock, (-1.2, 1.0))],
)
def test_the_optimum_is_that_of_scipy(
    model: Callable[[np.ndarray], Evaluation[None]], start: tuple[float, ...]
) -> None:
    expected = least_squares(
        lambda free: model(free).residuals.value,
        start,
        jac=lambda free: model(free).residuals.jacobian,  # pyright: ignore[reportArgumentType]
        method="lm",
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    found = minimise(model, np.array(start), gain_tolerance=1e-18, step_tolerance=1e-9)
    assert found is not None
    assert found.status == "converged"
    assert found.free == pytest.approx(expected.x, rel=1e-7)
    assert found.loss == pytest.approx(expected.cost, rel=1e-10)
    assert len(found.history) <= expected.nfev + 10


def beside_one_that_hardly_matters(free: np.ndarray) -> Evaluation[None]:
    """A decay whose rate is known well, and a second parameter that is next to without effect."""
    k = np.exp(free[0])
    value = np.exp(-k * T) - np.exp(-1.5 * T) + 1e-8 * free[1] * T - 1e-3 * T
    return trial_of(100 * value, 100 * np.stack([-k * T * np.exp(-k * T), 1e-8 * T], axis=1))


def test_a_parameter_that_hardly_matters_does_not_spoil_the_other() -> None:
    """It would have to be 1e5 to do anything: the other is found as if it were not there."""
    alone = minimise(
        lambda free: trial_of(
            beside_one_that_hardly_matters(np.append(free, 0.0)).residuals.value,
            beside_one_that_hardly_matters(np.append(free, 0.0)).residuals.jacobian[:, :1],
        ),
        np.array([2.0]),
        gain_tolerance=1e-18,
        step_tolerance=1e-9,
    )
    found = minimise(beside_one_that_hardly_matters, np.array([2.0, 0.0]))
    assert alone is not None
    assert found is not None
    assert alone.status == "converged"
    assert np.isfinite(found.free).all()
    assert found.free[0] == pytest.approx(alone.free[0], abs=1e-4)


def scaled(scale: np.ndarray) -> Callable[[np.ndarray], Evaluation[None]]:
    """The decay with its parameters in other units."""

    def model(free: np.ndarray) -> Evaluation[None]:
        trial = decay(free / scale)
        residuals = trial.residuals
        return trial_of(residuals.value, residuals.jacobian / scale)

    return model


@pytest.mark.parametrize("scale", [(1e-3, 1.0, 1.0), (1.0, 1e-3, 1e-2), (0.1, 0.3, 1e-4)])
def test_convergence_does_not_depend_on_units(scale: tuple[float, ...]) -> None:
    """As long as no step is longer than a step may be."""
    start = np.array([0.4, 0.2, 0.1])
    unit = np.array(scale)
    expected = minimise(decay, start, gain_tolerance=1e-12, step_tolerance=0.0)
    found = minimise(scaled(unit), unit * start, gain_tolerance=1e-12, step_tolerance=0.0)
    assert expected is not None
    assert found is not None
    assert found.status == expected.status == "converged"
    assert found.free / unit == pytest.approx(expected.free, rel=1e-6)
    assert len(found.history) == len(expected.history)
    for one, other in zip(found.history, expected.history, strict=True):
        assert one.loss == pytest.approx(other.loss, rel=1e-6)


def test_without_parameters_there_is_nothing_to_search() -> None:
    found = minimise(lambda free: trial_of(np.ones(3), np.zeros((3, 0))), np.zeros(0))
    assert found is not None
    assert found.status == "converged"
    assert found.loss == pytest.approx(1.5)


def test_a_valley_that_is_flatter_than_least_squares_think_costs_little() -> None:
    """Half of x^2 + (x^2 / 2 - 0.9)^2: its curvature is a tenth of what the Jacobian says.

    Steps of Gauss and Newton would go a tenth of the way each, and need 88 for this accuracy.
    """

    def flat(free: np.ndarray) -> Evaluation[None]:
        (x,) = free
        return trial_of(np.array([x, 0.5 * x**2 - 0.9]), np.array([[1.0], [x]]))

    found = minimise(flat, np.array([0.3]), gain_tolerance=0.0, step_tolerance=3e-6)
    assert found is not None
    assert found.status == "converged"
    assert abs(found.free[0]) < 1e-4
    assert len(found.history) < 30
