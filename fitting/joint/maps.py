"""From the track of a robot to what a camera sees of it: small maps, one after the other.

Every map is a pure function (track, time, numbers) -> track of x, y, z (m) and the angle of the
head (rad); time counts from the first frame of a track that starts steady, and from the start of
the motor of others. What a run needs is a list of them: how the robot is turned, where it is, a
drift, by how much the model is off. Their numbers are parameters like any others, each with a prior
or without.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from derjax.rods.vectors import rotation_about

from .gait import Gait, swum

Track = Float[Array, "f 4"]
Apply = Callable[[Track, Float[Array, " f"], Float[Array, " n"]], Track]


@dataclass(frozen=True)
class Map:
    """A map from tracks to tracks.

    Attributes:
        name: of what it stands for, a key of `nuisances`.
        labels: of its numbers.
        units: of its numbers.
        scales: changes of its numbers that are neither large nor small.
        apply: the map itself.
    """

    name: str
    labels: tuple[str, ...]
    units: tuple[str, ...]
    scales: tuple[float, ...]
    apply: Apply


def _rotated(track: Track, time: Array, numbers: Array) -> Track:
    about = jnp.concatenate([jnp.zeros(1), numbers])
    square = jnp.sum(about**2)
    small = square < 1e-16
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    full = rotation_about(about / angle, angle)
    cross_matrix = jnp.array(
        [[0.0, -about[2], about[1]], [about[2], 0.0, -about[0]], [-about[1], about[0], 0.0]]
    )
    turn = jnp.where(small, jnp.eye(3) + cross_matrix, full)
    return track.at[:, :3].set(track[:, :3] @ turn.T)


def _about(places: tuple[int, ...]) -> Apply:
    def apply(track: Track, time: Array, numbers: Array) -> Track:
        return _rotated(track, time, jnp.zeros(2).at[np.array(places)].set(numbers))

    return apply


def _along(places: tuple[int, ...], drifting: bool) -> Apply:
    def apply(track: Track, time: Array, numbers: Array) -> Track:
        by = jnp.zeros(3).at[np.array(places)].set(numbers)
        by = time[:, None] * by if drifting else by
        return track.at[:, :3].add(by)

    return apply


def _turned(track: Track, time: Array, numbers: Array) -> Track:
    return track.at[:, 3].add(numbers[0])


def _stretched(track: Track, time: Array, numbers: Array) -> Track:
    """The way and the angle since the first frame a little larger or smaller."""
    way = (1 + numbers[0]) * jnp.ones(3)
    return track[0] + (track - track[0]) * jnp.concatenate([way, 1 + numbers[1:]])


AXES = ("x", "y", "z")


@cache
def orientation(about: tuple[str, ...]) -> Map:
    """How the way of the robot is turned, against the x axis of the scene, about y, z or both."""
    places = tuple(("y", "z").index(axis) for axis in about)
    labels = tuple(f"about {axis}" for axis in about)
    count = len(about)
    return Map("orientation", labels, ("rad",) * count, (0.1,) * count, _about(places))


@cache
def origin(coordinates: tuple[str, ...]) -> Map:
    """Where the robot is in the first frame."""
    places, count = tuple(map(AXES.index, coordinates)), len(coordinates)
    return Map("origin", coordinates, ("m",) * count, (0.01,) * count, _along(places, False))


@cache
def drift(coordinates: tuple[str, ...]) -> Map:
    """A constant velocity besides: the fluid flows, or the robot rises or sinks."""
    places, count = tuple(map(AXES.index, coordinates)), len(coordinates)
    return Map("drift", coordinates, ("m/s",) * count, (1e-4,) * count, _along(places, True))


ANGLE_ORIGIN = Map("angle_origin", ("",), ("rad",), (1.0,), _turned)
"""Which angle the head has in the first frame."""

DISCREPANCY = Map("discrepancy", ("way", "angle"), ("1", "1"), (0.01, 0.01), _stretched)
"""By which part of the way and of the angle the model is off."""


def applied(maps: Sequence[Map], track: Track, time: Array, numbers: Float[Array, " n"]) -> Track:
    """All maps, one after the other, with their numbers in a row."""
    place = 0
    for one in maps:
        count = len(one.labels)
        track = one.apply(track, time, numbers[place : place + count])
        place += count
    return track


@partial(jax.jit, static_argnums=0)
def seen(
    maps: tuple[Map, ...],
    track: Track,
    columns: Float[Array, "f 4 k"],
    time: Float[Array, " f"],
    numbers: Float[Array, " n"],
) -> tuple[Track, Float[Array, "f 4 k"], Float[Array, "f 4 n"]]:
    """What the camera sees of a track, and its derivatives.

    Args:
        maps: in their order.
        track: m and rad.
        columns: its derivatives by anything.
        time: s.
        numbers: of the maps.

    Returns:
        The track, and its derivatives by what `columns` are by, and by the numbers of the maps.
    """
    of_track, push = jax.linearize(lambda x: applied(maps, x, time, numbers), track)
    moved = jax.vmap(push, in_axes=2, out_axes=2)(columns)
    by_numbers = jax.jacfwd(lambda n: applied(maps, track, time, n))(numbers)
    return of_track, moved, by_numbers


@jax.jit
def swimming(
    packed: Float[Array, " g"], time: Float[Array, " f"], start: Float[Array, " 2"]
) -> tuple[Track, Float[Array, "f 4 g"], Float[Array, "f 4 2"]]:
    """The track of a gait, and its derivatives.

    Args:
        packed: numbers of the gait.
        time: s, since the first frame.
        start: rad, phase and roll in the first frame.
    """

    def track(packed: Array, start: Array) -> Track:
        return swum(Gait.of(packed), time, start[0], start[1])

    by = jax.jacfwd(track, argnums=(0, 1))(packed, start)
    return track(packed, start), *by


@jax.jit
def turned_about(
    packed: Float[Array, " g"], time: Float[Array, " f"], phase: Array, rolls: Float[Array, " r"]
) -> Float[Array, "r f 4"]:
    """Tracks of a gait at one phase (rad), turned about the way by several angles (rad)."""
    return jax.vmap(lambda roll: swum(Gait.of(packed), time, phase, roll))(rolls)
