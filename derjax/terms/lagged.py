"""Drag evaluated explicitly, as the paper's scheme does."""

import jax.numpy as jnp

from ..potential import Load, Mobility
from ..pytree import pytree
from ..rod import Rod, State
from .term import Interval, Outlook, Term


@pytree
class Lagged(Term):
    """A dissipation whose force is that of the positions and velocities at the start.

    The force -dPhi/dv at the old velocity is the gradient of the implicit contribution at
    q0 + h v0. Simple, needs inertia, and stable only for small steps.
    """

    drag: Term

    def prepared(self, rod: Rod, state: State, outlook: Outlook) -> "Lagged":
        still = Outlook(configuration=state.q, move=jnp.zeros_like(state.q))
        return Lagged(self.drag.prepared(rod, state, still))

    def contribution(self, rod: Rod, state: State, interval: Interval) -> Load:
        """The force of the old velocity.

        Raises:
            ValueError: a drag whose forces are not known from velocities, one with a guard, or a
                stage of a scheme other than Euler's.
        """
        if interval.origin is not None:
            raise ValueError("explicit drag (Lagged) is only for the scheme euler")
        drag = self.drag.contribution(rod, state, interval)
        if isinstance(drag, Mobility):
            raise ValueError(
                "explicit drag (Lagged) needs forces from velocities, which BlockStokeslets do not "
                "give; build the scene with [solver] method = 'dense', or another [time] scheme"
            )
        if drag.guard is not None:
            raise ValueError("a contribution with a guard, as contact has, cannot be explicit")
        return Load(-drag.gradient(state.q + interval.length * state.velocity))
