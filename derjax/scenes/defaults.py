"""Numbers of a scene that follow from others where its file does not give them."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

REGULARIZATION = 1.67 / 1.6
"""Regularization of Stokeslet segments, in rod radii; see "The regularization" in the equations."""

SLIP = 0.1
"""Speed below which friction is like drag, over that of the surface of a rod that turns with the
fastest motor."""

Numbers = Mapping[str, Any]


def _mean(value: Any) -> Any:
    """Of a number of each flagellum, if there is one for each."""
    return value.mean() if np.ndim(value) else value


FOLLOWING: Mapping[str, Callable[[Numbers], Any]] = {
    "regularization": lambda p: REGULARIZATION * p["rod_radius"],
    "contact_stiffness": lambda p: _mean(p["youngs_modulus"]) * p["rod_radius"],
}
"""The numbers that follow, each as a smooth function of others: m, N/m."""


def completed(numbers: Numbers) -> dict[str, Any]:
    """`numbers` with what follows from the others wherever there is None.

    The numbers may be arrays that JAX traces: derivatives go through what follows.
    """
    return {k: FOLLOWING[k](numbers) if v is None else v for k, v in numbers.items()}
