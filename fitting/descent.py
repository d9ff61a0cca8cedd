"""Gradient descent with optax, for many parameters or objectives that are not sums of squares.

One reverse sweep gives the derivative with respect to any number of parameters at the cost of
a few simulations. For the one to five parameters of a calibration the forward sensitivities
and Gauss-Newton steps of `calibrate` need far fewer simulations.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from derjax import SolverError

from .observe import exposed, interpolation, steps_until
from .simulate import motor_rate, simulate
from .tracks import Dataset, Run
from .transforms import Parameters

Objective = Callable[[Float[Array, " p"]], tuple[Array, Array]]
"""From free parameters to (what is to be small, status of the simulation)."""


@dataclass(frozen=True)
class Descent:
    """Where a descent ended.

    Attributes:
        free: (p,) the best parameters met.
        loss: there.
        losses: of every step; NaN where the simulation failed.
        status: "finished" or "interrupted".
    """

    free: Float[np.ndarray, " p"]
    loss: float
    losses: tuple[float, ...]
    status: str


def descend(
    objective: Objective,
    start: Float[np.ndarray, " p"],
    *,
    steps: int = 100,
    rate: float = 0.05,
    on_step: Callable[[int, float, np.ndarray], None] = lambda step, loss, free: None,
) -> Descent:
    """Adam with a cosine schedule, which keeps the best parameters that it meets.

    After a failed simulation the search goes back to the best parameters, forgets its momentum
    and continues at half the rate. Ctrl-C ends it.

    Args:
        objective: what to minimise; traced by JAX.
        start: (p,) free parameters.
        steps: evaluations of the gradient.
        rate: about the change of a free parameter in the first steps.
        on_step: called after every evaluation with its number, loss and free parameters; a
            failed one has the loss NaN and the parameters that the search goes back to.

    Raises:
        SolverError: the simulation fails at the start.
    """
    value_and_gradient = jax.jit(jax.value_and_grad(objective, has_aux=True))
    adam = optax.scale_by_adam()
    schedule = optax.cosine_decay_schedule(1.0, steps, alpha=0.02)
    free = best = jnp.asarray(start, dtype=float)
    memory, downhill = adam.init(free), jnp.zeros_like(free)
    lowest, losses, status = np.inf, [], "finished"
    try:
        for k in range(steps):
            (loss, code), gradient = value_and_gradient(free)
            good = int(code) == 0 and bool(jnp.isfinite(loss) & jnp.isfinite(gradient).all())
            losses.append(float(loss) if good else float("nan"))
            if not good and k == 0:
                raise SolverError("the simulation fails with the parameters of the start")
            if good:
                if losses[-1] < lowest:
                    best, lowest, downhill = free, losses[-1], gradient
            else:
                rate, free, memory, gradient = 0.5 * rate, best, adam.init(best), downhill
            direction, memory = adam.update(gradient, memory, free)
            change = jnp.asarray(direction) * (-rate * schedule(k))
            on_step(k, losses[-1], np.asarray(free))
            free = free + change
    except KeyboardInterrupt:
        if not np.isfinite(lowest):
            raise
        status = "interrupted"
    return Descent(np.asarray(best), lowest, tuple(losses), status)


def track_loss(
    dataset: Dataset, parameters: Parameters, runs: Sequence[Run] | None = None
) -> Objective:
    """Mean square of simulation minus track, in units of the noise, as an objective.

    Where the noise is not given, residuals are measured in the range of their track.
    """
    chosen = dataset.runs if runs is None else tuple(runs)
    step = dataset.scene.step

    def objective(free: Float[Array, " p"]) -> tuple[Array, Array]:
        total, count, status = jnp.zeros(()), 0, jnp.zeros((), jnp.int32)
        for run in chosen:
            n_steps = steps_until(run.time, run.exposure, step)
            rate = motor_rate(dataset.scene, run)
            observed, report = simulate(dataset.scene, parameters, free, rate, n_steps, run.sight)

            def at(time: np.ndarray, observed: Array = observed) -> Array:
                return interpolation(time, step)(observed)

            at_frames = exposed(at, run.time, run.exposure)
            error = at_frames[:, np.array(run.channels)] - run.values
            if run.free_origin:
                error = error - jnp.where(run.is_angle, 0.0, error.mean(axis=0))
            total += jnp.sum((error / _scale(run)) ** 2)
            count += error.size
            status = jnp.maximum(status, report.status)
        return total / count, status

    return objective


def _scale(run: Run) -> Float[np.ndarray, " c"]:
    span = np.ptp(run.values, axis=0)
    place = np.where(run.is_angle, 0.0, span).max()
    given = np.where(run.is_angle, run.sigma_angle or np.nan, run.sigma or np.nan)
    scale = np.where(np.isfinite(given), given, np.where(run.is_angle, span, place))
    return np.where(scale > 0, scale, 1.0)
