"""Drag evaluated explicitly, as the paper's scheme does."""

import jax.numpy as jnp

from ..potential import Load
from ..pytree import pytree, replace
from ..rod import Rod, State
from .term import Interval, Term


@pytree
class Lagged:
    """A dissipation whose force is that of the positions and velocities at the start.

    The force -dPhi/dv at the old velocity is the gradient of the implicit contribution at
    q0 + h v0. Simple, needs inertia, and stable only for small steps.
    """

    drag: Term

    def contribution(self, rod: Rod, state: State, interval: Interval) -> Load:
        still = replace(state, velocity=jnp.zeros_like(state.velocity))  # no prediction
        drag = self.drag.contribution(rod, still, interval)
        return Load(-drag.gradient(state.q + interval.length * state.velocity))
