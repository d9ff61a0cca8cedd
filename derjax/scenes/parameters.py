"""The parameters of a scene: numbers that it can be differentiated with respect to.

Each is declared once, in the table of scene files where it stands; this module is the list of them.
"""

import re
from collections.abc import Callable
from typing import Any

from .ingredients import INGREDIENTS
from .ingredients.ingredient import Numbers, Parameter

PARAMETERS: dict[str, Parameter] = {
    parameter.name: parameter
    for table in INGREDIENTS.values()
    for parameter in table.PARAMETERS.values()
}
"""Those of derjax's own tables by name."""

PLACES: dict[str, str] = {
    parameter.name: f"{name}.{key}"
    for name, table in INGREDIENTS.items()
    for key, parameter in table.PARAMETERS.items()
}
"""Where each of them stands in a scene file: table and key."""

EACH: tuple[str, ...] = tuple(name for name, p in PARAMETERS.items() if p.each)
"""Those that may have a value for each flagellum or motor: `pitch[1]` is the second one's."""

_FOLLOWING: dict[str, Callable[[Numbers], Any]] = {
    name: p.follows for name, p in PARAMETERS.items() if p.follows is not None
}


def index_of(parameter: str) -> tuple[str, int | None]:
    """The name of a parameter without its index, and the index; None if it has none."""
    found = re.fullmatch(r"(.*)\[(\d+)\]", parameter)
    return (parameter, None) if found is None else (found[1], int(found[2]))


def place_of(parameter: str) -> tuple[str, str]:
    """Table and key of a parameter; those of extensions are named by both."""
    name, _ = index_of(parameter)
    table, _, key = PLACES.get(name, name).partition(".")
    return table, key


def completed(numbers: Numbers) -> dict[str, Any]:
    """`numbers` with what follows from the others wherever there is None.

    The numbers may be arrays that JAX traces: derivatives go through what follows.
    """
    return {k: _FOLLOWING[k](numbers) if v is None else v for k, v in numbers.items()}
