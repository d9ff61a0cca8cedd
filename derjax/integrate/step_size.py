"""How long the next step may be."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.pytree import pytree, static

SAFETY = 0.85
"""Of the length that is expected to meet the tolerance just so."""

SHRINK, GROW = 0.2, 2.5
"""How much shorter or longer than the last a step may become."""

AFTER_FAILURE = 0.25
"""How much shorter a step is tried after one in which the solver failed."""


@pytree
class StepSizeController:
    """Steps whose estimated error is a given part of the size of a robot.

    Attributes:
        tolerance: largest scaled error of a step, dimensionless.
        scale: (d,) m and rad, what errors are measured in.
        shortest: s; a step that has to be shorter still is a failure.
        order: of the scheme.
        negligible: by how much of the largest error the equations of a step may be unsolved where
            no derivative is taken.
    """

    tolerance: Float[Array, ""]
    scale: Float[Array, " d"]
    shortest: Float[Array, ""]
    order: int = static()
    negligible: Float[Array, ""] = 0.0  # pyright: ignore[reportAssignmentType]

    @property
    def negligible_move(self) -> Float[Array, " d"]:
        """m and rad, that part of the largest error."""
        return self.negligible * self.tolerance * self.scale

    def excess(self, error: Float[Array, " d"]) -> Array:
        """The error of a step over what it may be."""
        return jnp.max(jnp.abs(error) / self.scale) / self.tolerance

    def factor(self, excess: Array) -> Array:
        """By how much longer the next step may be than one with that error."""
        wanted = SAFETY * jnp.maximum(excess, 1e-12) ** (-1.0 / (self.order + 1))
        return jnp.clip(wanted, SHRINK, GROW)
