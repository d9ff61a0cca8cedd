"""Levenberg-Marquardt: least squares for few parameters with an exact Jacobian."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float

from .uncertainty import RANK_TOLERANCE, Residuals, shifted

T = TypeVar("T")

LONGEST_STEP = 2.0
"""Of a free parameter in one iteration; on a logarithmic scale a factor of 7.4."""


LONGEST_STRETCH = 4.0
"""By which steps are lengthened where the loss is less curved than least squares think."""

SAME_WAY = 0.95
"""Cosine of the angle between the effects of two steps that go the same way."""


@dataclass(frozen=True)
class Evaluation(Generic[T]):
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
            gradient has not vanished; "diverged", if it left for where there is no optimum;
            "interrupted".
        history: every iteration; the first is the evaluation of the start.
    """

    free: Float[np.ndarray, " p"]
    trial: Evaluation[T]
    status: str
    history: tuple[Iteration, ...]

    @property
    def loss(self) -> float:
        """Of the best parameters; see `Residuals.loss`."""
        return self.trial.residuals.loss()


def minimise(
    evaluate: Callable[[Float[np.ndarray, " p"]], Evaluation[T] | None],
    start: Float[np.ndarray, " p"],
    *,
    max_iterations: int = 30,
    step_tolerance: float = 1e-6,
    gain_tolerance: float = 1e-3,
    is_lost: Callable[[Float[np.ndarray, " p"], Residuals], bool] = lambda free, residuals: False,
    on_iteration: Callable[[Iteration], None] = lambda iteration: None,
) -> Optimum[T] | None:
    """Parameters that minimise `Residuals.loss`.

    The damping follows the ratio of actual to predicted gain (Nielsen 1999). Where residuals are
    curved and not small, the loss is less curved than the Jacobian says, by as much as the gain of
    a step is larger; the next ones, if they go the same way, are lengthened accordingly.

    The search has converged when the gradient has vanished, in variables scaled such that the noise
    is 1 in all directions: when the part of the residuals that any change of the parameters could
    explain is worth less than `gain_tolerance` in log likelihood. 1e-3 is a step of 4.5 % of a
    standard error, a change that nobody could measure.

    Args:
        evaluate: the model at a free vector; None where it cannot be computed: such a step is
            rejected.
        start: (p,) free vector; with none there is nothing to search.
        max_iterations: accepted and rejected steps.
        step_tolerance: also converged is a search whose next full step, neither damped nor
            shortened, would change no free parameter by more than this.
        gain_tolerance: of the loss.
        is_lost: whether a search that has come to these parameters and residuals has diverged.
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
    best: Evaluation[T] = first
    free = np.array(start, dtype=float)
    damping, growth, stretch = 1e-3, 2.0, 1.0
    effect = np.zeros(first.residuals.value.size)
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
        if not free.size:
            return ended("converged")
        while True:
            if is_lost(free, best.residuals):
                return ended("diverged")
            full, explained = _newton(best.residuals)
            if np.abs(full).max() < step_tolerance or 0.5 * explained < gain_tolerance:
                return ended("converged")
            step = damped_step(best.residuals, damping)
            if damping > 1e10 or np.abs(step).max() < 1e-3 * step_tolerance:
                return ended("stalled")
            if len(history) > max_iterations:
                return ended("max_iterations")
            r, jacobian = best.residuals.whitened()
            before, effect = effect, jacobian @ step
            alike = before @ effect > SAME_WAY * np.linalg.norm(before) * np.linalg.norm(effect)
            stretch = min(stretch if alike else 1.0, LONGEST_STEP / np.abs(step).max())
            step = stretch * step
            loss = best.residuals.loss()
            promised = loss - shifted(best.residuals, step).loss()
            trial = evaluate(free + step)
            actual = -np.inf if trial is None else loss - trial.residuals.loss()
            accepted = bool(actual > 0)
            stretch = _stretched(-stretch * float(r @ effect), promised, actual)
            if accepted and trial is not None:
                free, best = free + step, trial
                ratio = min(actual / promised, 1.0) if promised > 0 else 1.0
                damping *= max(1 / 10, 1 - (2 * ratio - 1) ** 3)
                growth = 2.0
            else:
                damping *= growth * 2
                growth *= 2
            note(accepted)
    except KeyboardInterrupt:
        return ended("interrupted")


def _stretched(fall: float, promised: float, gain: float) -> float:
    """By how much to lengthen the next full step: to where the loss is lowest, if it is a parabola.

    What a step gains less than the loss would have fallen along its tangent is due to curvature:
    what is lost of it less than was promised, the parabola is flatter, and its minimum further.

    Args:
        fall: of the loss if it had gone on as it began.
        promised: by how much residuals that are linear would have let it fall, with the noise
            that they leave.
        gain: by how much it has fallen.
    """
    if not np.isfinite(gain) or gain <= 0 or promised >= fall:
        return 1.0
    flatter = (fall - promised) / max(fall - gain, (fall - promised) / LONGEST_STRETCH)
    return float(np.clip(flatter, 1.0, LONGEST_STRETCH))


def _newton(residuals: Residuals) -> tuple[Float[np.ndarray, " p"], float]:
    """The full Gauss-Newton step, and how much of chi^2 the parameters could still explain.

    Directions without any effect on the residuals take no part.
    """
    r, jacobian = residuals.whitened()
    u, singular, vt = np.linalg.svd(jacobian, full_matrices=False)
    seen = singular > RANK_TOLERANCE * max(singular[0], np.finfo(float).tiny)
    shares = u.T[seen] @ r
    return -vt[seen].T @ (shares / singular[seen]), float(shares @ shares)


def damped_step(residuals: Residuals, damping: float = 0.0) -> Float[np.ndarray, " p"]:
    """(p,): a damped Gauss-Newton step, in which no free parameter goes too far.

    A parameter that hardly matters would be sent far away. What holds it back is a constant
    that is added to the diagonal, small beside the curvature along parameters that matter, so
    that these take their full step.
    """
    r, jacobian = residuals.whitened()
    gradient, normal = jacobian.T @ r, jacobian.T @ jacobian
    largest = max(float(np.diag(normal).max()), np.finfo(float).tiny)
    # A parameter without any effect must not make the matrix singular.
    scale = np.maximum(np.diag(normal), 1e-12 * largest)
    ridge = 0.0
    while True:
        matrix = normal + damping * np.diag(scale) + ridge * np.eye(len(normal))
        step = -np.linalg.lstsq(matrix, gradient, rcond=1e-15)[0]
        if np.abs(step).max() <= LONGEST_STEP:
            return step
        ridge = max(2.0 * ridge, 1e-12 * largest)
