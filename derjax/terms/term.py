"""What every physical ingredient of a scene is."""

from jaxtyping import Array, Float

from ..potential import Contribution, Mobility
from ..pytree import pytree
from ..rod import Rod, State


@pytree
class Interval:
    """What is solved for in one go: a step of implicit Euler, or a stage of a scheme like it.

    Velocities are (q - origin) / length, and accelerations the change from `velocity` to
    that, over `length`. In a step of implicit Euler both are those of the state; a stage of a
    Runge-Kutta scheme takes in what its earlier stages have found.

    Attributes:
        length: s.
        motor_angle: (k,) rad, natural twist of the driven hinges at its end.
        origin: (d,) m and rad; None for that of the state.
        velocity: (d,) m/s and rad/s; None for that of the state.
    """

    length: Float[Array, ""]
    motor_angle: Float[Array, " k"]
    origin: Float[Array, " d"] | None = None
    velocity: Float[Array, " d"] | None = None

    def origin_from(self, state: State) -> Float[Array, " d"]:
        """Where velocities are measured from (m, rad), in a step that starts at `state`."""
        return state.q if self.origin is None else self.origin

    def velocity_from(self, state: State) -> Float[Array, " d"]:
        """What accelerations are measured from (m/s, rad/s)."""
        return state.velocity if self.velocity is None else self.velocity


@pytree
class Outlook:
    """How the rod is expected to move during a step.

    Attributes:
        configuration: (d,) m and rad, that for which drag is wanted.
        move: (d,) m and rad, from the start of the step to its end.
    """

    configuration: Float[Array, " d"]
    move: Float[Array, " d"]


class Term:
    """A physical ingredient: a pytree whose leaves are its parameters."""

    def prepared(self, rod: Rod, state: State, outlook: Outlook) -> "Term":
        """What stands for the term in an interval of the step that starts at `state`.

        Here belongs what is found before solving, from where the rod is expected to go: drag
        matrices, lists of what comes close. So drag is linear in the velocity.
        """
        return self

    def contribution(self, rod: Rod, state: State, interval: Interval) -> Contribution | Mobility:
        """The term's share of the incremental potential of an interval of that step."""
        raise NotImplementedError
