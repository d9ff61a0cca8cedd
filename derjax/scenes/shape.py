"""The shape of a robot: where its nodes are at rest, and which of its edges may touch."""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..core.pytree import Indices, replace
from ..shapes import (
    RobotGeometry,
    arc,
    branched,
    clamped,
    edge_count,
    helix,
    helix_contour,
    rotated_about_x,
    single_flagellum,
    two_flagella,
)
from ..terms.contact.neighbours import PENETRATION, pairs_apart
from ..terms.contact.segments import distance
from .file import SceneFile
from .parameters import EACH

PARTS = 16
"""Of an edge, when it is asked whether it overlaps another."""

_distance = jax.jit(distance)

SHAPE = ("helix_radius", "pitch", "axial_length", "rod_radius", "separation", "bend", "phase")
"""The parameters that say which edges may touch."""


def geometry_of(scene: SceneFile, p: Mapping[str, Any]) -> RobotGeometry:
    """The nodes (m) of a robot at rest, and how they hang together.

    Their number is that of the file's own dimensions.

    Args:
        scene: the file.
        p: its parameters, or others: those of the shape are needed. With numbers of NumPy
            nothing is compiled.
    """
    geometry = _joined(scene, p)
    topology = geometry.topology
    if topology.motors:
        topology = replace(topology, motor_hinge=scene.motor.hinge)
    if scene.motor.stall_torque is not None:  # what such motors turn is not held
        turned = topology.edge_dofs(topology.driven_edges).tolist()
        held = tuple(d for d in topology.fixed_dofs if d not in turned)
        topology = replace(topology, fixed_dofs=held)
    return geometry._replace(topology=topology)


def _joined(scene: SceneFile, p: Mapping[str, Any]) -> RobotGeometry:
    """The flagella, and what joins them."""
    robot = scene.robot
    filaments, edge = _filaments(scene, p)
    if robot.kind == "single_flagellum":
        return single_flagellum(filaments[0], edge)
    if robot.kind == "two_flagella":
        return two_flagella((filaments[0], filaments[1]), edge, p["separation"])
    separation = p.get("separation", np.zeros(()))
    if robot.kind == "clamped":
        return clamped(filaments, edge, separation, robot.clamped_tip)
    return branched(filaments, edge, separation)


def _filaments(scene: SceneFile, p: Mapping[str, Any]) -> tuple[list[Any], Any]:
    """The filaments of a robot, each in a frame of its own, and the length of the head's edges.

    That is the length of those of the flagella, or its mean if they differ.
    """
    robot, filaments, edges = scene.robot, [], []
    for k, hand in enumerate(robot.hands):
        length = _of(p["axial_length"], k)
        own_length = robot.each("axial_length")[k]
        if robot.shape == "helix":
            radius, pitch = _of(p["helix_radius"], k), _of(p["pitch"], k)
            own = robot.each("helix_radius")[k], robot.each("pitch")[k], own_length
            n_edges = edge_count(*own, robot.edge_length)
            edges.append(helix_contour(radius, pitch, length) / n_edges)
            nodes = helix(radius, pitch, length, n_edges, hand)
        else:
            n_edges = max(3, math.floor(own_length / robot.edge_length + 1e-9))
            edges.append(length / n_edges)
            nodes = arc(length, p.get("bend", np.zeros(())), n_edges)
        filaments.append(rotated_about_x(_of(p["phase"], k), nodes) if "phase" in p else nodes)
    alike = all(np.ndim(p.get(name, 0.0)) == 0 for name in EACH)
    return filaments, edges[0] if alike else sum(edges[1:], edges[0]) / len(edges)


def _of(value: Any, flagellum: int) -> Any:
    """The number of one flagellum."""
    return value[flagellum] if np.ndim(value) else value


def touching_pairs(scene: SceneFile, numbers: Mapping[str, Any] | None = None) -> Indices:
    """The pairs of edges of a robot that can touch.

    Those between which there is less rod than pi r_0 cannot: a rod that bends back on itself
    as tightly as its thickness allows touches itself after half a turn of that radius.

    Args:
        scene: the file.
        numbers: all its parameters; None for its own.

    Raises:
        InputError: parts of the robot overlap at the start.
    """
    numbers = scene.parameters if numbers is None else numbers
    shape = tuple((name, _hashable(numbers[name])) for name in SHAPE if name in numbers)
    # Scenes are hashable, which type checkers do not see.
    hashable: Any = scene
    return _touching_pairs(hashable, shape)


def _hashable(value: Any) -> float | tuple[float, ...]:
    """A number, or one for each flagellum."""
    return tuple(np.asarray(value).tolist()) if np.ndim(value) else float(value)


@lru_cache(maxsize=64)
def _touching_pairs(scene: SceneFile, shape: tuple[tuple[str, Any], ...]) -> Indices:
    numbers = {name: np.asarray(value) for name, value in shape}
    geometry = geometry_of(scene, numbers)
    start, end = geometry.topology.edge_nodes.T
    nodes = np.asarray(geometry.nodes)
    length = np.linalg.norm(nodes[end] - nodes[start], axis=1)
    pairs = pairs_apart(geometry.topology, length, np.pi * float(numbers["rod_radius"]))
    _check_apart(numbers, nodes[geometry.topology.edge_nodes], pairs)
    return pairs


def _check_apart(
    numbers: Mapping[str, Any], edges: Float[np.ndarray, "e 2 3"], pairs: Indices
) -> None:
    """Refuses a robot whose parts overlap from the start."""
    diameter = 2 * numbers["rod_radius"]
    close = pairs.array
    for parts in (1, PARTS):  # spheres around parts of the edges: few edges are left to measure
        places = (np.arange(parts) + 0.5) / parts
        middle = edges[:, None, 0] + places[:, None] * (edges[:, 1] - edges[:, 0])[:, None]
        half = 0.5 * np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1) / parts
        first, second = close.T
        between = middle[first][:, :, None] - middle[second][:, None]
        apart = np.linalg.norm(between, axis=-1).min(axis=(1, 2)) - half[first] - half[second]
        close = close[apart < diameter]
    if len(close) == 0:
        return
    with jax.ensure_compile_time_eval():
        nearest = float(_distance(edges[close].reshape(-1, 4, 3)).min())
    if nearest < (1 - PENETRATION) * diameter:
        hint = "a smaller rod_radius"
        if "separation" in numbers:
            hint = f"a larger separation (now {numbers['separation']:g} m) or other phases"
        raise InputError(
            f"[robot]: two parts of the robot overlap at the start, their centre lines "
            f"{nearest:.3g} m apart and the rod {diameter:.3g} m thick; try {hint}"
        )
