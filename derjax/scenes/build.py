"""From a scene file to the terms that it names: the registry of physical ingredients."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..core.errors import InputError
from ..core.pytree import Indices, replace
from ..core.status import SolverError
from ..integrate.motor import Motor
from ..integrate.provenance import check_sums
from ..integrate.schemes.contact_corrected import contact_corrected_euler
from ..integrate.schemes.euler import euler
from ..integrate.schemes.trbdf2 import trbdf2
from ..integrate.step import Scene, Step
from ..integrate.step_size import StepSizeController
from ..rods.rod import Rod, State, Topology, at_rest
from ..solve.blocks import Layout
from ..solve.newton import NewtonSettings
from ..terms.contact.friction import Friction
from ..terms.contact.repulsion import Contact
from ..terms.contact.spillmann_teschner import SpillmannTeschner
from ..terms.elastic.bend import Bend
from ..terms.elastic.stretch import Stretch
from ..terms.elastic.twist import Twist
from ..terms.fluid.block_stokeslets import BlockStokeslets
from ..terms.fluid.explicit import ExplicitDrag
from ..terms.fluid.head import HeadDrag
from ..terms.fluid.resistive import ResistiveDrag, gray_hancock, lighthill
from ..terms.fluid.spin import SpinDrag
from ..terms.fluid.stokeslets import StokesletSegments
from ..terms.gravity import Gravity
from ..terms.inertia import Inertia
from ..terms.term import Term
from .defaults import SLIP
from .file import SceneFile
from .parameters import index_of, place_of
from .shape import body_of, touching_pairs
from .tables import FrictionTable

Parameters = Mapping[str, Any]

SHORTEST = 1e-6
"""The shortest that steps that adapt may become, over the first."""


def build(scene: SceneFile, parameters: Parameters | None = None) -> Scene:
    """The scene that a file describes; its `start` is the robot at rest.

    A smooth function of `parameters`, so that a rollout may be differentiated with respect to
    any of them. The number of nodes, steps and frames are those of the file's own numbers.

    Parameters are checked as if they stood in the file. Where JAX traces one of them, as under
    `jax.jit`, `jax.grad` or `jax.vmap`, they are not known and cannot be checked, and the pairs of
    edges that may touch are those of the file's own dimensions.

    Args:
        scene: the checked file; its choices decide which terms there are.
        parameters: numbers that replace those of the file, by the keys of
            `scene.parameters`, in the same units.

    Raises:
        KeyError: a parameter that the scene does not have.
        InputError: a number that cannot be, or parts of the robot that must not touch overlap at
            the start.
    """
    given = dict(parameters or {})
    scene.check_names(given)
    given = scene.whole(given)
    if not given or any(isinstance(value, Tracer) for value in jax.tree.leaves(given)):
        return build_unchecked(scene, given)
    _check_numbers(scene, given)
    return _assembled(scene, given, scene.parameters_with(given))


def build_unchecked(scene: SceneFile, parameters: Parameters) -> Scene:
    """`build`, with parameters that are not checked: as if JAX traced them.

    Raises:
        KeyError: a parameter that the scene does not have.
        InputError: parts of the robot of the file itself overlap.
    """
    scene.check_names(parameters)
    return _assembled(scene, scene.whole(parameters), scene.parameters)


def _assembled(scene: SceneFile, given: Parameters, shape: Parameters) -> Scene:
    """The scene with some parameters given; those of `shape` say which edges may touch."""
    pairs = touching_pairs(scene, shape) if scene.touching else None
    numbers = {
        name: jnp.asarray(value, float) for name, value in scene.parameters_with(given).items()
    }
    return replace(_build(scene, pairs, numbers), source=Source(scene, given))


class Source:
    """The file that a scene was built from, and which parameters were given in its place.

    Part of the structure of scenes: compared without the values of parameters, which scenes have
    as leaves of their own, so that scenes that differ in those alone share compiled programs.

    Attributes:
        file: the scene file.
        given: those parameters that replaced others which in the file follow from the rest.
    """

    def __init__(self, file: SceneFile, given: Iterable[str]) -> None:
        self.file = file
        self.given = frozenset(name for name in given if file.given[name] is None)
        content = file.model_dump(mode="json")
        for name in file.parameters:
            table, key = place_of(name)
            if content[table][key] is not None:  # None: it follows from the others
                content[table][key] = "a number"
        times = file.motor_table and file.motor_table.time
        self._key = str((content, times, sorted(self.given)))
        self._hash = hash(self._key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Source) and self._key == other._key

    def __repr__(self) -> str:
        return f"Source({self.file.robot.kind})"

    def rebuilt(self, scene: Scene, changes: Parameters) -> Scene:
        """The scene with other parameters; see `Scene.replace`."""
        self.file.check_names(changes)
        open_ = {name for name, value in self.file.given.items() if value is None} - self.given
        kept = {name: value for name, value in scene.parameters.items() if name not in open_}
        new = build(self.file, {**kept, **changes})
        return replace(
            new,
            terms=(*new.terms, *scene.terms[len(new.terms) :]),
            source=Source(self.file, self.given | {index_of(name)[0] for name in changes}),
        )


def _check_numbers(scene: SceneFile, given: Parameters) -> None:
    """Refuses numbers that could not stand in the file."""
    changed = scene.with_parameters(given)
    if scene.in_blocks and not changed.in_blocks and scene.solver.method != "dense":
        raise InputError(
            f"[fluid] regularization = {changed.regularization:g}: too large for blocks, in which "
            "a robot of many nodes is solved for; give it in the scene file"
        )


def enlarge(scene: Scene) -> Scene:
    """The scene with room for twice as many contacts at one time.

    Raises:
        SolverError: no term has a list that could be longer.
    """
    terms = tuple(term.enlarged() for term in scene.terms)
    if jax.tree.structure(terms) == jax.tree.structure(scene.terms):
        names = ", ".join(type(term).__name__ for term in scene.terms)
        raise SolverError(
            f"a list of fixed length is full, and none of the terms can have a longer one: {names}"
        )
    return replace(scene, terms=terms)


@partial(jax.jit, static_argnums=(0, 1))  # as one program: quicker than operation by operation
def _build(scene: SceneFile, pairs: Indices | None, p: dict[str, Array]) -> Scene:
    body = body_of(scene, p)
    rod, state = at_rest(body.topology, body.nodes)
    terms = tuple(_terms(scene, p, rod, body.stiff_hinges, pairs))
    return Scene(
        rod=rod,
        terms=terms,
        motor=_motor(scene, p, rod.topology),
        newton=_newton(scene, p, rod),
        step_length=jnp.asarray(scene.step),
        scheme=_scheme(scene),
        control=_control(scene, rod),
        layout=_layout(scene, rod.topology),
        parameters=p,
        check_sums=check_sums(terms),
        initial=state,
    )


def _terms(
    scene: SceneFile,
    p: dict[str, Array],
    rod: Rod,
    stiff_hinges: Sequence[int],
    pairs: Indices | None,
) -> list[Term]:
    """The terms of a scene. A new ingredient is registered here and nowhere else.

    Args:
        scene: what there is.
        p: its numbers.
        rod: of the robot.
        stiff_hinges: hinges of the arms of a head.
        pairs: the edges that may touch; None if rods are not kept apart.
    """
    topology, fluid = rod.topology, scene.fluid
    radius, modulus = p["rod_radius"], p["youngs_modulus"]
    area, inertia = jnp.pi * radius**2, jnp.pi * radius**4 / 4
    relative = np.ones(len(topology.hinges))
    relative[list(stiff_hinges)] = scene.head.stiffness
    of_hinges = _of_hinges(topology, modulus)
    shear = of_hinges / (2 * (1 + p["poisson_ratio"]))
    terms: list[Term] = [
        Stretch(jnp.broadcast_to(_of_edges(topology, modulus) * area, topology.n_edges)),
        Bend(of_hinges * inertia * relative),
        Twist(2 * shear * inertia * relative),
    ]
    if topology.head is not None and scene.head.drag == "stokes":
        viscosity, size = p["viscosity"], p["head_radius"]
        spin = 8 * jnp.pi * viscosity * size**3 * p["C_r"]
        tilt = spin if scene.head_rotation == "full" else jnp.zeros(())
        terms.append(HeadDrag(6 * jnp.pi * viscosity * size * p["C_t"], spin, tilt, size))
    if fluid.hydrodynamics != "none":
        drag = _stokeslets(scene, p, rod) if fluid.hydrodynamics == "rss" else _resistive(scene, p)
        terms.append(ExplicitDrag(drag) if scene.time.scheme == "explicit" else drag)
    if fluid.spin_drag:
        terms.append(SpinDrag(4 * jnp.pi * p["viscosity"] * radius**2))
    if pairs is not None and scene.contact_method == "smooth":
        terms.append(_contact(scene, p, rod, pairs))
        if scene.friction is not None and scene.rubbing:
            terms.append(Friction(p["friction"], _slip_speed(scene.friction, p)))
    if pairs is not None and scene.contact_method == "spillmann_teschner":
        mass = _mass(scene, p, rod)
        nodes = mass[: 3 * topology.n_nodes : 3]
        terms.append(SpillmannTeschner(radius, nodes, jnp.zeros_like(mass), pairs))
    if scene.time.inertia or scene.time.scheme == "explicit":
        terms.append(Inertia(_mass(scene, p, rod)))
    if scene.gravity is not None:
        acceleration = jnp.array(scene.gravity.acceleration)
        terms.append(Gravity(_buoyant_mass(scene, p, rod), acceleration))
    for name, table in scene.extensions:
        terms.append(table.term({key: p[f"{name}.{key}"] for key in table.NUMBERS}, rod))
    return terms


def _of_edges(topology: Topology, each: Array) -> Array:
    """A number of each flagellum as one of each edge; that of the head's edges is the mean."""
    if each.ndim == 0:
        return each
    flagellum = topology.edge_filaments
    return jnp.where(flagellum >= 0, each[flagellum], jnp.mean(each))


def _of_hinges(topology: Topology, each: Array) -> Array:
    """A number of each flagellum as one of each hinge, that of those of its edges."""
    if each.ndim == 0:
        return each
    inside = (topology.edge_filaments >= 0)[topology.hinge_edges].astype(float)
    inside[inside.sum(axis=1) == 0] = 1.0
    weight = inside / inside.sum(axis=1, keepdims=True)
    return jnp.sum(weight * _of_edges(topology, each)[topology.hinge_edges], axis=1)


def _contact(scene: SceneFile, p: dict[str, Array], rod: Rod, pairs: Indices) -> Contact:
    capacity = scene.contact.capacity or 3 * rod.topology.n_edges // 2
    return Contact(p["contact_stiffness"], p["rod_radius"], pairs, min(capacity, len(pairs.array)))


def _slip_speed(friction: FrictionTable, p: dict[str, Array]) -> Array:
    """m/s, below which friction is like drag."""
    if friction.slip_speed is not None:
        return jnp.array(friction.slip_speed)
    return SLIP * (2 * jnp.pi / 60) * jnp.max(jnp.abs(p["rpm"])) * p["rod_radius"]


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
        mass = mass.at[rod.topology.head.node].set(_head_mass(scene, p))
    polar = 0.5 * p["rod_radius"] ** 2 * line_density * rod.rest_length
    return jnp.concatenate([jnp.repeat(mass, 3), polar])


def _head_volume(p: dict[str, Array]) -> Array:
    """m^3, of a ball."""
    return 4 / 3 * jnp.pi * p["head_radius"] ** 3


def _head_mass(scene: SceneFile, p: dict[str, Array]) -> Array:
    """kg; by default that of a ball of the material."""
    if scene.head.mass is not None:
        return jnp.asarray(scene.head.mass)
    return _head_volume(p) * p["density"]


def _buoyant_mass(scene: SceneFile, p: dict[str, Array], rod: Rod) -> Float[Array, " n"]:
    """Mass (kg) of every node less that of the fluid in its place.

    The head stands for itself and for the rod within, as it does in `_mass`.
    """
    area = jnp.pi * p["rod_radius"] ** 2
    mass = _node_length(rod) * area * (p["density"] - p["fluid_density"])
    if rod.topology.head is None:
        return mass
    volume = _head_volume(p)
    if scene.head.mass is None:  # so written, it is exactly neutral in a fluid as dense
        head = volume * (p["density"] - p["fluid_density"])
    else:
        head = scene.head.mass - volume * p["fluid_density"]
    return mass.at[rod.topology.head.node].set(head)


def _scheme(scene: SceneFile) -> Callable[[Scene, State, Array], Step]:
    if scene.contact_method == "spillmann_teschner":
        return contact_corrected_euler
    return {"trbdf2": trbdf2, "euler": euler, "explicit": euler}[scene.time.scheme]


def _control(scene: SceneFile, rod: Rod) -> StepSizeController | None:
    """Errors are measured in the radius of a circle as long as a flagellum, and in rad."""
    if scene.time.tolerance is None or scene.contact_method == "spillmann_teschner":
        return None
    topology = rod.topology
    contour = jnp.sum(rod.rest_length) / scene.robot.count / (2 * jnp.pi)
    position = np.arange(topology.n_dofs) < 3 * topology.n_nodes
    return StepSizeController(
        tolerance=jnp.asarray(scene.time.tolerance),
        scale=jnp.where(position, contour, 1.0),
        shortest=jnp.asarray(SHORTEST * scene.step),
        order=1 if scene.time.scheme == "euler" else 2,
    )


def _motor(scene: SceneFile, p: dict[str, Array], topology: Topology) -> Motor:
    """Rates by time and motor; one rate is that of every motor."""
    n_motors = len(topology.motors) + len(topology.driven_edges)
    if scene.motor_table is None:
        times, rate = (0.0,), jnp.broadcast_to(p["rpm"], (1, n_motors))
    else:
        times = scene.motor_table.time
        rate = jnp.broadcast_to(p["rpm"].reshape(len(times), -1), (len(times), n_motors))
    return Motor(jnp.array(times), rate * (2 * jnp.pi / 60))


def _newton(scene: SceneFile, p: dict[str, Array], rod: Rod) -> NewtonSettings:
    """Residuals are measured in EI / L^2, the force that bends a flagellum by its own length."""
    length = jnp.sum(rod.rest_length) / scene.robot.count
    bending = jnp.mean(p["youngs_modulus"]) * jnp.pi * p["rod_radius"] ** 4 / 4
    position = np.arange(rod.topology.n_dofs) < 3 * rod.topology.n_nodes
    force = jnp.where(position, bending / length**2, bending / length)
    return NewtonSettings(
        tolerance=jnp.asarray(scene.solver.tolerance),
        force_scale=force,
        size=jnp.where(position, 0.0, jnp.pi),
        max_iterations=scene.solver.max_iterations,
    )
