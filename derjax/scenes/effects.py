"""Which keys of a scene file matter when.

A key of a model that is not chosen has no effect. It is no error, as one may try a model and go
back, but one should be told.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

SceneFile = Any
"""A `scenefile.SceneFile`: that module asks this one."""


@dataclass(frozen=True)
class Idle:
    """When some keys of a scene file have no effect.

    Attributes:
        keys: by table and name.
        when: whether that is so in a scene.
        reason: what follows "has no effect".
    """

    keys: tuple[str, ...]
    when: Callable[[SceneFile], bool]
    reason: Callable[[SceneFile], str]


def _weighed(s: SceneFile) -> bool:
    """Whether masses matter but for weight."""
    explicit = s.time.scheme == "explicit"
    return s.time.inertia or explicit or s.contact_method == "spillmann_teschner"


def _headless(s: SceneFile) -> bool:
    return s.robot.kind == "clamped"


def _is(table: str, key: str) -> Callable[[SceneFile], str]:
    """The reason that a key has some value."""

    def reason(s: SceneFile) -> str:
        value = getattr(getattr(s, table), key)
        shown = str(value).lower() if isinstance(value, bool) else f"{value!r}"
        return f"with [{table}] {key} = {shown}"

    return reason


def _says(text: str) -> Callable[[SceneFile], str]:
    return lambda s: text


def _contact(s: SceneFile) -> str:
    return f"with [contact] method = {s.contact_method!r}"


STOKESLETS = ("fluid.regularization", "fluid.end_nodes", "fluid.drag_matrix", "fluid.head_nodes")
HEAD = ("head.drag", "head.C_t", "head.C_r", "head.rotation", "head.stiffness", "head.mass")

IDLE = (
    Idle(
        ("robot.helix_radius", "robot.pitch", "robot.handedness"),
        lambda s: s.robot.shape != "helix",
        _is("robot", "shape"),
    ),
    Idle(("robot.bend",), lambda s: s.robot.shape != "arc", _is("robot", "shape")),
    Idle(("robot.phase",), lambda s: s.robot.shape == "straight", _is("robot", "shape")),
    Idle(("robot.separation",), lambda s: s.robot.count == 1, _says("on a robot of 1 flagellum")),
    Idle(("robot.head_radius", *HEAD), _headless, _is("robot", "kind")),
    Idle(("robot.clamped_tip",), lambda s: not _headless(s), _is("robot", "kind")),
    Idle(
        ("material.density",),
        lambda s: s.gravity is None and not _weighed(s),
        _says("without inertia and [gravity]"),
    ),
    Idle(
        ("head.mass",),
        lambda s: s.gravity is None and not _weighed(s),
        _says("without inertia and [gravity]"),
    ),
    Idle(("fluid.fluid_density",), lambda s: s.gravity is None, _says("without [gravity]")),
    Idle(
        ("fluid.viscosity",),
        lambda s: s.fluid.hydrodynamics == "none" and (_headless(s) or s.head.drag == "none"),
        _says("where nothing is dragged"),
    ),
    Idle(STOKESLETS, lambda s: s.fluid.hydrodynamics != "rss", _is("fluid", "hydrodynamics")),
    Idle(
        ("fluid.resistive",),
        lambda s: s.fluid.hydrodynamics != "rft",
        _is("fluid", "hydrodynamics"),
    ),
    Idle(
        ("fluid.spin_drag",),
        lambda s: s.fluid.hydrodynamics == "none",
        _is("fluid", "hydrodynamics"),
    ),
    Idle(
        ("head.C_t", "head.C_r", "head.rotation"),
        lambda s: s.head.drag == "none",
        _is("head", "drag"),
    ),
    Idle(
        ("head.stiffness",),
        lambda s: s.robot.count == 1,
        _says("on a robot of 1 flagellum, whose head has no arms"),
    ),
    Idle(
        ("contact.stiffness", "contact.capacity"),
        lambda s: s.contact_method != "smooth",
        _contact,
    ),
    Idle(("friction.slip_speed",), lambda s: not s.rubbing, _says("with coefficient = 0")),
    Idle(("time.inertia",), lambda s: s.time.scheme == "explicit", _is("time", "scheme")),
    Idle(
        ("time.tolerance",),
        lambda s: s.contact_method == "spillmann_teschner",
        lambda s: f"{_contact(s)}, whose steps do not adapt",
    ),
    Idle(
        ("time.scheme",),
        lambda s: s.contact_method == "spillmann_teschner" and s.time.scheme == "trbdf2",
        lambda s: f"{_contact(s)}, whose steps are those of implicit Euler",
    ),
)
"""All there are."""


def idle_keys(scene: SceneFile, content: Mapping[str, Any]) -> dict[str, str]:
    """The keys of a scene file that have no effect, and why.

    Args:
        scene: the checked file.
        content: its tables.

    Returns:
        Sentences without the name of the file, by table and key.
    """
    given = {
        f"{table}.{key}"
        for table, keys in content.items()
        if isinstance(keys, Mapping)
        for key in keys
    }
    found: dict[str, str] = {}
    for idle in IDLE:
        for name in idle.keys:
            if name in given and name not in found and idle.when(scene):
                table, key = name.split(".")
                reason = idle.reason(scene).replace(f"with [{table}] ", "with ")
                found[name] = f"[{table}] {key}: has no effect {reason}"
    return found
