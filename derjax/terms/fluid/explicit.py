"""Drag evaluated explicitly, as the paper's scheme does."""

from typing import Any, ClassVar

from ...core.pytree import pytree
from ...rods.rod import Rod, State
from ...solve.contributions import Load, Mobility
from ..term import Prediction, Role, Stage, Term, standing


@pytree
class ExplicitDrag(Term):
    """A dissipation whose force is that of the positions and velocities at the start.

    The force -dPhi/dv at the old velocity is the gradient of the implicit contribution at
    q0 + h v0. Simple, needs inertia, and stable only for small steps.
    """

    role: ClassVar[Role] = Role.DRAG

    drag: Term

    def prepare(self, rod: Rod, state: State, prediction: Prediction) -> Any:
        """What the drag prepares at the start of the step."""
        return self.drag.prepare(rod, state, standing(state, prediction.terms))

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: Any) -> Load:
        """The force of the old velocity.

        Raises:
            ValueError: a drag whose forces are not known from velocities, one with a guard, or a
                stage of a scheme other than Euler's.
        """
        if stage.origin is not None:
            raise ValueError("explicit drag is only for the scheme euler")
        drag = self.drag.contribution(rod, state, stage, cache)
        if isinstance(drag, Mobility):
            raise ValueError(
                "explicit drag needs forces from velocities, which BlockStokeslets do not "
                "give; build the scene with [solver] method = 'dense', or another [time] scheme"
            )
        if drag.guard is not None:
            raise ValueError("a contribution with a guard, as contact has, cannot be explicit")
        return Load(-drag.gradient(state.q + stage.length * state.velocity))
