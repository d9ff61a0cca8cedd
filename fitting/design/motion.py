"""What a design is judged by: a steady motion, or a run in time, in the same words.

Both have the means over time that quantities are made of (see `quantities`): of a steady motion
they are what they are at any moment, of a run they are taken from some frame on to its end.
"""

from typing import Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from derjax import HeadDrag, InputError, Run, Scene, State, Steady, positions
from derjax.core.pytree import pytree, static
from derjax.results.mechanics import motor_rates, motor_torques
from derjax.rods.head import head_angle, head_position
from derjax.steady.motion import imbalance


class Motion(Protocol):
    """What quantities ask of a motion. Speeds, rates and forces are without sign."""

    @property
    def scene(self) -> Scene: ...

    @property
    def speed(self) -> Float[Array, ""]:
        """m/s, of the head: how fast the robot gets on."""
        ...

    @property
    def head_rate(self) -> Float[Array, ""]:
        """rad/s, at which the head turns about its own axis."""
        ...

    @property
    def torques(self) -> Float[Array, "t k"]:
        """N m, of every motor, at one time or several."""
        ...

    @property
    def rates(self) -> Float[Array, "t k"]:
        """rad/s, of every motor, at the same times."""
        ...

    @property
    def thrust(self) -> Float[Array, ""]:
        """N: against which the head is dragged along, or that holds a filament in its place."""
        ...


@pytree
class Rest:
    """A robot that does not move: only its shape counts, and what follows from that.

    Attributes:
        scene: of the robot.
    """

    scene: Scene

    @property
    def given(self) -> Scene:
        """What a function of one's own is given."""
        return self.scene


@pytree
class SteadyMotion:
    """A steady state as a `Motion`.

    Attributes:
        state: the steady state.
    """

    state: Steady

    @property
    def given(self) -> Steady:
        """What a function of one's own is given."""
        return self.state

    @property
    def scene(self) -> Scene:
        return self.state.scene

    @property
    def speed(self) -> Float[Array, ""]:
        return jnp.abs(self.state.speed)

    @property
    def head_rate(self) -> Float[Array, ""]:
        return jnp.abs(self.state.head_rate)

    @property
    def torques(self) -> Float[Array, "t k"]:
        return motor_torques(self.scene, jax.tree.map(lambda leaf: leaf[None], self.state.state))

    @property
    def rates(self) -> Float[Array, "t k"]:
        return jnp.reshape(self.state.motor_rate, (1, 1))

    @property
    def thrust(self) -> Float[Array, ""]:
        if self.scene.rod.topology.head is not None:
            return self.scene[HeadDrag].translation * self.speed
        # What is not balanced at the nodes is what holds the filament.
        now = self.state.state
        left = imbalance(self.scene, now.q, now.velocity, now.acceleration)
        held = jnp.sum(positions(self.scene.rod.topology, left), axis=0)
        return jnp.abs(held @ self.state.symmetry.driven)


@pytree
class RunMotion:
    """A run, from some frame on, as a `Motion`.

    Attributes:
        run: the whole run.
        first: the frame from which on means are taken.
    """

    run: Run
    first: int = static()

    @property
    def given(self) -> Run:
        """What a function of one's own is given."""
        return self.run

    @property
    def scene(self) -> Scene:
        return self.run.scene

    @property
    def part(self) -> State:
        """The states of which means are taken."""
        return jax.tree.map(lambda leaf: leaf[self.first :], self.run.states)

    @property
    def duration(self) -> Float[Array, ""]:
        """s, over which means are taken."""
        return self.run.time[-1] - self.run.time[self.first]

    @property
    def shift(self) -> Float[Array, " 3"]:
        """m, by which the head has moved meanwhile."""
        path = head_position(self.scene.rod.topology, self.part)
        return path[-1] - path[0]

    @property
    def speed(self) -> Float[Array, ""]:
        return size(self.shift) / self.duration

    @property
    def head_rate(self) -> Float[Array, ""]:
        turned = head_angle(self.scene.rod.topology, self.run.states)
        return jnp.abs(turned[-1] - turned[self.first]) / self.duration

    @property
    def torques(self) -> Float[Array, "t k"]:
        return motor_torques(self.scene, self.part)

    @property
    def rates(self) -> Float[Array, "t k"]:
        return motor_rates(self.scene, self.part)

    @property
    def thrust(self) -> Float[Array, ""]:
        if self.scene.rod.topology.head is None:
            raise InputError("force: of a filament that is held it is that of its steady state")
        return self.scene[HeadDrag].translation * self.speed


def size(vector: Float[Array, " 3"]) -> Float[Array, ""]:
    """The length of a vector; where that is zero its derivative is, too."""
    square = jnp.sum(vector**2)
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)
