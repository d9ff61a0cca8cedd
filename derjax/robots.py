"""Scene files of the robots from Python: their dimensions by keyword, everything else as usual.

    file = derjax.robots.two_flagella(pitch=0.0318, rpm=60)

takes the parameters of a scene by name (`pitch`, `youngs_modulus`, `C_t`, `rpm`, ...), other keys
of [robot] (`edge_length`, `phase`, ...), and whole tables (`time={"end": 5.0}`).
"""

from typing import Any

from .core.errors import InputError
from .scenes.extensions import extension_names
from .scenes.file import SceneFile
from .scenes.ingredients import RobotTable
from .scenes.messages import checked
from .scenes.parameters import PLACES, place_of


def single_flagellum(**numbers: Any) -> SceneFile:
    """A head with one flagellum, the robot of Lim et al. (2023); see the module.

    Raises:
        InputError: an unknown name, or a value that cannot be.
    """
    return _file("single_flagellum", numbers)


def two_flagella(**numbers: Any) -> SceneFile:
    """A head with two flagella side by side, on one rod; see the module.

    Raises:
        InputError: an unknown name, or a value that cannot be.
    """
    return _file("two_flagella", numbers)


def branched(n_flagella: int, **numbers: Any) -> SceneFile:
    """A head with some flagella around its axis; see the module.

    Raises:
        InputError: an unknown name, or a value that cannot be.
    """
    return _file("branched", {"n_flagella": n_flagella, **numbers})


def clamped(n_flagella: int, **numbers: Any) -> SceneFile:
    """Some filaments on motors that are held in place; see the module.

    Raises:
        InputError: an unknown name, or a value that cannot be.
    """
    return _file("clamped", {"n_flagella": n_flagella, **numbers})


def _file(kind: str, numbers: dict[str, Any]) -> SceneFile:
    content: dict[str, Any] = {"robot": {"kind": kind}}
    for name, value in numbers.items():
        if name in SceneFile.model_fields or name in extension_names():
            content[name] = {**content.get(name, {}), **value}
        elif name in PLACES:
            table, key = place_of(name)
            content.setdefault(table, {})[key] = value
        elif name in RobotTable.model_fields:
            content["robot"][name] = value
        else:
            known = ", ".join([*PLACES, *(k for k in RobotTable.model_fields if k not in PLACES)])
            raise InputError(f"{name}: there is no such parameter; there are {known}")
    return checked(SceneFile, content)
