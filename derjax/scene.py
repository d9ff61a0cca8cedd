"""From a scene file to the terms that it names: the registry of physical ingredients."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .motor import Motor
from .newton import NewtonSettings
from .robots import Body, edge_count, single_flagellum
from .rod import Rod, State, at_rest
from .scenefile import SceneFile
from .step import Scene
from .terms.bend import Bend
from .terms.gravity import Gravity
from .terms.head import HeadDrag
from .terms.inertia import Inertia
from .terms.lagged import Lagged
from .terms.resistive import ResistiveDrag, gray_hancock, lighthill
from .terms.stokeslets import StokesletSegments
from .terms.stretch import Stretch
from .terms.term import Term
from .terms.twist import Twist

Parameters = Mapping[str, Any]


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
    """
    known = scene.parameters
    for name in parameters or {}:
        if name not in known:
            raise KeyError(f"no parameter {name!r}; the scene has {', '.join(known)}")
    numbers = {**known, **(parameters or {})}
    return _build(scene, {name: jnp.asarray(value, float) for name, value in numbers.items()})


@partial(jax.jit, static_argnums=0)  # as one program: quicker than operation by operation
def _build(scene: SceneFile, p: dict[str, Array]) -> tuple[Scene, State]:
    body = _body(scene, p)
    rod, state = at_rest(body.topology, body.nodes)
    built = Scene(
        rod=rod,
        terms=tuple(_terms(scene, p, rod)),
        motor=_motor(scene, p),
        newton=_newton(scene, p, rod),
        step_length=jnp.asarray(scene.time.step),
    )
    return built, state


def _body(scene: SceneFile, p: dict[str, Array]) -> Body:
    robot = scene.robot
    n_edges = edge_count(robot.helix_radius, robot.pitch, robot.axial_length, robot.edge_length)
    return single_flagellum(
        p["helix_radius"], p["pitch"], p["axial_length"], n_edges, robot.handedness
    )


def _terms(scene: SceneFile, p: dict[str, Array], rod: Rod) -> list[Term]:
    """The terms of a scene. A new ingredient is registered here and nowhere else."""
    topology, fluid = rod.topology, scene.fluid
    radius, modulus = p["rod_radius"], p["youngs_modulus"]
    area, inertia = jnp.pi * radius**2, jnp.pi * radius**4 / 4
    shear = modulus / (2 * (1 + p["poisson_ratio"]))
    n_edges, n_hinges = topology.n_edges, len(topology.hinges)
    terms: list[Term] = [
        Stretch(jnp.full(n_edges, modulus * area)),
        Bend(jnp.full(n_hinges, modulus * inertia)),
        Twist(jnp.full(n_hinges, 2 * shear * inertia)),
    ]
    if scene.head.drag == "stokes":
        viscosity, size = p["viscosity"], p["head_radius"]
        spin = 8 * jnp.pi * viscosity * size**3 * p["C_r"]
        tilt = spin if scene.head.rotation == "full" else jnp.zeros(())
        terms.append(HeadDrag(6 * jnp.pi * viscosity * size * p["C_t"], spin, tilt))
    if fluid.hydrodynamics != "none":
        drag = _stokeslets(scene, p, rod) if fluid.hydrodynamics == "rss" else _resistive(scene, p)
        terms.append(Lagged(drag) if scene.time.scheme == "explicit" else drag)
    if scene.time.inertia or scene.time.scheme == "explicit":
        terms.append(Inertia(_mass(scene, p, rod)))
    if scene.gravity is not None:
        volume = _node_length(rod) * area
        buoyant = volume * (p["density"] - p["fluid_density"])
        terms.append(Gravity(buoyant, jnp.array(scene.gravity.acceleration)))
    return terms


def _stokeslets(scene: SceneFile, p: dict[str, Array], rod: Rod) -> StokesletSegments:
    filaments = rod.topology.filaments
    solved = filaments
    if scene.fluid.head_nodes_resolved == "dropped":
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
    return ResistiveDrag(*law(p["viscosity"], p["pitch"], p["rod_radius"], p["helix_radius"]))


def _node_length(rod: Rod) -> Float[Array, " n"]:
    """Length of rod (m) that each node stands for."""
    length = jnp.zeros(rod.topology.n_nodes)
    return length.at[rod.topology.edge_nodes].add(0.5 * rod.rest_length[:, None])


def _mass(scene: SceneFile, p: dict[str, Array], rod: Rod) -> Float[Array, " d"]:
    """Mass (kg) of every position and polar moment of inertia (kg m^2) of every angle."""
    line_density = p["density"] * jnp.pi * p["rod_radius"] ** 2
    mass = line_density * _node_length(rod)
    head = scene.head.mass
    if head is None:
        head = 4 / 3 * jnp.pi * p["head_radius"] ** 3 * p["density"]
    if rod.topology.head_edge is not None:
        mass = mass.at[rod.topology.edges[rod.topology.head_edge][0]].set(head)
    polar = 0.5 * p["rod_radius"] ** 2 * line_density * rod.rest_length
    return jnp.concatenate([jnp.repeat(mass, 3), polar])


def _motor(scene: SceneFile, p: dict[str, Array]) -> Motor:
    rate = jnp.atleast_1d(p["rpm"])[:, None] * (2 * jnp.pi / 60)
    times = (0.0,) if scene.motor_table is None else scene.motor_table.time
    return Motor(jnp.array(times), rate)


def _newton(scene: SceneFile, p: dict[str, Array], rod: Rod) -> NewtonSettings:
    """Residuals are measured in EI / L^2, the force that bends the rod by its own length."""
    length = jnp.sum(rod.rest_length)
    bending = p["youngs_modulus"] * jnp.pi * p["rod_radius"] ** 4 / 4
    position = np.arange(rod.topology.n_dofs) < 3 * rod.topology.n_nodes
    force = jnp.where(position, bending / length**2, bending / length)
    return NewtonSettings(
        tolerance=jnp.asarray(scene.solver.tolerance),
        force_scale=force,
        max_iterations=scene.solver.max_iterations,
    )
