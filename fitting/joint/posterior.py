"""The posterior of all unknowns, drawn by NUTS (blackjax).

What is drawn are free numbers, in which priors that nobody gave are flat (for a positive parameter:
in its logarithm), and besides the size and the memory of the noise of every kind. Simulations are
replaced by polynomials around the best fit, whose error is looked at beforehand (see `surrogate`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from derjax import InputError, SolverError

from ..noise import BEND, DEGREES, LARGEST_RHO
from ..observe import exposed
from .fit import Solved
from .gait import RATES, Gait, swum
from .maps import applied
from .parts import RatesPart, TrackPart, kept_of
from .surrogate import Polynomial, polynomials

CHAINS, WARM, DRAWS = 2, 400, 1000

CONVERGED = 1.05
"""Largest ratio of variances between and within chains (R hat) that is taken for convergence."""


@dataclass(frozen=True)
class Posterior:
    """Draws of the parameters that were fitted.

    Attributes:
        names: (p,)
        draws: (chains, n, p) in their units.
        r_hat: (p,) near 1 if the chains agree.
        effective: (p,) independent draws that they are worth.
        divergences: transitions that were inexact.
    """

    names: tuple[str, ...]
    draws: Float[np.ndarray, "c n p"]
    r_hat: Float[np.ndarray, " p"]
    effective: Float[np.ndarray, " p"]
    divergences: int

    @property
    def ok(self) -> bool:
        """Whether the chains have converged."""
        return bool(
            (self.r_hat < CONVERGED).all() and self.divergences < 0.02 * self.draws[..., 0].size
        )

    def std(self) -> dict[str, float]:
        """Standard deviations, by name."""
        return dict(zip(self.names, self.draws.std(axis=(0, 1)).tolist(), strict=True))

    def mean(self) -> dict[str, float]:
        """Means, by name."""
        return dict(zip(self.names, self.draws.mean(axis=(0, 1)).tolist(), strict=True))

    def ci95(self) -> dict[str, tuple[float, float]]:
        """Intervals with 2.5 % of the draws on either side, by name."""
        ends = np.percentile(self.draws.reshape(-1, len(self.names)), [2.5, 97.5], axis=0)
        return {n: (float(a), float(b)) for n, a, b in zip(self.names, *ends, strict=True)}


def posterior(
    solved: Solved, *, seed: int = 0, draws: int = DRAWS, chains: int = CHAINS
) -> Posterior:
    """Draws from the posterior around the best fit.

    Raises:
        InputError: blackjax is missing, tracks are simulated from rest, or a parameter is not
            determined.
        SolverError: a polynomial does not do (see `surrogate`).
    """
    try:
        import blackjax
    except ImportError:
        raise InputError("--posterior needs blackjax: pip install 'derjax[bayes]'") from None
    problem = solved.problem
    if problem.rest:
        raise InputError(
            "--posterior: tracks from rest would have to be simulated for every draw; use "
            '--profile, or leave the transient out with t_start and say start = "steady"'
        )
    fitted = np.flatnonzero(problem.unknowns.fitted)
    if not np.isfinite(solved.known.std).all():
        lost = problem.unknowns.names[int(np.argmin(np.isfinite(solved.known.std)))]
        raise InputError(f"--posterior: {lost} is not determined by these data; give it a prior")
    density, start, scale = log_density(solved, polynomials(solved))

    def standardised(w: Array) -> Array:
        return density(start + scale @ w)

    warmup: Any = blackjax.window_adaptation(
        blackjax.nuts, standardised, target_acceptance_rate=0.85
    )
    keys = jax.random.split(jax.random.key(seed), 2 * chains + 1)
    begins = 0.5 * jax.random.normal(keys[-1], (chains, len(start)))

    @jax.jit
    def chain(key: Array, warm: Array, begin: Array) -> tuple[Array, Array]:
        (state, parameters), _ = warmup.run(warm, begin, WARM)
        step: Any = blackjax.nuts(standardised, **parameters).step

        def one(state: Any, key: Array) -> Any:
            state, info = step(key, state)
            return state, (state.position, info.is_divergent)

        return jax.lax.scan(one, state, jax.random.split(key, draws))[1]

    positions, divergent = zip(
        *(chain(keys[2 * k], keys[2 * k + 1], begins[k]) for k in range(chains)), strict=True
    )
    w = np.stack([np.asarray(one) for one in positions])
    if not np.isfinite(w).all():
        raise SolverError("the posterior could not be drawn from: its density is not finite")
    free = np.asarray(start) + w @ np.asarray(scale).T
    values = np.stack(
        [
            np.asarray(problem.unknowns.every[k].transform.value(jnp.asarray(free[..., k].ravel())))
            for k in fitted
        ],
        axis=-1,
    ).reshape(chains, draws, len(fitted))
    return Posterior(
        tuple(problem.unknowns.names[k] for k in fitted),
        values,
        np.atleast_1d(blackjax.diagnostics.potential_scale_reduction(values)),
        np.atleast_1d(blackjax.diagnostics.effective_sample_size(values)),
        int(np.sum([np.sum(np.asarray(one)) for one in divergent])),
    )


def log_density(
    solved: Solved, made: dict[int, Polynomial]
) -> tuple[Callable[[Array], Array], Array, Array]:
    """The logarithm of the posterior by free numbers and those of the noise.

    Returns:
        The function, where the best fit is, and a matrix that makes its errors about 1.
    """
    problem, residuals = solved.problem, solved.residuals
    count = len(solved.optimum.free)
    observed = residuals.observed
    kinds = sorted(residuals.levels)
    unknown = [k for k in kinds if not np.isfinite(observed.sigma[observed.kind == k]).all()]
    memories = [k for k in kinds if residuals.levels[k].rho > 0]
    predict = predicted_by(solved, made)
    rows = {k: np.flatnonzero(observed.kind == k) for k in kinds}
    transforms = [u.transform for u in problem.unknowns.every]
    priors = [(k, u.mean, u.std) for k, u in enumerate(problem.unknowns.every) if u.std is not None]
    data = jnp.asarray(_data(solved))

    def density(z: Array) -> Array:
        free, noise = z[:count], z[count:]
        values = jnp.stack([t.value(free[k]) for k, t in enumerate(transforms)])
        apart = predict(free, values) - data
        total = jnp.zeros(())
        for k in kinds:
            part, sigma = apart[rows[k]], jnp.asarray(observed.sigma[rows[k]])
            if k in unknown:
                log_scale = noise[unknown.index(k)]
                sigma = jnp.where(jnp.isfinite(sigma), sigma, jnp.exp(log_scale))
                total -= log_scale * np.count_nonzero(~np.isfinite(observed.sigma[rows[k]]))
            if k in memories:
                raw = noise[len(unknown) + memories.index(k)]
                rho = LARGEST_RHO * jax.nn.sigmoid(raw)
                total += jax.nn.log_sigmoid(raw) + jax.nn.log_sigmoid(-raw)
                series = observed.series[rows[k]]
                first = np.r_[True, series[1:] != series[:-1]]
                gap = np.maximum(observed.gap[rows[k]], 1e-3)
                phi = jnp.where(first, 0.0, rho**gap)
                part = (part - phi * jnp.concatenate([jnp.zeros(1), part[:-1]])) / jnp.sqrt(
                    1 - phi**2
                )
                total -= 0.5 * jnp.sum(jnp.log(1 - phi**2))
            total -= jnp.sum(_penalty(residuals.shape, part / sigma))
        for k, mean, std in priors:
            assert mean is not None
            total -= 0.5 * ((values[k] - mean) / std) ** 2
        return total

    levels = residuals.levels
    start = np.r_[
        solved.optimum.free,
        [np.log(levels[k].scale) for k in unknown],
        [np.log(levels[k].rho / (LARGEST_RHO - levels[k].rho)) for k in memories],
    ]
    std = solved.known.std
    scale = np.zeros((len(start), len(start)))
    covariance = solved.known.correlation * np.outer(std, std)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 1e-12 * values.max()))
    scale[:count, :count] = root
    for j, k in enumerate([*unknown, *memories], count):
        scale[j, j] = 1.0 / np.sqrt(max(2.0, len(rows[k])))
    return density, jnp.asarray(start), jnp.asarray(scale)


def _penalty(shape: str, u: Array) -> Array:
    if shape == "student":
        return 0.5 * (DEGREES + 1) * jnp.log1p(u**2 / DEGREES)
    if shape == "huber":
        far = jnp.abs(u) > BEND
        return jnp.where(far, BEND * jnp.abs(u) - 0.5 * BEND**2, 0.5 * jnp.where(far, 0.0, u) ** 2)
    return 0.5 * u**2


def predicted_by(
    solved: Solved, made: dict[int, Polynomial]
) -> Callable[[Array, Array], Float[Array, " m"]]:
    """What is seen, in the order of the residuals, by free numbers and values of all unknowns."""
    problem = solved.problem

    def predict(free: Array, values: Array) -> Array:
        parts = []
        for part in problem.parts:
            if isinstance(part, TrackPart):
                assert part.source is not None
                packed = made[part.source](free)
                gait = Gait.of(packed * kept_of(packed.size, part.averaged))
                time = part.clock(part.run.time)
                start = [0.0 if k is None else values[k] for k in part.start]

                def at(time: np.ndarray, gait: Gait = gait, start: list = start) -> Array:
                    return swum(gait, jnp.asarray(time), *start)

                track = exposed(at, time, part.run.exposure)
                track = applied(
                    part.maps, track, jnp.asarray(time), values[np.array(part.mapped, int)]
                )
                parts.append(track[:, np.array(part.run.channels)].T.ravel())
            else:
                gaits = jnp.stack([made[k](free)[jnp.array([0, RATES - 2])] for k in part.sources])
                off = values[np.array(part.discrepancy, int)] if part.discrepancy else jnp.zeros(2)
                both = gaits * jnp.array(part.senses) * (1 + off)
                there = np.isfinite(part.data()[0]).T.ravel()
                parts.append(both.T.ravel()[there])
        return jnp.concatenate(parts)

    return predict


def _data(solved: Solved) -> np.ndarray:
    """(m,) what was seen, in the order of the residuals."""
    parts = []
    for part in solved.problem.parts:
        if isinstance(part, RatesPart):
            data = part.data()[0].T.ravel()
            parts.append(data[np.isfinite(data)])
        else:
            parts.append(part.run.values.T.ravel())
    return np.concatenate(parts)
