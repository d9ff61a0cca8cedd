"""What a design may be good at, and what it must keep to, by name.

A quantity is a function of a motion, or of the shape alone. Two of them, growth rates and rates at
which a robot buckles, come from eigenvalues, which are found on the host.
"""

import difflib
import runpy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from derjax import HeadDrag, InputError, Scene, positions
from derjax.results.bundling import closeness
from derjax.rods.head import head_axis

from .motion import Motion, Rest, RunMotion, SteadyMotion, size

Kind = Literal["own", "shape", "motion", "run", "eigenvalue"]
Direction = tuple[float, float, float]


@dataclass(frozen=True)
class Quantity:
    """One number of a design.

    Attributes:
        name: as in files.
        unit: as text, "1" for pure numbers.
        meaning: in a few words.
        kind: what it is made of: the shape at rest, any motion, a run in time, eigenvalues of a
            steady state; or a function of one's own.
        function: of a `Motion`; None for eigenvalues.
        needs: what the robot must have; see `NEEDS`.
    """

    name: str
    unit: str
    meaning: str
    kind: Kind
    function: Callable[[Any], Array] | None = None
    needs: tuple[str, ...] = ()


def _power(motion: Motion) -> Array:
    return jnp.mean(jnp.sum(motion.torques * motion.rates, axis=1))


def _torque(motion: Motion) -> Array:
    return jnp.mean(jnp.abs(motion.torques))


def _efficiency(motion: Motion) -> Array:
    return motion.thrust * motion.speed / _power(motion)


def _paper_efficiency(motion: Motion) -> Array:
    head = motion.scene[HeadDrag]
    return motion.thrust * head.radius / (head.spin * motion.head_rate)


def _energy(motion: RunMotion) -> Array:
    states = motion.run.states
    power = jnp.sum(RunMotion(motion.run, 0).torques * RunMotion(motion.run, 0).rates, axis=1)
    return jnp.trapezoid(power, states.time)


def _distance(motion: RunMotion) -> Array:
    path = motion.run.head_position
    return size(path[-1] - path[0])


def _clearance(motion: RunMotion) -> Array:
    scene, diameter = motion.scene, 2.0 * motion.scene.parameters["rod_radius"]
    apart = closeness(scene.rod.topology, motion.run.positions, diameter).minimum_distance
    return jnp.min(apart) - diameter


def _heading(motion: RunMotion, direction: Direction) -> Array:
    axis = jnp.mean(head_axis(motion.scene.rod.topology, motion.part), axis=0)
    return -axis @ _unit(direction) / size(axis)


def _distance_along(motion: RunMotion, direction: Direction) -> Array:
    path = motion.run.head_position
    return (path[-1] - path[0]) @ _unit(direction)


def _unit(direction: Direction) -> Array:
    return jnp.asarray(direction) / np.linalg.norm(direction)


def _contour_length(motion: Motion | Rest) -> Array:
    rod = motion.scene.rod
    return jnp.sum(rod.rest_length[rod.topology.edge_filaments >= 0])


def _mass(motion: Motion | Rest) -> Array:
    numbers = motion.scene.parameters
    return numbers["density"] * jnp.pi * numbers["rod_radius"] ** 2 * _contour_length(motion)


def _total_length(motion: Motion | Rest) -> Array:
    scene = motion.scene
    x = positions(scene.rod.topology, scene.start.q)[:, 0]
    head = scene.parameters.get("head_radius", jnp.zeros(()))
    return jnp.max(x) - jnp.min(x) + head


def _turn_gap(motion: Motion | Rest) -> Array:
    numbers = motion.scene.parameters
    around, pitch = 2 * jnp.pi * numbers["helix_radius"], numbers["pitch"]
    return jnp.min(pitch * around / jnp.hypot(around, pitch)) - 2.0 * numbers["rod_radius"]


HEAD, MOTOR = ("head",), ("motor",)

QUANTITIES: dict[str, Quantity] = {
    each.name: each
    for each in (
        Quantity("speed", "m/s", "of the head", "motion", lambda m: m.speed, HEAD),
        Quantity(
            "force",
            "N",
            "thrust: the drag on the head, or what a filament pushes its holder with",
            "motion",
            lambda m: m.thrust,
            ("thrust",),
        ),
        Quantity("torque", "N m", "of a motor, its mean", "motion", _torque, MOTOR),
        Quantity("power", "W", "of all motors together, its mean", "motion", _power, MOTOR),
        Quantity("head_rate", "rad/s", "of the head", "motion", lambda m: m.head_rate, HEAD),
        Quantity(
            "efficiency",
            "1",
            "Purcell's: drag on the head times speed, over the power of the motors",
            "motion",
            _efficiency,
            HEAD + MOTOR,
        ),
        Quantity(
            "paper_efficiency",
            "1",
            "that of Lim, Yadunandan & Jawed (2023): drag on the head times its radius, over the "
            "torque that turns it",
            "motion",
            _paper_efficiency,
            HEAD,
        ),
        Quantity("contour_length", "m", "of all flagella", "shape", _contour_length),
        Quantity("mass", "kg", "of all flagella", "shape", _mass, ("density",)),
        Quantity("total_length", "m", "of the robot at rest", "shape", _total_length),
        Quantity(
            "turn_gap",
            "m",
            "between the surfaces of neighbouring turns of a helix at rest",
            "shape",
            _turn_gap,
            ("helix",),
        ),
        Quantity(
            "distance", "m", "from the head's first place to its last", "run", _distance, HEAD
        ),
        Quantity("energy", "J", "that the motors spend in the run", "run", _energy, MOTOR),
        Quantity(
            "clearance",
            "m",
            "between the surfaces of different flagella, the smallest in the run",
            "run",
            _clearance,
            ("flagella",),
        ),
        Quantity(
            "growth_rate",
            "1/s",
            "of the mode that grows fastest: below zero a steady state is stable",
            "eigenvalue",
        ),
        Quantity(
            "buckling_rpm",
            "rpm",
            "at which the steady state loses its stability",
            "eigenvalue",
        ),
    )
}
"""All that have a name, but for those that need a direction."""

DIRECTED: dict[str, tuple[str, str, Callable[[RunMotion, Direction], Array]]] = {
    "distance": ("m", "by which the head moves along the direction", _distance_along),
    "heading": ("1", "cosine of the angle between the way ahead and the direction", _heading),
}
"""Those that depend on a direction: unit, meaning and function."""

NEEDS: dict[str, tuple[str, Callable[[Scene], bool]]] = {
    "head": ("a head with drag", lambda s: _heads(s) == 1),
    "motor": ("a motor", lambda s: s.motor is not None),
    "thrust": (
        "a head, or a filament that is held and turned",
        lambda s: _heads(s) == 1 or bool(s.rod.topology.driven_edges),
    ),
    "flagella": ("two flagella or more", lambda s: len(s.rod.topology.filaments) > 1),
    "helix": ("helices", lambda s: "pitch" in s.parameters),
    "density": ("[material] density, with inertia or gravity", lambda s: "density" in s.parameters),
}
"""What a robot must have for a quantity, in words, and whether it has."""


def _heads(scene: Scene) -> int:
    return sum(isinstance(term, HeadDrag) for term in scene.terms)


def named(name: str, scene: Scene, direction: Direction | None = None) -> Quantity:
    """A quantity by its name.

    Raises:
        InputError: there is none, or it needs what the robot does not have.
    """
    if direction is not None:
        if name not in DIRECTED:
            raise InputError(f"{name}: has no direction; {', '.join(DIRECTED)} have")
        if not np.any(direction):
            raise InputError("direction = [0, 0, 0]: is no direction")
        unit, meaning, function = DIRECTED[name]
        found = Quantity(name, unit, meaning, "run", lambda m: function(m, direction), HEAD)
    elif name in QUANTITIES:
        found = QUANTITIES[name]
    elif name in DIRECTED:
        raise InputError(f"{name}: needs a direction, as direction = [-1, 0, 0]")
    else:
        near = difflib.get_close_matches(name, QUANTITIES, 1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        known = ", ".join([*QUANTITIES, "heading"])
        raise InputError(f"no quantity {name!r}; {hint}There are {known}, and FILE.py:FUNCTION")
    for need in found.needs:
        said, has = NEEDS[need]
        if not has(scene):
            raise InputError(f"{name}: needs {said}, which the robot does not have")
    return found


def from_function(function: Callable[[Any], Any], name: str) -> Quantity:
    """The quantity that a function of a `derjax.Steady`, `Run` or `Scene` returns."""

    def of_motion(motion: SteadyMotion | RunMotion | Rest) -> Array:
        try:
            found = jnp.asarray(function(motion.given))
        except jax.errors.JAXTypeError as error:
            raise InputError(
                f"{name}: is not differentiable as it stands: it needs the value of a number that "
                "JAX traces. Use jax.numpy in place of numpy, float, if and max"
            ) from error
        except Exception as error:
            raise InputError(f"{name}: {type(error).__name__}: {error}") from error
        if found.shape != ():
            raise InputError(f"{name}: must return one number, not an array of {found.shape}")
        return found.astype(float)

    return Quantity(name, "1", "a function of one's own", "own", of_motion)


def from_file(text: str, folder: Path) -> Quantity:
    """The quantity that a function in a Python file returns; `text` is "FILE.py:FUNCTION".

    Raises:
        InputError: there is no such file or function, or the file fails.
    """
    place, _, name = text.rpartition(":")
    path = folder / place
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        function = runpy.run_path(str(path)).get(name)
    except Exception as error:
        raise InputError(f"{path}: {type(error).__name__}: {error}") from error
    if not callable(function):
        raise InputError(f"{path}: has no function {name!r}")
    return from_function(function, text)
