"""Derivatives as matrices."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

COLUMNS = 256
"""Of a matrix that are found at a time: all that interacts is in memory once for each."""


def jacobian(
    function: Callable[[Float[Array, " n"]], Float[Array, " m"]], x: Float[Array, " n"]
) -> Float[Array, "m n"]:
    """The derivative of a function at x, as `jax.jacfwd`, in memory that does not grow with n."""
    _, push = jax.linearize(function, x)
    ways = jnp.eye(x.size)
    if x.size <= COLUMNS:
        return jax.vmap(push, out_axes=1)(ways)
    return lax.map(push, ways, batch_size=COLUMNS).T
