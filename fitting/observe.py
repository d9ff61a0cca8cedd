"""What a camera sees of a simulated robot, and when."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from derjax import Scene, State, Topology, angles, positions
from derjax.rods.head import head_angle, head_of, head_position
from derjax.rods.kinematics import material_directors, tangents

CHANNELS = ("x", "y", "z", "head_angle")
"""What can be tracked: position of the head node (m) and angle of the head (rad)."""

ANGLE = CHANNELS.index("head_angle")


TINY = 1e-6
"""Part of the length of an edge that makes projected lengths smooth."""


def seen(scene: Scene, states: State, sight: int | None) -> Float[Array, "t 4"]:
    """The channels of a stack of states, as `CHANNELS`: m, m, m, rad.

    Args:
        scene: the robot.
        states: a stack of them.
        sight: None for trackers that follow the head; the axis along which the camera looks for
            those that follow the whole silhouette, of which positions then are.
    """
    channels = observations(scene.rod.topology, states)
    if sight is None:
        return channels
    return channels.at[:, :ANGLE].set(silhouettes(scene, states, sight))


def observations(topology: Topology, states: State) -> Float[Array, "t 4"]:
    """The channels of a stack of states, as `CHANNELS`: m, m, m, rad.

    The angle counts whole turns. It is the spin of the head about its own axis, in frames
    carried along without twist; for a head that stays near its axis, the angle in a video.
    """
    position = head_position(topology, states)
    return jnp.concatenate([position, head_angle(topology, states)[:, None]], axis=1)


def silhouettes(scene: Scene, states: State, sight: int) -> Float[Array, "t 3"]:
    """Centroid (m) of what a camera sees of a robot that it does not resolve: head and filaments.

    The head is a disc; an edge is a rectangle as wide as the rod and as long as it looks from
    there, less the part that the head hides, which is taken to be all of it within the radius of
    the head and none beyond, with a smooth passage over the length of the edge. That filaments
    hide each other is left out: they are thin. Smooth in states and parameters.

    Args:
        scene: the robot.
        states: a stack of them.
        sight: the axis along which the camera looks, 0 to 2; the centroid along it is that of the
            same areas, and no camera sees it.
    """
    topology = scene.rod.topology
    nodes = positions(topology, states.q)
    head = nodes[:, head_of(topology).node]
    start, end = (nodes[:, topology.edge_nodes[:, k]] for k in (0, 1))
    middle, along = 0.5 * (start + end), end - start
    length = jnp.linalg.norm(along, axis=-1)
    across = np.ones(3)
    across[sight] = 0.0
    seen_length = _norm(along * across, length)
    away = _norm((middle - head[:, None]) * across, length)
    disc, width = scene.parameters["head_radius"], 2.0 * scene.parameters["rod_radius"]
    out = jnp.clip((away - disc) / length + 0.5, 0.0, 1.0)
    area = width * seen_length * out**2 * (3.0 - 2.0 * out)
    ball = jnp.pi * disc**2
    return (ball * head + jnp.sum(area[..., None] * middle, axis=1)) / (
        ball + jnp.sum(area, axis=1)[:, None]
    )


def _norm(vector: Float[Array, "... 3"], scale: Float[Array, "..."]) -> Float[Array, "..."]:
    """Length of vectors, smooth where it vanishes beside `scale`."""
    return jnp.sqrt(jnp.sum(vector**2, axis=-1) + (TINY * scale) ** 2)


def orientations(topology: Topology, states: State) -> Float[Array, "t 3 3"]:
    """Rotation matrices of the head: in columns the directions of its first edge and frame."""
    edge = head_of(topology).edges[0]
    tangent = jax.vmap(lambda q: tangents(topology, positions(topology, q))[edge])(states.q)
    angle = angles(topology, states.q)[:, edge]
    frame = material_directors(states.reference_director[:, edge], tangent, angle)
    return jnp.stack([tangent, *frame], axis=-1)


INSTANTS = np.sqrt(0.6) * np.array([-0.5, 0.0, 0.5])
"""When a frame is looked at, in units of its exposure, from the middle on (Gauss and Legendre)."""

SHARES = np.array([5.0, 8.0, 5.0]) / 18.0
"""Weights of these instants: their mean is that over the exposure to fifth order."""


def looked_at(time: Float[np.ndarray, " f"], exposure: float) -> Float[np.ndarray, "i f"]:
    """s, when a camera looks whose frames have their middle at `time` (s)."""
    return time + (INSTANTS[:, None] * exposure if exposure else np.zeros((1, 1)))


def steps_until(time: Float[np.ndarray, " f"], exposure: float, step: float) -> int:
    """Steps of some length (s) that have to be simulated for a camera to see all its frames."""
    return interpolation(looked_at(time, exposure).ravel(), step).n_steps


def exposed(at: Callable[[np.ndarray], Any], time: Float[np.ndarray, " f"], exposure: float) -> Any:
    """What a camera sees whose shutter is open for a while: the mean over that.

    Args:
        at: what is seen at times (s), an array or several.
        time: s, of the middle of each frame.
        exposure: s, for how long the shutter is open.
    """
    if exposure == 0.0:
        return at(time)
    seen_then = [at(instants) for instants in looked_at(time, exposure)]
    return jax.tree.map(
        lambda *values: sum(w * v for w, v in zip(SHARES, values, strict=True)), *seen_then
    )


class Interpolation(NamedTuple):
    """Values between the steps of a simulation: `sum_k weights[:, k] values[indices[:, k]]`.

    Attributes:
        indices: (f, 4) steps that each time is interpolated from.
        weights: (f, 4).
    """

    indices: np.ndarray
    weights: np.ndarray

    @property
    def n_steps(self) -> int:
        """Steps that have to be simulated."""
        return int(self.indices.max(initial=0))

    def __call__(self, values):
        """Interpolates an array (t, ...) over its first axis to (f, ...); NumPy or JAX."""
        weights = self.weights.reshape(*self.weights.shape, *(1,) * (values.ndim - 1))
        return (weights * values[self.indices]).sum(axis=1)


def interpolation(times: Float[np.ndarray, " f"], step: float) -> Interpolation:
    """Cubic interpolation from steps 0, 1, 2, ... of length `step` (s) to `times` (s) >= 0.

    Cubic Hermite with central differences as slopes: exact for motions quadratic in time,
    and exact, from one step only, where a time falls on a step. It is linear in the values,
    so sensitivities are interpolated in the same way. Before step 0 the motion is continued
    as the parabola through steps 0, 1 and 2.
    """
    exact = times / step
    whole = np.round(exact)
    on_step = np.abs(exact - whole) < 1e-6
    base = np.where(on_step, whole, np.floor(exact)).astype(int)
    u = np.where(on_step, 0.0, exact - base)
    weights = 0.5 * np.stack(
        [
            -u + 2 * u**2 - u**3,
            2 - 5 * u**2 + 3 * u**3,
            u + 4 * u**2 - 3 * u**3,
            -(u**2) + u**3,
        ],
        axis=1,
    )
    first = base == 0
    weights[first] = weights[first][:, [1, 2, 3, 0]]  # steps 0, 1, 2 and, for now, -1
    weights[first] += weights[first, 3:] * np.array([3.0, -3.0, 1.0, -1.0])
    indices = np.where(first, 0, base - 1)[:, None] + np.arange(4)
    return Interpolation(np.where(weights == 0.0, base[:, None], indices), weights)
