"""How well tracks determine parameters: noise, covariance, intervals, what is degenerate.

Everything here is linear algebra on residuals and their Jacobian, so it costs nothing next to a
simulation. The intervals are about noise. They assume that the errors of different frames
are independent and that the model is right; a robot that differs from the model by 1 %
leaves a bias of that order, however small the intervals are. Residuals that are much larger
than the noise of the camera, or that go on with one sign for many frames, show it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

KINDS = ("position", "head_angle", "speed", "head_rate", "prior")
"""Kinds of observations that have noise of their own; what is known beforehand is the last."""

RANK_TOLERANCE = 1e-6
"""Sensitivities that are smaller than the largest by this factor are round-off."""


@dataclass(frozen=True)
class Residuals:
    """Simulation minus track, and its derivatives, of all runs.

    Attributes:
        value: (m,) m or rad.
        jacobian: (m, p) derivatives with respect to the free parameters.
        kind: (m,) index into `KINDS`.
        sigma: (m,) m or rad, the noise; NaN where it is to be estimated.
        resolution: (m,) m or rad, far below any noise; the smallest that is estimated.
        origins: number of origins and drifts of coordinates that were fitted beforehand.
    """

    value: Float[np.ndarray, " m"]
    jacobian: Float[np.ndarray, "m p"]
    kind: Int[np.ndarray, " m"]
    sigma: Float[np.ndarray, " m"]
    resolution: Float[np.ndarray, " m"]
    origins: int = 0

    @property
    def degrees_lost(self) -> int:
        """How many numbers were fitted: parameters, origins and drifts."""
        return self.jacobian.shape[1] + self.origins

    @property
    def degrees_of_freedom(self) -> int:
        """Observations less what was fitted to them; at least one."""
        return max(1, self.value.size - self.degrees_lost)

    @property
    def noise_given(self) -> bool:
        """Whether the noise of every observation is known beforehand."""
        return bool(np.isfinite(self.sigma).all())

    def estimated_kinds(self) -> list[np.ndarray]:
        """Masks (m,) of the observations whose common noise is to be estimated."""
        unknown = ~np.isfinite(self.sigma)
        masks = [unknown & (self.kind == k) for k in range(len(KINDS))]
        return [mask for mask in masks if mask.any()]

    def variances(self) -> Float[np.ndarray, " m"]:
        """(m,) m^2 or rad^2: given, or the mean square of the residuals of its kind."""
        variance = self.sigma**2
        for mask in self.estimated_kinds():
            mean = np.mean(self.value[mask] ** 2)
            variance[mask] = mean + np.mean(self.resolution[mask] ** 2)
        return variance

    def loss(self) -> float:
        """Negative log likelihood, up to a constant, at the likeliest noise levels.

        sum r^2 / 2 sigma^2 where the noise is given, and n/2 log(mean r^2) for each kind
        where it is not. So positions and angles need no weights to be traded off against each
        other, and the gradient is that of least squares with the weights 1 / `variances`.
        """
        given = np.isfinite(self.sigma)
        loss = 0.5 * np.sum((self.value[given] / self.sigma[given]) ** 2)
        variance = self.variances()
        for mask in self.estimated_kinds():
            loss += 0.5 * np.sum(np.log(variance[mask]))
        return float(loss)

    def whitened(self) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m p"]]:
        """Residuals and Jacobian in units of the noise."""
        scale = 1.0 / np.sqrt(self.variances())
        return scale * self.value, scale[:, None] * self.jacobian

    def standardised(self) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m p"]]:
        """Residuals and Jacobian in units in which the noise is 1, as far as errors go.

        Noise that was estimated is corrected for what was fitted to it.
        """
        r, jacobian = self.whitened()
        if self.noise_given:
            return r, jacobian
        scale = np.sqrt(self.degrees_of_freedom / self.value.size)
        return scale * r, scale * jacobian

    def by_kind(self, squares: Float[np.ndarray, " m"]) -> dict[str, float]:
        """Root of the mean of some squares (m^2, rad^2), for every kind there is."""
        masks = {name: self.kind == k for k, name in enumerate(KINDS[:-1])}
        return {n: float(np.sqrt(squares[m].mean())) for n, m in masks.items() if m.any()}

    def rms(self) -> dict[str, float]:
        """Root mean square of the residuals (m, rad) of every kind there is."""
        return self.by_kind(self.value**2)


@dataclass(frozen=True)
class Uncertainty:
    """What the noise leaves open, in the free coordinates.

    Attributes:
        std: (p,) standard errors; infinite for parameters that are part of a combination
            that does not change the tracks at all.
        quantile: half width of the 95 % interval in standard errors.
        correlation: (p, p).
        warnings: sentences on parameters that the data do not determine.
    """

    std: Float[np.ndarray, " p"]
    quantile: float
    correlation: Float[np.ndarray, "p p"]
    warnings: tuple[str, ...]


def uncertainty(residuals: Residuals, names: Sequence[str]) -> Uncertainty:
    """Standard errors, correlation and warnings from the Jacobian at the best fit.

    The covariance is (J^T W J)^-1 with W the inverse variances. Estimated variances are
    corrected for the number of parameters, and the interval is Student's.
    """
    from scipy import special  # slow to import

    dof = residuals.degrees_of_freedom
    _, jacobian = residuals.standardised()
    quantile = float(special.ndtri(0.975))
    if not residuals.noise_given:
        quantile = float(special.stdtrit(dof, 0.975))
    _, singular, vt = np.linalg.svd(jacobian, full_matrices=False)
    null = singular <= RANK_TOLERANCE * singular.max(initial=np.finfo(float).tiny)
    inverse = np.where(null, 0.0, 1.0 / np.where(null, 1.0, singular))
    covariance = (vt.T * inverse**2) @ vt
    lost = (np.abs(vt[null]) > 1e-3).any(axis=0)
    std = np.sqrt(np.diag(covariance))
    safe = np.where(std > 0, std, 1.0)
    correlation = covariance / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    std = np.where(lost, np.inf, std)
    return Uncertainty(std, quantile, correlation, _warnings(names, singular, null, vt, std))


def _warnings(
    names: Sequence[str],
    singular: np.ndarray,
    null: np.ndarray,
    directions: np.ndarray,
    std: np.ndarray,
) -> tuple[str, ...]:
    """Sentences on the directions, and then the parameters, that the data leave open."""
    found, named = [], set()
    for size, exactly, direction in zip(singular, null, directions, strict=True):
        if not exactly and size > 1.0:
            continue
        direction = direction / direction[np.argmax(np.abs(direction))]
        involved = [i for i, share in enumerate(direction) if abs(share) > 1e-2]
        named.update(involved)
        together = " and ".join(names[i] for i in involved)
        if len(involved) == 1:
            how = "does not change the tracks" if exactly else "hardly changes the tracks"
            found.append(f"{together} is not identifiable: it {how}. Do not fit it.")
            continue
        factors = ", ".join(f"{names[i]} x {2.0 ** direction[i]:.3g}" for i in involved)
        stay = "stay as they are" if exactly else "change by less than their noise"
        found.append(
            f"{together} are not identifiable together: the tracks {stay} under {factors}. "
            "Tracks fix ratios of forces, not their scale: give one of these parameters a "
            "value measured in another way, and fit the others."
        )
    found += [
        f"{names[i]} is not determined by these data: its standard error exceeds its value."
        for i, error in enumerate(std)
        if 1.0 < error < np.inf and i not in named
    ]
    return tuple(found)


def linear_fit(residuals: Residuals, iterations: int = 20) -> Float[np.ndarray, " p"]:
    """(p,): the change of the free parameters that minimises the loss of a linear model."""
    total = np.zeros(residuals.jacobian.shape[1])
    for _ in range(iterations):
        r, j = shifted(residuals, total).whitened()
        step = -np.linalg.lstsq(j, r, rcond=None)[0]
        total = total + step
    return total


def shifted(residuals: Residuals, change: Float[np.ndarray, " p"]) -> Residuals:
    """The residuals after a change of the free parameters, in linear approximation."""
    return replace(residuals, value=residuals.value + residuals.jacobian @ change)


def coverage(
    residuals: Residuals, noise: Float[np.ndarray, " m"], seeds: Sequence[int]
) -> Float[np.ndarray, " p"]:
    """How often the 95 % interval of each parameter contains the truth.

    Takes the Jacobian at the truth, adds noise to perfect data, fits by linear least squares
    and asks for the interval, once for each seed: a test of noise model and intervals that
    needs no further simulation.

    Args:
        residuals: at the truth; only their values are replaced by noise.
        noise: (m,) m or rad, standard deviation of every observation.
        seeds: of the random numbers, one for each trial.

    Returns:
        (p,) fractions between 0 and 1.
    """
    names = [f"parameter {i}" for i in range(residuals.jacobian.shape[1])]
    hits = np.zeros(len(names))
    for seed in seeds:
        error = noise * np.random.default_rng(seed).normal(size=noise.size)
        noisy = replace(residuals, value=error)
        change = linear_fit(noisy)
        known = uncertainty(shifted(noisy, change), names)
        hits += np.abs(change) <= known.quantile * known.std
    return hits / len(seeds)
