"""How a robot swims, in a few numbers, and its track from these.

A robot that swims steadily goes along an axis and turns about it, and what its head does besides
comes back in every turn of its motors. So its track of any length is known by three rates and by
the coefficients of a Fourier series. With one flagellum the series is a constant: the
head goes round the axis on a helix. This holds for steady states and for periodic orbits.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from derjax import State, Steady, positions
from derjax.rods.head import head_angle, head_of, head_position
from derjax.rods.topology import Topology
from derjax.rods.vectors import cross, rotation_about

RATES = 4
"""Numbers of a gait before the coefficients."""

HARMONICS = 8
"""Of the motion in a turn that are kept; all are far below what a camera sees beyond."""


class Gait(NamedTuple):
    """How a robot swims along an axis, which points about along x of its scene.

    Attributes:
        speed: m/s, along the axis.
        turning: rad/s, of the robot about the axis.
        head_rate: rad/s, at which the head turns about its own axis, on average.
        pace: rad/s, at which what repeats itself does; 0 if nothing changes.
        path: (2 h + 1, 4) m and rad: Fourier coefficients (constant, then cosine and sine of each
            harmonic) of the head's place, in axes that turn and move along, and its angle.
    """

    speed: Float[Array, ""]
    turning: Float[Array, ""]
    head_rate: Float[Array, ""]
    pace: Float[Array, ""]
    path: Float[Array, "k 4"]

    def packed(self) -> Float[Array, " g"]:
        """All numbers in a row."""
        rates = jnp.stack([self.speed, self.turning, self.head_rate, self.pace])
        return jnp.concatenate([rates, self.path.ravel()])

    @staticmethod
    def of(packed: Float[Array, " g"]) -> "Gait":
        """The gait of numbers in a row."""
        speed, turning, head_rate, pace = packed[:RATES]
        return Gait(speed, turning, head_rate, pace, packed[RATES:].reshape(-1, 4))


def swum(
    gait: Gait, time: Float[Array, " f"], phase: Array | float, roll: Array | float
) -> Float[Array, "f 4"]:
    """The track of a gait along the x axis: x, y, z (m) and the angle of the head (rad).

    Args:
        gait: of the robot.
        time: s, since it was at the origin.
        phase: rad, of what repeats itself, at time 0.
        roll: rad, of the robot about the axis, at time 0.
    """
    orders = np.arange(1, (gait.path.shape[0] - 1) // 2 + 1)
    turns = (phase + gait.pace * time)[:, None] * orders
    waves = jnp.stack([jnp.cos(turns), jnp.sin(turns)], axis=-1).reshape(len(time), -1)
    basis = jnp.concatenate([jnp.ones((len(time), 1)), waves], axis=1)
    along, one, other, angle = (basis @ gait.path).T
    turned = roll + gait.turning * time
    c, s = jnp.cos(turned), jnp.sin(turned)
    return jnp.stack(
        [
            gait.speed * time + along,
            c * one - s * other,
            s * one + c * other,
            gait.head_rate * time + angle,
        ],
        axis=1,
    )


def gait_of_steady(state: Steady) -> Gait:
    """The gait of a steady state; differentiable."""
    topology = state.scene.rod.topology
    motion = state.motion
    square = jnp.sum(motion.rotation**2)
    axis = motion.rotation / jnp.sqrt(square)
    sense = lax.stop_gradient(jnp.sign(axis[0]))
    centre = cross(motion.rotation, motion.velocity) / square
    from_axis = positions(topology, state.state.q)[head_of(topology).node] - centre
    across = from_axis - (from_axis @ axis) * axis
    radius = jnp.sqrt(jnp.sum(across**2) + 1e-30)
    still = jnp.zeros(())
    return Gait(
        speed=sense * (motion.velocity @ axis),
        turning=sense * jnp.sqrt(square),
        head_rate=state.head_rate,
        pace=still,
        path=jnp.stack([still, radius, still, still])[None],
    )


def gait_of_turn(
    topology: Topology,
    states: State,
    turn: Float[Array, "3 3"],
    shift: Float[Array, " 3"],
    period: Array,
) -> Gait:
    """The gait of a turn of the motors; differentiable.

    Args:
        topology: of the robot.
        states: at the beginning and after every step, with a leading axis.
        turn, shift: what the turn makes of the robot: x to turn x + shift (m).
        period: s.
    """
    count = states.q.shape[0] - 1
    time = period * jnp.arange(count) / count
    skew = jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine = 0.5 * jnp.sqrt(skew @ skew + 1e-30)
    axis = 0.5 * skew / sine
    sense = lax.stop_gradient(jnp.sign(axis[0]))
    angle = jnp.arctan2(sine, 0.5 * (jnp.trace(turn) - 1.0))
    axis, angle = sense * axis, sense * angle
    along = shift @ axis
    across = shift - along * axis
    # The point of the axis that the turn leaves on it.
    centre = 0.5 * (across + cross(axis, across) / jnp.tan(0.5 * angle))

    place, turned = head_position(topology, states), head_angle(topology, states)
    head_rate = (turned[-1] - turned[0]) / period

    def back(x: Array, t: Array) -> Array:
        return rotation_about(axis, -angle * t / period) @ (x - centre) - along * t / period * axis

    local = jax.vmap(back)(place[:-1], time)
    one = jnp.array([0.0, 1.0, 0.0]) - axis[1] * axis
    one = one / jnp.sqrt(one @ one)
    frame = jnp.stack([axis, one, cross(axis, one)])
    angles = turned[:-1] - turned[0] - head_rate * time
    path = fourier(jnp.concatenate([local @ frame.T, angles[:, None]], axis=1))
    return Gait(along / period, angle / period, head_rate, 2 * jnp.pi / period, path)


def fourier(values: Float[Array, "n c"]) -> Float[Array, "k c"]:
    """Coefficients of a periodic function that is known at equal steps of a period."""
    n = len(values)
    orders = np.arange(1, min(HARMONICS, (n - 1) // 2) + 1)
    turns = 2 * np.pi * np.arange(n)[:, None] * orders / n
    waves = np.stack([np.cos(turns), np.sin(turns)], axis=-1).reshape(n, -1)
    basis = np.concatenate([np.ones((n, 1)) / n, 2 / n * waves], axis=1)
    return jnp.asarray(basis).T @ values
