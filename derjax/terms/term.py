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


class Term(Protocol):
    """A physical ingredient: a pytree whose leaves are its parameters."""

    def contribution(self, rod: Rod, state: State, interval: Interval) -> Contribution:
        """The term's share of the incremental potential of the step that starts at `state`."""
        ...
