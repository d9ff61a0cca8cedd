"""Motors: how far their shafts have turned."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.pytree import pytree


@pytree
class Motor:
    """Motors whose rate is linear between the points of a table.

    A constant rate is a table of one point.

    Attributes:
        time: (p,) s, increasing; where one stands there twice the rate jumps.
        rate: (p, k) rad/s of each motor; held before the first and after the last point.
    """

    time: Float[Array, " p"]
    rate: Float[Array, "p k"]

    def rotation(self, start: Array, end: Array) -> Float[Array, " k"]:
        """Angle (rad) turned between two times (s), exactly for the piecewise linear rate."""
        if self.time.shape[0] == 1:
            return self.rate[0] * (end - start)
        # The integral of a linear function over each interval of the table that the step
        # overlaps; intervals that it does not touch have zero width.
        edges = jnp.concatenate([jnp.array([-jnp.inf]), self.time, jnp.array([jnp.inf])])
        low = jnp.clip(edges[:-1], start, end)
        high = jnp.clip(edges[1:], start, end)
        middle = 0.5 * (low + high)
        return (high - low) @ self.rate_at(middle)

    def rate_at(self, time: Float[Array, " t"]) -> Float[Array, "t k"]:
        """Rate (rad/s) of every motor at some times (s)."""
        columns = [jnp.interp(time, self.time, self.rate[:, k]) for k in range(self.rate.shape[1])]
        return jnp.stack(columns, axis=-1)
