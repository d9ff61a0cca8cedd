"""Simulation minus tracks, frame by frame."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .tracks import Run
from .uncertainty import Residuals

RESOLUTION = 1e-6
"""Noise is never estimated below this fraction of the range of a track."""


class Predicted(NamedTuple):
    """What a camera would have seen, at the frames of a run.

    Attributes:
        observed: (f, 4) channels, m and rad.
        sensitivity: (f, 4, p) their derivatives with respect to the free parameters.
    """

    observed: Float[np.ndarray, "f 4"]
    sensitivity: Float[np.ndarray, "f 4 p"]


def residuals(runs: Sequence[Run], predicted: Sequence[Predicted]) -> Residuals:
    """Simulation minus tracks of all runs (m, rad)."""
    parts = [run_residuals(run, one) for run, one in zip(runs, predicted, strict=True)]
    return Residuals(
        value=np.concatenate([part.value for part in parts]),
        jacobian=np.concatenate([part.jacobian for part in parts]),
        kind=np.concatenate([part.kind for part in parts]),
        sigma=np.concatenate([part.sigma for part in parts]),
        resolution=np.concatenate([part.resolution for part in parts]),
        origins=sum(part.origins for part in parts),
    )


def run_residuals(run: Run, predicted: Predicted) -> Residuals:
    """Simulation minus track of one run, frame after frame, channel by channel."""
    channels = list(run.channels)
    value = predicted.observed[:, channels] - run.values
    jacobian = predicted.sensitivity[:, channels]
    place = ~run.is_angle
    basis = nuisances(run)
    if basis.size and place.any():
        # The best origin and drift for any parameters leave what is orthogonal to them.
        project = np.eye(len(basis)) - basis @ np.linalg.pinv(basis)
        value[:, place] = project @ value[:, place]
        jacobian[:, place] = np.einsum("fg,gcp->fcp", project, jacobian[:, place])
    if run.free_angle:
        value[:, ~place] -= value[:, ~place].mean(axis=0)
        jacobian[:, ~place] -= jacobian[:, ~place].mean(axis=0)
    span = np.where(run.is_angle, 1.0, np.ptp(run.values, axis=0).max(where=place, initial=0.0))
    noise = np.where(run.is_angle, run.sigma_angle or np.nan, run.sigma or np.nan)
    frames = (len(run.time), 1)
    return Residuals(
        value=value.ravel(),
        jacobian=jacobian.reshape(value.size, -1),
        kind=np.tile(run.is_angle.astype(int), frames).ravel(),
        sigma=np.tile(noise, frames).ravel(),
        resolution=np.tile(RESOLUTION * span, frames).ravel(),
        origins=basis.shape[1] * int(place.sum()) + run.free_angle * int((~place).sum()),
    )


def nuisances(run: Run) -> Float[np.ndarray, "f k"]:
    """What may be added to the positions of a run: an origin, and a drift since time 0."""
    columns = [np.ones_like(run.time)] * run.free_origin + [run.time] * run.drift
    return np.stack(columns, axis=1) if columns else np.empty((len(run.time), 0))


def fitted_drift(run: Run, predicted: Predicted) -> dict[str, float]:
    """Velocity (m/s) of the drift of every coordinate of a run that has one."""
    if not run.drift:
        return {}
    basis = nuisances(run)
    names = ("x", "y", "z")
    drift = {}
    for column, channel in enumerate(run.channels):
        if channel < len(names):
            apart = run.values[:, column] - predicted.observed[:, channel]
            drift[names[channel]] = float((np.linalg.pinv(basis) @ apart)[-1])
    return drift
