"""Physical ingredients of other packages, which scene files may name like derjax's own.

A package that has one declares it as an entry point,

    [project.entry-points."derjax.terms"]
    trap = "my_package:Trap"

where `Trap` derives from `Extension`. Once the package is installed, scene files may have a table
[trap]; its numbers are parameters of the scene, `trap.stiffness`, for sweeps, fits and derivatives.
"""

from collections.abc import Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, ClassVar

from jaxtyping import Array

from ..core.errors import InputError
from ..rods.rod import Rod
from ..terms.term import Term
from .ingredients.ingredient import Ingredient
from .parameters import PARAMETERS, index_of

GROUP = "derjax.terms"
"""Of the entry points."""


class Extension(Ingredient):
    """A table of scene files that another package owns, and what makes its term.

    A pydantic model: keys with annotations, checked as those of derjax are.

    Attributes:
        NUMBERS: which of the keys are parameters of the scene, and in which units.
    """

    NUMBERS: ClassVar[Mapping[str, str]] = {}

    def term(self, numbers: Mapping[str, Array], rod: Rod) -> Term:
        """The term of a scene.

        Args:
            numbers: of the keys that are parameters, as JAX may trace them.
            rod: of the robot.
        """
        raise NotImplementedError(f"{type(self).__name__} makes no term")


@cache
def _declared() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


def extension_names() -> tuple[str, ...]:
    """The tables that installed packages add to scene files."""
    return tuple(_declared())


@cache
def extension(name: str) -> type[Extension]:
    """The class of a table.

    Raises:
        InputError: it cannot be imported, or is no `Extension`.
    """
    point = _declared()[name]
    package = "" if point.dist is None else f" of the package {point.dist.name}"
    try:
        found = point.load()
    except Exception as error:  # whatever a foreign module raises while it is imported
        raise InputError(
            f"[{name}]: the entry point {point.value!r}{package} cannot be imported: "
            f"{type(error).__name__}: {error}"
        ) from error
    if not (isinstance(found, type) and issubclass(found, Extension)):
        raise InputError(
            f"[{name}]: the entry point {point.value!r}{package} is no derjax Extension"
        )
    return found


def forget() -> None:
    """Look for installed packages anew."""
    _declared.cache_clear()
    extension.cache_clear()


def unit_of(parameter: str) -> str:
    """The unit of a parameter of a scene, or of a key by table and name; "1" if none is known."""
    name, _ = index_of(parameter)
    if name in PARAMETERS:
        return PARAMETERS[name].unit
    table, _, key = name.partition(".")
    if table in extension_names():
        return extension(table).NUMBERS.get(key, "1")
    return PARAMETERS[key].unit if key in PARAMETERS else "1"


def template() -> str:
    """The tables of extensions, commented out, for a new scene file; empty if there are none."""
    lines: list[str] = []
    for name in extension_names():
        kind = extension(name)
        lines += ["", f"# [{name}]   # {(kind.__doc__ or '').strip().splitlines()[0]}"]
        for key, field in kind.model_fields.items():
            default: Any = "..." if field.is_required() else field.default
            unit = f"   # {kind.NUMBERS[key]}" if key in kind.NUMBERS else ""
            lines.append(f"# {key} = {default!r}{unit}")
    return "\n".join([*lines, ""]) if lines else ""
