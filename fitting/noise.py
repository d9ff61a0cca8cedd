"""Noise as it is: outliers, and errors that go on from frame to frame.

Residuals of one channel of one run are a series. If they are correlated, each is a part of the one
before and something new, r_t = phi_t r_{t-1} + sqrt(1 - phi_t^2) e_t with phi_t = rho^(gap of time
in frames), and only what is new tells anything: e is independent from frame to frame, and of the
size of r. Its distribution is Gauss's, Student's with four degrees of freedom, or that whose
likelihood is Huber's function, so that single frames in which the tracker was wrong count little.

The size of the noise, where it is not given, and rho are those of the largest likelihood, for every
kind of observation one. At these, the gradient of the loss is that of least squares with weights,
and this is what a search is given. Errors of parameters come from what the residuals are, not from
what
they should be: (mean psi')^2 / mean psi^2 with psi the derivative of the loss (Huber, Robust
statistics, 1981).
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, Int

from .uncertainty import KINDS, Residuals

Shape = Literal["gaussian", "student", "huber"]
SHAPES: tuple[Shape, ...] = get_args(Shape)

PRIOR = len(KINDS) - 1
"""The kind of what is known beforehand."""

DEGREES = 4.0
"""Of freedom of Student's distribution."""

BEND = 1.345
"""Residuals beyond so many times the noise count linearly with Huber's function: 5 % of accuracy is
lost if there are no outliers."""

LARGEST_RHO = 0.98
"""Beyond, a correlation cannot be told from an origin or a drift."""


def penalty(shape: Shape, u: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Negative log likelihood of residuals in units of the noise, up to a constant."""
    if shape == "student":
        return 0.5 * (DEGREES + 1) * np.log1p(u**2 / DEGREES)
    if shape == "huber":
        return np.where(np.abs(u) <= BEND, 0.5 * u**2, BEND * np.abs(u) - 0.5 * BEND**2)
    return 0.5 * u**2


def weight(shape: Shape, u: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """By how much less than with Gauss's distribution a residual counts: psi(u) / u."""
    if shape == "student":
        return (DEGREES + 1) / (DEGREES + u**2)
    if shape == "huber":
        return np.minimum(1.0, BEND / np.maximum(np.abs(u), 1e-12))
    return np.ones_like(u)


def curvature(shape: Shape, u: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """The second derivative of `penalty`."""
    if shape == "student":
        return (DEGREES + 1) * (DEGREES - u**2) / (DEGREES + u**2) ** 2
    if shape == "huber":
        return (np.abs(u) <= BEND).astype(float)
    return np.ones_like(u)


@dataclass(frozen=True)
class Level:
    """The noise of one kind of observations.

    Attributes:
        scale: m, rad, m/s or rad/s.
        rho: correlation from frame to frame.
    """

    scale: float
    rho: float


@dataclass(frozen=True)
class NoisyResiduals(Residuals):
    """Residuals with noise that is not Gauss's, or not independent, and with prior knowledge.

    Rows of the kind `PRIOR` are parameters minus what is known of them.

    Attributes:
        series: (m,) which rows follow each other in time: those with one number, in order.
        gap: (m,) frames since the row before of the series; of the first anything.
        shape: of the distribution of what is new in every frame.
        correlated: whether the frames of a series are.
    """

    series: Int[np.ndarray, " m"] = field(default_factory=lambda: np.zeros(0, int))
    gap: Float[np.ndarray, " m"] = field(default_factory=lambda: np.zeros(0))
    shape: Shape = "gaussian"
    correlated: bool = False

    def only(self, rows: np.ndarray) -> "NoisyResiduals":
        """Some of the rows."""
        chosen = {
            name: getattr(self, name)[rows]
            for name in ("value", "jacobian", "kind", "sigma", "resolution", "series", "gap")
        }
        return replace(self, **chosen)

    @property
    def observed(self) -> "NoisyResiduals":
        """Without what is known beforehand."""
        return self.only(self.kind != PRIOR)

    @property
    def noise_given(self) -> bool:
        return bool(np.isfinite(self.sigma[self.kind != PRIOR]).all())

    @cached_property
    def levels(self) -> dict[int, Level]:
        """The noise of every kind, at the largest likelihood."""
        return {int(k): self._level(int(k)) for k in np.unique(self.kind) if k != PRIOR}

    def _level(self, kind: int) -> Level:
        part = self.only(self.kind == kind)
        if not (self.correlated and KINDS[kind] in ("position", "head_angle")):
            return Level(part.scale(part.value), 0.0)

        def loss(rho: float) -> float:
            new = part.innovations(rho, part.value)
            return part.loss_of(new, part.scale(new), rho)

        from scipy.optimize import minimize_scalar  # slow to import

        found = minimize_scalar(loss, bounds=(0.0, LARGEST_RHO), method="bounded")
        rho = float(found.x) if found.fun < loss(0.0) else 0.0
        return Level(part.scale(part.innovations(rho, part.value)), rho)

    def innovations(self, rho: float, rows: np.ndarray) -> np.ndarray:
        """What is new in every row (m,) or (m, p), in the units of the rows."""
        if rho == 0.0 or len(rows) < 2:
            return rows
        phi = self._phi(rho)
        shaped = phi.reshape(-1, *(1,) * (rows.ndim - 1))
        before = np.concatenate([np.zeros_like(rows[:1]), rows[:-1]])
        return (rows - shaped * before) / np.sqrt(1 - shaped**2)

    def _phi(self, rho: float) -> np.ndarray:
        first = np.r_[True, self.series[1:] != self.series[:-1]]
        return np.where(first, 0.0, rho ** np.maximum(self.gap, 1e-3))

    def scale(self, new: np.ndarray) -> float:
        """The noise of rows of one kind: 1 for those whose noise is given, in units of that."""
        unknown = ~np.isfinite(self.sigma)
        if not unknown.any():
            return 1.0
        e, floor = new[unknown], float(np.mean(self.resolution[unknown] ** 2))
        square = float(np.mean(e**2))
        if self.shape != "gaussian":
            square = min(square, 4.0 * float(np.median(e**2))) + floor
            for _ in range(60):
                last = square
                square = float(np.mean(weight(self.shape, e / np.sqrt(last)) * e**2)) + floor
                if abs(square - last) < 1e-10 * last:
                    break
            return float(np.sqrt(square))
        return float(np.sqrt(square + floor))

    def sizes(self, scale: float) -> np.ndarray:
        """(m,) the noise of rows of one kind."""
        return np.where(np.isfinite(self.sigma), self.sigma, scale)

    def loss_of(self, new: np.ndarray, scale: float, rho: float) -> float:
        """Of rows of one kind."""
        total = float(np.sum(penalty(self.shape, new / self.sizes(scale))))
        total += float(np.count_nonzero(~np.isfinite(self.sigma)) * np.log(scale))
        if rho > 0:
            total += 0.5 * float(np.sum(np.log(1 - self._phi(rho) ** 2)))
        return total

    def variances(self) -> Float[np.ndarray, " m"]:
        """(m,) of the residuals, for every kind one where it is not given."""
        variance = self.sigma**2
        for kind, level in self.levels.items():
            rows = self.kind == kind
            variance[rows] = self.only(rows).sizes(level.scale) ** 2
        return variance

    def loss(self) -> float:
        prior = self.kind == PRIOR
        total = 0.5 * float(np.sum((self.value[prior] / self.sigma[prior]) ** 2))
        for kind, level in self.levels.items():
            part = self.only(self.kind == kind)
            total += part.loss_of(part.innovations(level.rho, part.value), level.scale, level.rho)
        return total

    def new(self) -> Float[np.ndarray, " m"]:
        """(m,) what is new in every row, in units of the noise, outliers as large as they count."""
        out = np.zeros_like(self.value)
        for kind, level in self.levels.items():
            rows = self.kind == kind
            part = self.only(rows)
            u = part.innovations(level.rho, part.value) / part.sizes(level.scale)
            out[rows] = np.sqrt(weight(self.shape, u)) * u
        return out

    def whitened(self) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m p"]]:
        return self._scaled(errors=False)

    def standardised(self) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m p"]]:
        return self._scaled(errors=True)

    def _scaled(self, errors: bool) -> tuple[np.ndarray, np.ndarray]:
        """Rows in units of the noise: as a search weighs them, or as they say of errors."""
        prior = self.kind == PRIOR
        value, jacobian = np.zeros_like(self.value), np.zeros_like(self.jacobian)
        value[prior] = self.value[prior] / self.sigma[prior]
        jacobian[prior] = self.jacobian[prior] / self.sigma[prior][:, None]
        observed = int(np.count_nonzero(~prior))
        lost = self.jacobian.shape[1] - int(np.count_nonzero(prior))
        for kind, level in self.levels.items():
            rows = self.kind == kind
            part = self.only(rows)
            u = part.innovations(level.rho, part.value) / part.sizes(level.scale)
            if not errors:
                by = np.sqrt(weight(self.shape, u))
            else:
                mean = np.mean(curvature(self.shape, u)) ** 2 / np.mean(
                    (weight(self.shape, u) * u) ** 2
                )
                if self.shape == "gaussian":
                    mean = 1.0
                by = np.full(u.size, np.sqrt(mean))
                if not np.isfinite(part.sigma).all():
                    by *= np.sqrt(max(1, observed - max(0, lost)) / observed)
            value[rows] = by * u
            new = part.innovations(level.rho, part.jacobian) / part.sizes(level.scale)[:, None]
            jacobian[rows] = by[:, None] * new
        return value, jacobian
