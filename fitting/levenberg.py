"""Levenberg-Marquardt: least squares for few parameters with an exact Jacobian."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float

from .uncertainty import Residuals

T = TypeVar("T")

LONGEST_STEP = 2.0
"""Of a free parameter in one iteration; on a logarithmic scale a factor of 7.4."""


@dataclass(frozen=True)
class Trial(Generic[T]):
    """The model at one set of parameters.

    Attributes:
        residuals: with their Jacobian.
        model: what they were computed from, for the caller.
    """

    residuals: Residuals
    model: T


@dataclass(frozen=True)
class Iteration:
    """One iteration: an accepted or a rejected step.

    Attributes:
        free: (p,) free parameters, the best so far.
        loss: there; see `Residuals.loss`.
        rms: root mean square of the residuals (m, rad) of every kind there is.
        accepted: whether this step was an improvement.
        damping: for the next step.
        seconds: that it took.
    """

    free: Float[np.ndarray, " p"]
    loss: float
    rms: dict[str, float]
    accepted: bool
    damping: float
    seconds: float


@dataclass(frozen=True)
class Optimum(Generic[T]):
    """Where the search ended.

    Attributes:
        free: (p,) best free parameters.
        trial: the model there.
        status: "converged"; "max_iterations"; "stalled", if no step improves although the
            gradient has not vanished; "interrupted".
        history: every iteration; the first is the evaluation of the start.
    """

    free: Float[np.ndarray, " p"]
    trial: Trial[T]
    status: str
    history: tuple[Iteration, ...]


def minimise(
    evaluate: Callable[[Float[np.ndarray, " p"]], Trial[T] | None],
    start: Float[np.ndarray, " p"],
    *,
    max_iterations: int = 30,
    step_tolerance: float = 1e-6,
    gain_tolerance: float = 1e-3,
    on_iteration: Callable[[Iteration], None] = lambda iteration: None,
) -> Optimum[T] | None:
    """Parameters that minimise `Residuals.loss`.

    The damping follows the ratio of actual to predicted gain (Nielsen 1999). Converged is
    when the next step is short, or would gain less than `gain_tolerance` in log likelihood:
    1e-3 is a step of 4.5 % of a standard error, a change that nobody could measure.

    Args:
        evaluate: the model at a free vector; None where it cannot be computed: such a step is
            rejected.
        start: (p,) free vector.
        max_iterations: accepted and rejected steps.
        step_tolerance: of the free parameters.
        gain_tolerance: of the loss.
        on_iteration: called after every iteration.

    Returns:
        The optimum, or the best point so far after Ctrl-C; None if the model cannot be
        computed at `start`.

    Raises:
        KeyboardInterrupt: before the model at `start` was known.
    """
    begun = time.perf_counter()
    first = evaluate(start)
    if first is None:
        return None
    best: Trial[T] = first
    free = np.array(start, dtype=float)
    damping, growth = 1e-3, 2.0
    history: list[Iteration] = []

    def note(accepted: bool) -> None:
        nonlocal begun
        now = time.perf_counter()
        loss, rms = best.residuals.loss(), best.residuals.rms()
        history.append(Iteration(free.copy(), loss, rms, accepted, damping, now - begun))
        begun = now
        on_iteration(history[-1])

    def ended(status: str) -> Optimum[T]:
        return Optimum(free, best, status, tuple(history))

    try:
        note(True)
        while True:
            step, gain = _step(best.residuals, damping)
            # A step that is short because of the damping is no sign of convergence.
            full, full_gain = _step(best.residuals, min(damping, 1e-3))
            if np.abs(full).max() < step_tolerance or full_gain < gain_tolerance:
                return ended("converged")
            if damping > 1e10 or np.abs(step).max() < 1e-3 * step_tolerance:
                return ended("stalled")
            if len(history) > max_iterations:
                return ended("max_iterations")
            trial = evaluate(free + step)
            actual = -np.inf
            if trial is not None:
                actual = best.residuals.loss() - trial.residuals.loss()
            accepted = bool(actual > 0)
            if accepted and trial is not None:
                free, best = free + step, trial
                damping *= max(1 / 10, 1 - (2 * min(actual / gain, 1.0) - 1) ** 3)
                growth = 2.0
            else:
                damping *= growth * 2
                growth *= 2
            note(accepted)
    except KeyboardInterrupt:
        return ended("interrupted")


def _step(residuals: Residuals, damping: float) -> tuple[Float[np.ndarray, " p"], float]:
    """A damped Gauss-Newton step and the gain in loss that the linear model promises."""
    r, jacobian = residuals.whitened()
    gradient = jacobian.T @ r
    normal = jacobian.T @ jacobian
    diagonal = np.diag(normal)
    # A parameter without any effect must not make the matrix singular.
    floor = max(1e-12 * diagonal.max(), np.finfo(float).tiny)
    damped = normal + damping * np.diag(np.maximum(diagonal, floor))
    step = -np.linalg.solve(damped, gradient)
    step *= min(1.0, LONGEST_STEP / max(np.abs(step).max(), 1e-300))
    return step, float(-(gradient @ step) - 0.5 * step @ normal @ step)
