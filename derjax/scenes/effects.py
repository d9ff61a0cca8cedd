"""Which keys of a scene file have no effect.

A key of a model that is not chosen has none. It is no error, as one may try a model and go
back, but one should be told. Every table says so of its own keys (`Ingredient.IDLE`).
"""

from collections.abc import Mapping
from typing import Any

from .ingredients import INGREDIENTS
from .ingredients.ingredient import SceneFile


def idle_keys(scene: SceneFile, content: Mapping[str, Any]) -> dict[str, str]:
    """The keys of a scene file that have no effect, and why.

    Args:
        scene: the checked file.
        content: its tables.

    Returns:
        Sentences without the name of the file, by table and key.
    """
    found: dict[str, str] = {}
    for table, given in content.items():
        if table not in INGREDIENTS or not isinstance(given, Mapping):
            continue
        for idle in INGREDIENTS[table].IDLE:
            for key in idle.keys:
                name = f"{table}.{key}"
                if key in given and name not in found and idle.when(scene):
                    reason = idle.reason(scene).replace(f"with [{table}] ", "with ")
                    found[name] = f"[{table}] {key}: has no effect {reason}"
    return found
