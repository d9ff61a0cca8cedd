"""From a scene file to the terms that it names: the registry of physical ingredients."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .blocks import Layout
from .control import Control
from .defaults import SLIP
from .motor import Motor
from .neighbours import PENETRATION, pairs_apart
from .newton import NewtonSettings
from .pytree import Indices, replace
from .robots import (
    Body,
    arc,
    around,
    branched,
    clamped,
    edge_count,
    helix,
    helix_contour,
    single_flagellum,
    two_flagella,
)
from .rod import Rod, State, Topology, at_rest
from .scenefile import Friction as FrictionTable
from .scenefile import InputError, SceneFile
from .schemes.corrected import corrected
from .schemes.euler import euler
from .schemes.trbdf2 import trbdf2
from .segments import distance
from .step import Scene, Step
from .terms.bend import Bend
from .terms.block_stokeslets import BlockStokeslets
from .terms.contact import Contact
from .terms.friction import Friction
from .terms.gravity import Gravity
from .terms.head import HeadDrag
from .terms.inertia import Inertia
from .terms.lagged import Lagged
from .terms.resistive import ResistiveDrag, gray_hancock, lighthill
from .terms.spillmann_teschner import SpillmannTeschner
from .terms.stokeslets import StokesletSegments
from .terms.stretch import Stretch
from .terms.term import Term
from .terms.twist import Twist

Parameters = Mapping[str, Any]

SHORTEST = 1e-6
"""The shortest that steps that adapt may become, over the first."""


def build(scene: SceneFile, parameters: Parameters | None = None) -> tuple[Scene, State]:
    """The scene that a file describes, and the state in which it starts, at rest.

    A smooth function of `parameters`, so that a rollout may be differentiated with respect to
    any of them; the number of nodes is that of the file's own dimensions.

    Args:
        scene: the checked file; its choices decide which terms there are.
        parameters: numbers that replace those of the file, by the keys of
            `scene.parameters`, in the same units.

    Raises:
        KeyError: a parameter that the scene does not have.
        InputError: parts of the robot that must not touch overlap at the start.
    """
    known = scene.parameters
    for name in parameters or {}:
        if name not in known:
            raise KeyError(f"no parameter {name!r}; the scene has {', '.join(known)}")
    numbers = scene.parameters_with(parameters or {})
    return _build(scene, {name: jnp.asarray(value, float) for name, value in numbers.items()})


def enlarge(scene: Scene) -> Scene:
    """The scene with room for twice as many contacts at one time."""
    terms = [t.enlarged() if isinstance(t, Contact | Friction) else t for t in scene.terms]
    return replace(scene, terms=tuple(terms))


@partial(jax.jit, static_argnums=0)  # as one program: quicker than operation by operation
def _build(scene: SceneFile, p: dict[str, Array]) -> tuple[Scene, State]:
    body = _body(scene, p)
    rod, state = at_rest(body.topology, body.nodes)
    built = Scene(
        rod=rod,
        terms=tuple(_terms(scene, p, rod, body.stiff_hinges)),
        motor=_motor(scene, p, rod.topology),
        newton=_newton(scene, p, rod),
        step_length=jnp.asarray(scene.step),
        scheme=_scheme(scene),
        control=_control(scene, rod),
        layout=_layout(scene, rod.topology),
    )
    return built, state


def _body(scene: SceneFile, p: dict[str, Array]) -> Body:
    robot = scene.robot
    filaments, edge = _filaments(scene, p)
    if robot.kind == "single_flagellum":
        return single_flagellum(filaments[0], edge)
    if robot.kind == "two_flagella":
        return two_flagella((filaments[0], filaments[1]), edge, p["separation"])
    separation = p.get("separation", jnp.zeros(()))
    return {"branched": branched, "clamped": clamped}[robot.kind](filaments, edge, separation)


def _filaments(scene: SceneFile, p: dict[str, Array]) -> tuple[list[Array], Array]:
    """The filaments of a robot, each in a frame of its own, and the length of their edges."""
    robot, length = scene.robot, p["axial_length"]
    if robot.shape == "helix":
        radius, pitch = p["helix_radius"], p["pitch"]
        n_edges = edge_count(robot.helix_radius, robot.pitch, robot.axial_length, robot.edge_length)
        edge = helix_contour(radius, pitch, length) / n_edges
        filaments = [helix(radius, pitch, length, n_edges, hand) for hand in robot.hands]
    else:
        n_edges = max(3, math.floor(robot.axial_length / robot.edge_length + 1e-9))
        edge = length / n_edges
        bend = p.get("bend", jnp.zeros(()))
        filaments = [arc(length, bend, n_edges) for _ in robot.hands]
    return [
        around(phase, nodes) if phase else nodes
        for phase, nodes in zip(robot.phases, filaments, strict=True)
    ], edge


def _terms(
    scene: SceneFile, p: dict[str, Array], rod: Rod, stiff_hinges: Sequence[int]
) -> list[Term]:
    """The terms of a scene. A new ingredient is registered here and nowhere else."""
    topology, fluid = rod.topology, scene.fluid
    radius, modulus = p["rod_radius"], p["youngs_modulus"]
    area, inertia = jnp.pi * radius**2, jnp.pi * radius**4 / 4
    shear = modulus / (2 * (1 + p["poisson_ratio"]))
    n_edges, n_hinges = topology.n_edges, len(topology.hinges)
    relative = np.ones(n_hinges)
    relative[list(stiff_hinges)] = scene.head.stiffness
    terms: list[Term] = [
        Stretch(jnp.full(n_edges, modulus * area)),
        Bend(modulus * inertia * relative),
        Twist(2 * shear * inertia * relative),
    ]
    if topology.head is not None and scene.head.drag == "stokes":
        viscosity, size = p["viscosity"], p["head_radius"]
        spin = 8 * jnp.pi * viscosity * size**3 * p["C_r"]
        tilt = spin if scene.head_rotation == "full" else jnp.zeros(())
        terms.append(HeadDrag(6 * jnp.pi * viscosity * size * p["C_t"], spin, tilt))
    if fluid.hydrodynamics != "none":
        drag = _stokeslets(scene, p, rod) if fluid.hydrodynamics == "rss" else _resistive(scene, p)
        terms.append(Lagged(drag) if scene.time.scheme == "explicit" else drag)
    if scene.contact_method == "smooth":
        contact = _contact(scene, p, rod)
        terms.append(contact)
        if scene.friction is not None and scene.rubbing:
            terms.append(Friction(contact, p["friction"], _slip_speed(scene.friction, p)))
    if scene.contact_method == "spillmann_teschner":
        mass = _mass(scene, p, rod)
        nodes = mass[: 3 * topology.n_nodes : 3]
        pairs = touching_pairs(scene)
        terms.append(SpillmannTeschner(radius, nodes, jnp.zeros_like(mass), pairs))
    if scene.time.inertia or scene.time.scheme == "explicit":
        terms.append(Inertia(_mass(scene, p, rod)))
    if scene.gravity is not None:
        volume = _node_length(rod) * area
        buoyant = volume * (p["density"] - p["fluid_density"])
        terms.append(Gravity(buoyant, jnp.array(scene.gravity.acceleration)))
    return terms


def _contact(scene: SceneFile, p: dict[str, Array], rod: Rod) -> Contact:
    pairs = touching_pairs(scene)
    capacity = scene.contact.capacity or 3 * rod.topology.n_edges // 2
    return Contact(p["contact_stiffness"], p["rod_radius"], pairs, min(capacity, len(pairs.array)))


def _slip_speed(friction: FrictionTable, p: dict[str, Array]) -> Array:
    """m/s, below which friction is like drag."""
    if friction.slip_speed is not None:
        return jnp.array(friction.slip_speed)
    return SLIP * (2 * jnp.pi / 60) * jnp.max(jnp.abs(p["rpm"])) * p["rod_radius"]


def touching_pairs(scene: SceneFile) -> Indices:
    """The pairs of edges of a robot that can touch.

    Those between which there is less rod than pi r_0 cannot: a rod that bends back on itself
    as tightly as its thickness allows touches itself after half a turn of that radius.
    """
    with jax.ensure_compile_time_eval():
        body = _body(scene, {k: jnp.asarray(v) for k, v in scene.parameters.items()})
        start, end = body.topology.edge_nodes.T
        length = np.linalg.norm(np.asarray(body.nodes)[end] - np.asarray(body.nodes)[start], axis=1)
    pairs = pairs_apart(body.topology, length, np.pi * scene.robot.rod_radius)
    _check_apart(scene, np.asarray(body.nodes)[body.topology.edge_nodes], pairs)
    return pairs


def _check_apart(scene: SceneFile, edges: Float[np.ndarray, "e 2 3"], pairs: Indices) -> None:
    """Refuses a robot whose parts overlap from the start."""
    middle = edges.mean(axis=1)
    half = 0.5 * np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    first, second = pairs.array.T
    apart = np.linalg.norm(middle[first] - middle[second], axis=1) - half[first] - half[second]
    close = pairs.array[apart < 2 * scene.robot.rod_radius]
    if len(close) == 0:
        return
    with jax.ensure_compile_time_eval():
        nearest = float(distance(jnp.asarray(edges[close].reshape(-1, 4, 3))).min())
    if nearest < (1 - PENETRATION) * 2 * scene.robot.rod_radius:
        raise InputError(
            f"[robot]: two parts of the robot overlap at the start, their centre lines "
            f"{nearest:.3g} m apart and the rod {2 * scene.robot.rod_radius:.3g} m thick; "
            f"try a larger separation (now {scene.robot.separation:g} m) or other phases"
        )


LARGE = 150
"""Nodes from which on a robot is solved for in blocks, unless the scene file says otherwise."""

BLOCK = 16
"""Nodes of a block."""


def _layout(scene: SceneFile, topology: Topology) -> Layout | None:
    """The blocks of a robot that is solved for in blocks."""
    large = topology.n_nodes >= LARGE and scene.in_blocks
    method = scene.solver.method or ("blocks" if large else "dense")
    return Layout(topology, BLOCK) if method == "blocks" else None


def _stokeslets(
    scene: SceneFile, p: dict[str, Array], rod: Rod
) -> StokesletSegments | BlockStokeslets:
    filaments = rod.topology.filaments
    layout = _layout(scene, rod.topology)
    if layout is not None:
        viscosity, regularization = p["viscosity"], p["regularization"]
        return BlockStokeslets(viscosity, regularization, layout, scene.fluid.end_nodes)
    solved = filaments
    if scene.head_nodes == "dropped":
        solved = (tuple(range(rod.topology.n_nodes)),)
    return StokesletSegments(
        viscosity=p["viscosity"],
        regularization=p["regularization"],
        solved=solved,
        dragged=tuple(node for path in filaments for node in path),
        end_nodes=scene.fluid.end_nodes,
        drag_matrix=scene.fluid.drag_matrix,
    )


def _resistive(scene: SceneFile, p: dict[str, Array]) -> ResistiveDrag:
    law = {"gray_hancock": gray_hancock, "lighthill": lighthill}[scene.fluid.resistive]
    if scene.robot.shape == "helix":
        pitch, radius = p["pitch"], p["helix_radius"]
    else:  # no turns: the filament's length stands in for their pitch
        pitch, radius = p["axial_length"], jnp.zeros(())
    return ResistiveDrag(*law(p["viscosity"], pitch, p["rod_radius"], radius))


def _node_length(rod: Rod) -> Float[Array, " n"]:
    """Length of rod (m) that each node stands for."""
    length = jnp.zeros(rod.topology.n_nodes)
    return length.at[rod.topology.edge_nodes].add(0.5 * rod.rest_length[:, None])


def _mass(scene: SceneFile, p: dict[str, Array], rod: Rod) -> Float[Array, " d"]:
    """Mass (kg) of every position and polar moment of inertia (kg m^2) of every angle."""
    line_density = p["density"] * jnp.pi * p["rod_radius"] ** 2
    mass = line_density * _node_length(rod)
    if rod.topology.head is not None:
        head = scene.head.mass
        if head is None:
            head = 4 / 3 * jnp.pi * p["head_radius"] ** 3 * p["density"]
        mass = mass.at[rod.topology.head.node].set(head)
    polar = 0.5 * p["rod_radius"] ** 2 * line_density * rod.rest_length
    return jnp.concatenate([jnp.repeat(mass, 3), polar])


def _scheme(scene: SceneFile) -> Callable[[Scene, State, Array], Step]:
    if scene.contact_method == "spillmann_teschner":
        return corrected
    return {"trbdf2": trbdf2, "euler": euler, "explicit": euler}[scene.time.scheme]


def _control(scene: SceneFile, rod: Rod) -> Control | None:
    """Errors are measured in the radius of a circle as long as a flagellum, and in rad."""
    if scene.time.tolerance is None or scene.contact_method == "spillmann_teschner":
        return None
    topology = rod.topology
    contour = jnp.sum(rod.rest_length) / scene.robot.count / (2 * jnp.pi)
    position = np.arange(topology.n_dofs) < 3 * topology.n_nodes
    return Control(
        tolerance=jnp.asarray(scene.time.tolerance),
        scale=jnp.where(position, contour, 1.0),
        shortest=jnp.asarray(SHORTEST * scene.step),
        order=1 if scene.time.scheme == "euler" else 2,
    )


def _motor(scene: SceneFile, p: dict[str, Array], topology: Topology) -> Motor:
    """Rates by time and motor; one rate is that of every motor."""
    n_motors = len(topology.motors) + len(topology.spindles)
    if scene.motor_table is None:
        times, rate = (0.0,), jnp.broadcast_to(p["rpm"], (1, n_motors))
    else:
        times = scene.motor_table.time
        rate = jnp.broadcast_to(p["rpm"].reshape(len(times), -1), (len(times), n_motors))
    return Motor(jnp.array(times), rate * (2 * jnp.pi / 60))


def _newton(scene: SceneFile, p: dict[str, Array], rod: Rod) -> NewtonSettings:
    """Residuals are measured in EI / L^2, the force that bends a flagellum by its own length."""
    length = jnp.sum(rod.rest_length) / scene.robot.count
    bending = p["youngs_modulus"] * jnp.pi * p["rod_radius"] ** 4 / 4
    position = np.arange(rod.topology.n_dofs) < 3 * rod.topology.n_nodes
    force = jnp.where(position, bending / length**2, bending / length)
    return NewtonSettings(
        tolerance=jnp.asarray(scene.solver.tolerance),
        force_scale=force,
        size=jnp.where(position, 0.0, jnp.pi),
        max_iterations=scene.solver.max_iterations,
    )
