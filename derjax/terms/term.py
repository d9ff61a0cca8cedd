"""What every physical ingredient of a scene is."""

from typing import Protocol

from jaxtyping import Array, Float

from ..potential import Contribution
from ..pytree import pytree
from ..rod import Rod, State


@pytree
class Interval:
    """The step that is being taken.

    Attributes:
        length: s.
        motor_angle: (k,) rad, natural twist of the driven hinges at its end.
    """

    length: Float[Array, ""]
    motor_angle: Float[Array, " k"]

    def middle(self, state: State) -> Float[Array, " d"]:
        """Where the rod will be in the middle of the step, if it goes on as it did (m, rad).

        Drag is linear in the velocity at a known configuration. Taken here, rather than at
        the start, that configuration costs no more and is one order better.
        """
        return state.q + 0.5 * self.length * state.velocity


class Term(Protocol):
    """A physical ingredient: a pytree whose leaves are its parameters."""

    def contribution(self, rod: Rod, state: State, interval: Interval) -> Contribution:
        """The term's share of the incremental potential of the step that starts at `state`."""
        ...
