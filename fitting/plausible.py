"""How far parameters go: searches that run away with one of them, and values that no robot has."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from .transforms import Parameters
from .uncertainty import Residuals

Free = Float[np.ndarray, " p"]

FARTHEST = float(np.log(30.0))
"""How far from the start an optimum is still taken for one without a doubt, in a free parameter."""

UNFELT = 1.0
"""Change of the tracks with a free parameter, in units of the noise, that is no effect."""

LARGEST_PREFACTOR = 30.0
"""Prefactors of drag beyond this, or below its inverse, say that something else is wrong."""

PREFACTORS = ("C_t", "C_r")


def runaway(residuals: Residuals, change: Free) -> Bool[np.ndarray, " p"]:
    """Which parameters a search has carried so far that they do not change the tracks any more.

    The loss has fallen all the way there and would go on falling, by less and less. A parameter
    that changes the tracks only together with others is none of these.

    Args:
        residuals: where the search is.
        change: of the free parameters since the start.
    """
    _, jacobian = residuals.whitened()
    return (np.abs(change) > FARTHEST) & (np.linalg.norm(jacobian, axis=0) < UNFELT)


def course(parameters: Parameters, index: int, change: float) -> str:
    """Where a parameter runs, in words: "grows without end" or "falls towards 0"."""
    verb = "grows" if change > 0 else "falls"
    end = np.zeros(len(parameters.names))
    end[index] = np.copysign(np.inf, change)
    limit = float(parameters.values(jnp.asarray(end))[parameters.names[index]])
    return f"{verb} without end" if np.isinf(limit) else f"{verb} towards {limit:g}"


def unlikely(values: Mapping[str, float]) -> list[str]:
    """Sentences on prefactors of drag that no head has; that of a sphere in free fluid is 1."""
    return [
        f"{_head(name, values[name])}: are length_unit, pixel_size, time_unit and viscosity right?"
        for name in PREFACTORS
        if name in values and _is_large(values[name])
    ]


def implausible(
    parameters: Parameters, values: Mapping[str, float], start: Mapping[str, float]
) -> dict[str, str]:
    """Parameters with values that no robot is expected to have, and why not.

    Those are prefactors of drag that no head has, and other parameters far from their start.
    """
    change = parameters.free(values) - parameters.free(start)
    reasons = {}
    for name, far in zip(parameters.names, np.abs(change) > FARTHEST, strict=True):
        if name in PREFACTORS:
            if _is_large(values[name]):
                reasons[name] = _head(name, values[name])
        elif far:
            reasons[name] = f"{name} = {values[name]:.4g} is far from its start, {start[name]:.4g}"
    return reasons


def _is_large(prefactor: float) -> bool:
    return not 1 / LARGEST_PREFACTOR < prefactor < LARGEST_PREFACTOR


def _head(name: str, prefactor: float) -> str:
    size = "larger" if prefactor > 1 else "smaller"
    head = f"a head far {size} than a ball of head_radius"
    return f"{name} = {prefactor:.4g} would be the drag of {head}"
