"""Parameters that are known with an uncertainty, and what it makes of an objective.

The mean and the variance of the objective are those of a few points around the mean of the
parameters (sigma points: Julier & Uhlmann, Proc. IEEE 92, 401, 2004), right to second order. So
they are smooth functions of the design, with exact derivatives.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from derjax import InputError


@dataclass(frozen=True)
class Uncertain:
    """Parameters of a scene that are normally distributed.

    Attributes:
        names: of the k parameters.
        mean: (k,) in the scene's units.
        covariance: (k, k).
        quantile: of the objective, between 0 and 1; None for its mean.
    """

    names: tuple[str, ...]
    mean: Float[np.ndarray, " k"]
    covariance: Float[np.ndarray, "k k"]
    quantile: float | None = None

    def points(self) -> tuple[Float[np.ndarray, "p k"], Float[np.ndarray, " p"]]:
        """Sigma points and their weights; the first is the mean."""
        count = len(self.names)
        more = max(3.0 - count, 0.0)
        step = np.sqrt(count + more) * np.linalg.cholesky(self.covariance).T
        weights = np.full(2 * count + 1, 0.5 / (count + more))
        weights[0] = more / (count + more)
        return np.concatenate([[self.mean], self.mean + step, self.mean - step]), weights

    def sample(self, count: int) -> Float[np.ndarray, "c k"]:
        """Parameters drawn at random, the same in every call."""
        random = np.random.default_rng(0)
        return random.multivariate_normal(self.mean, self.covariance, count)

    def statistic(
        self, values: Float[np.ndarray, " p"], gradients: Float[np.ndarray, "p n"]
    ) -> tuple[float, Float[np.ndarray, " n"]]:
        """The mean or quantile of what has some values and gradients at the sigma points."""
        _, weights = self.points()
        mean, along = weights @ values, weights @ gradients
        if self.quantile is None:
            return float(mean), along
        apart = values - mean
        spread = np.sqrt(weights @ apart**2)
        if spread == 0.0:
            return float(mean), along
        slope = weights @ (apart[:, None] * (gradients - along)) / spread
        from scipy.special import ndtri  # slow to import

        factor = ndtri(self.quantile)
        return float(mean + factor * spread), along + factor * slope


def from_fit(path: Path) -> tuple[dict[str, float], Float[np.ndarray, "k k"]]:
    """Estimates and covariance of the parameters in a `fit.json`.

    Raises:
        InputError: there is no such file, it is something else, or what it found is not determined.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        names = content["correlation"]["names"]
        values = {name: float(content["parameters"][name]["value"]) for name in names}
        deviations = [content["parameters"][name]["std"] for name in names]
        correlation = np.array(content["correlation"]["matrix"], float)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: is no fit.json of derjax fit ({error!r})") from None
    for name, deviation in zip(names, deviations, strict=True):
        if deviation is None:
            raise InputError(f"{path}: {name} is not determined, so that it has no uncertainty")
    scale = np.array(deviations, float)
    return values, correlation * np.outer(scale, scale)


def together(
    fitted: tuple[Mapping[str, float], Float[np.ndarray, "k k"]] | None,
    given: Mapping[str, tuple[float, float]],
    quantile: float | None,
) -> Uncertain:
    """Those of a fit, and others with a mean and a standard deviation, which are independent."""
    values, covariance = fitted or ({}, np.zeros((0, 0)))
    names = (*values, *given)
    if twice := [name for name in given if name in values]:
        raise InputError(f"[uncertain] {twice[0]}: is in the fit, too")
    mean = np.array([*values.values(), *(value for value, _ in given.values())])
    whole = np.zeros((len(names), len(names)))
    whole[: len(values), : len(values)] = covariance
    for place, (_, deviation) in enumerate(given.values(), start=len(values)):
        whole[place, place] = deviation**2
    return Uncertain(names, mean, whole, quantile)
