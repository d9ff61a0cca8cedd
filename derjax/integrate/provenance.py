"""Whether the terms of a scene are still those that it was built with.

A scene keeps the numbers that it was built of (`Scene.parameters`). Its terms may be replaced
afterwards; then those numbers are not all that there is to say, and results should tell so.
"""

import zlib
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..terms.term import Term

SAME = 1e-9
"""Relative difference of check sums that rounding may make."""

CheckSums = dict[tuple[str, int], Array]
"""Check sums of terms, by the names of their types and what else is part of their structure."""


def check_sums(terms: Sequence[Term]) -> CheckSums:
    """Sums over the leaves of terms, in which every number has a weight of its own."""
    sums: CheckSums = {}
    for term in terms:
        kind = _kind(term)
        sums[kind] = sums.get(kind, jnp.zeros(())) + _weighted(jax.tree.leaves(term), jnp)
    return sums


def for_enlarged(sums: CheckSums, terms: Sequence[Term], enlarged: Sequence[Term]) -> CheckSums:
    """The check sums, once terms have longer lists: these are no change of what was built."""
    kinds = {_kind(old): _kind(new) for old, new in zip(terms, enlarged, strict=True)}
    return {kinds.get(kind, kind): value for kind, value in sums.items()}


def _kind(term: Term) -> tuple[str, int]:
    """The name of a term's type, and a number for all that is no leaf of it."""
    # Not its hash, which is another one in every process: the compiled program that builds a scene
    # is kept under a name that has this number in it.
    return type(term).__name__, zlib.crc32(repr(jax.tree.structure(term)).encode())


def changed(terms: Sequence[Term], built: CheckSums) -> tuple[str, ...]:
    """Names of the types of terms that are not as they were; computed on the host.

    Args:
        terms: those of a scene.
        built: the check sums of the terms that it was built with.
    """
    now: dict[tuple[str, int], float] = {}
    size: dict[tuple[str, int], float] = {}
    for term in terms:
        kind = _kind(term)
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(term)]
        now[kind] = now.get(kind, 0.0) + float(_weighted(leaves, np))
        size[kind] = size.get(kind, 0.0) + float(_weighted([abs(leaf) for leaf in leaves], np))
    others = {
        name
        for name, structure in now.keys() | built.keys()
        if (name, structure) not in now
        or (name, structure) not in built
        or not abs(now[name, structure] - float(built[name, structure]))
        <= SAME * size[name, structure]
    }
    return tuple(sorted(others))


def _weighted(leaves: Sequence[Array | np.ndarray], xp) -> Array:
    total, before = xp.zeros(()), 1
    for leaf in leaves:
        weights = (before + np.arange(leaf.size)).reshape(leaf.shape)
        total, before = total + xp.sum(weights * leaf), before + leaf.size
    return total
