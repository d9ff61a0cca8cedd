"""From a scene file to a scene: the terms of its tables, and what integrates them."""

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array

from ..core.errors import InputError
from ..core.programs import stored
from ..core.pytree import Indices, replace
from ..integrate.provenance import check_sums
from ..integrate.step import Scene
from ..rods.rod import at_rest
from ..shapes.numbers import library_of
from .file import SceneFile
from .ingredients.ingredient import Setting
from .parameters import index_of, place_of
from .shape import geometry_of, touching_pairs

Parameters = Mapping[str, Any]


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
    every = scene.parameters_with(given)
    numbers = {name: library_of(value).asarray(value, float) for name, value in every.items()}
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

    def fingerprint(self) -> str:
        """What it means to a program; see `core.fingerprint`."""
        return self._key

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


@partial(stored, static=(0, 1))  # as one program: quicker than operation by operation
def _build(scene: SceneFile, pairs: Indices | None, p: dict[str, Array]) -> Scene:
    geometry = geometry_of(scene, p)
    rod, state = at_rest(geometry.topology, geometry.nodes)
    layout = scene.solver.layout(scene, rod.topology)
    setting = Setting(scene, p, rod, geometry, pairs, layout)
    terms = [term for table in scene.ingredients for term in table.terms(setting)]
    for name, table in scene.extensions:
        terms.append(table.term({key: p[f"{name}.{key}"] for key in table.NUMBERS}, rod))
    made = Scene(
        rod=rod,
        terms=tuple(terms),
        motor=scene.motor.motor(setting),
        newton=scene.solver.newton(setting),
        step_length=jnp.asarray(scene.step),
        scheme=scene.time.stepping(setting),
        control=scene.time.controller(setting),
        layout=layout,
        parameters=p,
        check_sums=check_sums(terms),
        initial=state,
    )
    # To JAX numbers of Python are "weakly typed"; it would compile anew for scenes with other ones.
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.result_type(leaf)), made)
