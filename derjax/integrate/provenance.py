"""Whether the terms of a scene are still those that it was built with.

A scene keeps the numbers that it was built of (`Scene.parameters`). Its terms may be replaced
afterwards; then those numbers are not all that there is to say, and results should tell so.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..terms.term import Term

SAME = 1e-9
"""Relative difference of check sums that rounding may make."""

CheckSums = dict[str, Array]
"""Check sums of terms by the names of their types."""


def check_sums(terms: Sequence[Term]) -> CheckSums:
    """Sums over the leaves of terms, in which every number has a weight of its own."""
    sums: CheckSums = {}
    for term in terms:
        name = type(term).__name__
        sums[name] = sums.get(name, jnp.zeros(())) + _weighted(jax.tree.leaves(term), jnp)
    return sums


def changed(terms: Sequence[Term], built: CheckSums) -> tuple[str, ...]:
    """Names of the types of terms that are not as they were; computed on the host.

    Args:
        terms: those of a scene.
        built: the check sums of the terms that it was built with.
    """
    now: dict[str, float] = {}
    size: dict[str, float] = {}
    for term in terms:
        name = type(term).__name__
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(term)]
        now[name] = now.get(name, 0.0) + float(_weighted(leaves, np))
        size[name] = size.get(name, 0.0) + float(_weighted([abs(leaf) for leaf in leaves], np))
    return tuple(
        name
        for name in sorted(now.keys() | built.keys())
        if name not in now
        or name not in built
        or not abs(now[name] - float(built[name])) <= SAME * size[name]
    )


def _weighted(leaves: Sequence[Array | np.ndarray], xp) -> Array:
    total, before = xp.zeros(()), 1
    for leaf in leaves:
        weights = (before + np.arange(leaf.size)).reshape(leaf.shape)
        total, before = total + xp.sum(weights * leaf), before + leaf.size
    return total
