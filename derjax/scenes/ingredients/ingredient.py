"""What every table of scene files says of itself: keys, parameters, and terms of a scene."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from jaxtyping import Array

from ...core.pytree import Indices
from ...io.fields import Positive, Table
from ...rods.rod import Rod
from ...shapes import RobotGeometry
from ...solve.blocks import Layout
from ...terms.term import Term

PerFlagellum = Positive | tuple[Positive, ...]
"""One number for all flagella, or a list with one for each."""

SceneFile = Any
"""A `scenes.file.SceneFile`, which is made of these tables and so stands above them."""

Numbers = Mapping[str, Any]
"""Parameters of a scene by name; they may be arrays that JAX traces."""


def always(file: SceneFile) -> bool:
    """Every scene has the parameter."""
    return True


@dataclass(frozen=True)
class Parameter:
    """A number of a scene that one may differentiate with respect to.

    Attributes:
        name: by which `scene.replace`, sweeps and fits know it.
        unit: as text, "1" for pure numbers.
        each: whether it may have a value for each flagellum or motor.
        when: whether a scene has it.
        follows: what it is where the file does not give it, as a smooth function of the others.
    """

    name: str
    unit: str
    each: bool = False
    when: Callable[[SceneFile], bool] = always
    follows: Callable[[Numbers], Any] | None = None


@dataclass(frozen=True)
class Idle:
    """When some keys of a table have no effect.

    Attributes:
        keys: of the table.
        when: whether that is so in a scene.
        reason: what follows "has no effect".
    """

    keys: tuple[str, ...]
    when: Callable[[SceneFile], bool]
    reason: Callable[[SceneFile], str]


@dataclass(frozen=True)
class Setting:
    """What a table is told when it adds its terms to a scene.

    Attributes:
        file: the whole scene file.
        numbers: its parameters, or those that replace them, as arrays.
        rod: of the robot.
        geometry: of the robot.
        pairs: (p, 2) the edges that may touch; None if rods are not kept apart.
        layout: the blocks of a robot that is solved for in blocks.
    """

    file: SceneFile
    numbers: Mapping[str, Array]
    rod: Rod
    geometry: RobotGeometry
    pairs: Indices | None
    layout: Layout | None


class Ingredient(Table):
    """A table of scene files: immutable, with strict keys.

    Attributes:
        PARAMETERS: which of the keys are parameters of the scene.
        IDLE: which of the keys have no effect, and when.
    """

    PARAMETERS: ClassVar[Mapping[str, Parameter]] = {}
    IDLE: ClassVar[tuple[Idle, ...]] = ()

    def terms(self, setting: Setting) -> Iterable[Term]:
        """The physical ingredients that the table stands for: none, for most."""
        return ()


def has_value(table: str, key: str) -> Callable[[SceneFile], str]:
    """The reason that a key has the value which it has."""

    def reason(file: SceneFile) -> str:
        value = getattr(getattr(file, table), key)
        shown = str(value).lower() if isinstance(value, bool) else f"{value!r}"
        return f"with [{table}] {key} = {shown}"

    return reason


def because(text: str) -> Callable[[SceneFile], str]:
    """A reason that is the same in all scenes."""
    return lambda file: text


def contact_method(file: SceneFile) -> str:
    """The reason that is the way in which rods are kept apart."""
    return f"with [contact] method = {file.contact_method!r}"


def is_headless(file: SceneFile) -> bool:
    """Whether the robot has no head."""
    return file.robot.kind == "clamped"


def is_weightless(file: SceneFile) -> bool:
    """Whether no mass matters, be it for inertia or for weight."""
    explicit = file.time.scheme == "explicit"
    inert = file.time.inertia or explicit or file.contact_method == "spillmann_teschner"
    return file.gravity is None and not inert


def of_each(given: float | tuple[float, ...], count: int) -> tuple[float, ...]:
    """What is given for each flagellum, or for all."""
    return given if isinstance(given, tuple) else (given,) * count


def flagella_in_words(count: int) -> str:
    """ "1 flagellum", "2 flagella"."""
    return "1 flagellum" if count == 1 else f"{count} flagella"
