"""What every physical ingredient of a scene is."""

import enum
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.pytree import pytree
from ..rods.rod import Rod, State
from ..solve.contributions import Contribution, Mobility

T = TypeVar("T", bound="Term")


@pytree
class Stage:
    """What is solved for in one go: a step of implicit Euler, or a stage of a scheme like it.

    Velocities are (q - origin) / length, and accelerations the change from `velocity` to
    that, over `length`. In a step of implicit Euler both are those of the state; a stage of a
    Runge-Kutta scheme takes in what its earlier stages have found.

    Attributes:
        length: s.
        time: s, at its end: when loads that depend on time act.
        motor_angle: (k,) rad, of the motors at its end, or about that if it is not known before.
        origin: (d,) m and rad; None for that of the state.
        velocity: (d,) m/s and rad/s; None for that of the state.
        fluid_velocity: (d,) m/s and rad/s, of the fluid where nodes and edges are; None for a
            fluid at rest.
        motor_origin: (k,) rad, from which the rates of motors are measured; None for where they
            stand in the state.
    """

    length: Float[Array, ""]
    time: Float[Array, ""]
    motor_angle: Float[Array, " k"]
    origin: Float[Array, " d"] | None = None
    velocity: Float[Array, " d"] | None = None
    fluid_velocity: Float[Array, " d"] | None = None
    motor_origin: Float[Array, " k"] | None = None

    def origin_from(self, state: State) -> Float[Array, " d"]:
        """Where velocities are measured from (m, rad), in a step that starts at `state`."""
        return state.q if self.origin is None else self.origin

    def fluid_origin_from(self, state: State) -> Float[Array, " d"]:
        """Where velocities relative to the fluid are measured from (m, rad): what drag asks for.

        That is where a rod which the fluid carries along would end.
        """
        origin = self.origin_from(state)
        if self.fluid_velocity is None:
            return origin
        return origin + self.length * self.fluid_velocity

    def velocity_from(self, state: State) -> Float[Array, " d"]:
        """What accelerations are measured from (m/s, rad/s)."""
        return state.velocity if self.velocity is None else self.velocity


@dataclass(frozen=True)
class Prediction:
    """How the rod is expected to move during a step, and what the terms make of that.

    Attributes:
        configuration: (d,) m and rad, that for which drag is wanted.
        move: (d,) m and rad, from the start of the step to its end.
        terms: of the scene, which may ask each other.
    """

    configuration: Float[Array, " d"]
    move: Float[Array, " d"]
    terms: tuple["Term", ...] = ()
    _caches: dict[int, Any] = field(default_factory=dict)

    def only(self, kind: type[T], why: str) -> T:
        """The one term of some kind.

        Raises:
            ValueError: there is none, or there are several; the message says `why` it is needed.
        """
        found = [term for term in self.terms if isinstance(term, kind)]
        if len(found) != 1:
            raise ValueError(f"{why} needs one term {kind.__name__}; the scene has {len(found)}")
        return found[0]

    def cache(self, term: "Term", rod: Rod, state: State) -> Any:
        """What a term prepares for a step that starts at `state`: found once, for all who ask."""
        if id(term) not in self._caches:
            with jax.named_scope(f"prepare {type(term).__name__}"):
                self._caches[id(term)] = term.prepare(rod, state, self)
        return self._caches[id(term)]


def standing(state: State, terms: Sequence["Term"] = ()) -> Prediction:
    """The prediction that the rod stays where it is."""
    return Prediction(state.q, jnp.zeros_like(state.q), tuple(terms))


class Role(enum.Enum):
    """What the contribution of a term is: this is for results, and no solver asks for it."""

    ENERGY = enum.auto()
    DRAG = enum.auto()
    FRICTION = enum.auto()
    INERTIA = enum.auto()
    DRIVE = enum.auto()
    CORRECTION = enum.auto()


class Term:
    """A physical ingredient: a pytree whose leaves are its parameters.

    A new one derives from this class and has `contribution`; the other methods are for those that
    need them.

    Attributes:
        role: whether it stores energy, resists motion, or what else it does.
    """

    role: ClassVar[Role] = Role.ENERGY

    def prepare(self, rod: Rod, state: State, prediction: Prediction) -> Any:
        """What is found out once, before the step that starts at `state` is solved for.

        Here belongs what follows from where the rod is expected to go: drag matrices, lists of
        what comes close. So drag is linear in the velocity.
        """
        return None

    def contribution(
        self, rod: Rod, state: State, stage: Stage, cache: Any
    ) -> Contribution | Mobility:
        """The term's share of the incremental potential of a stage of that step.

        Args:
            rod: topology and stress-free shape.
            state: at the start of the step.
            stage: what is solved for.
            cache: what `prepare` returned.
        """
        raise NotImplementedError(f"{type(self).__name__} has no contribution")

    def fluid_velocity(
        self, x: Float[Array, " 3"], time: Float[Array, ""]
    ) -> Float[Array, " 3"] | None:
        """The velocity (m/s) at a place (m) of a flow that the term makes; None if it makes none.

        All drag is then relative to that flow.
        """
        return None

    def enlarged(self: T) -> T:
        """With room for twice as much of what the term keeps in lists of fixed length."""
        return self


def contributions(
    terms: Sequence[Term],
    rod: Rod,
    state: State,
    stage: Stage,
    prediction: Prediction | None = None,
) -> list[Contribution | Mobility]:
    """What terms contribute to a stage.

    Args:
        terms: of one scene.
        rod: topology and stress-free shape.
        state: at the start of the step.
        stage: what is solved for.
        prediction: of the step; None for a rod that stays where it is.
    """
    known = standing(state, terms) if prediction is None else prediction
    found = []
    for term in terms:
        cache = known.cache(term, rod, state)
        with jax.named_scope(type(term).__name__):
            found.append(term.contribution(rod, state, stage, cache))
    return found
