"""Every key of a scene file has an effect, or is reported to have none."""

import contextlib
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from pydantic import BaseModel

from derjax import InputError, SceneFile, build, load_scene
from derjax.commands import main as cli
from derjax.core.errors import InputWarning
from derjax.core.pytree import replace
from derjax.runs.sweeps.file import load_sweep
from derjax.scenes.effects import idle_keys
from derjax.scenes.ingredients import INGREDIENTS
from derjax.scenes.messages import checked

TINY = {"edge_length": 0.03}
STEPS = {"step": 0.02, "end": 0.2}

SCENES: dict[str, dict[str, Any]] = {
    "single": {},
    "straight": {"robot": {"shape": "straight"}, "time": STEPS},
    "arc": {"robot": {"shape": "arc", "bend": 0.5}, "gravity": {}},
    "two": {"robot": {"kind": "two_flagella"}, "friction": {}},
    "branched": {
        "robot": {"kind": "branched", "n_flagella": 2},
        "contact": {"method": "none"},
        "friction": {"coefficient": 0.0},
    },
    "clamped": {"robot": {"kind": "clamped", "n_flagella": 2}, "time": {"inertia": False}},
    "one clamped": {"robot": {"kind": "clamped", "n_flagella": 1}, "gravity": {}},
    "local": {"fluid": {"hydrodynamics": "rft"}, "time": STEPS | {"inertia": False}},
    "dry": {"fluid": {"hydrodynamics": "none"}, "head": {"drag": "none"}},
    "dry clamped": {
        "robot": {"kind": "clamped", "n_flagella": 1},
        "fluid": {"hydrodynamics": "none"},
    },
    "head only": {"fluid": {"hydrodynamics": "none"}, "time": STEPS | {"inertia": False}},
    "explicit": {"time": STEPS | {"step": 1e-4, "scheme": "explicit"}},
    "corrected": {
        "robot": {"kind": "two_flagella"},
        "contact": {"method": "spillmann_teschner"},
        "time": {"inertia": False},
    },
    "rippled": {"motor": {"ripple": 0.1}},
    "limited": {"motor": {"stall_torque": 1e-3, "free_rpm": 80.0, "ripple": 0.1}},
    "blocks": {"solver": {"method": "blocks"}, "contact": {"method": "smooth"}},
}

OTHERS: dict[str, tuple[Any, ...]] = {
    "robot.kind": ("two_flagella", "single_flagellum"),
    "robot.n_flagella": (1, 2),
    "robot.shape": ("arc", "helix"),
    "robot.bend": (0.5, 0.0),
    "robot.helix_radius": (6e-3,),
    "robot.pitch": (0.04,),
    "robot.axial_length": (0.1,),
    "robot.rod_radius": (1.5e-3,),
    "robot.edge_length": (0.025,),
    "robot.head_radius": (0.03,),
    "robot.separation": (0.03,),
    "robot.handedness": ("right",),
    "robot.phase": (0.5,),
    "robot.clamped_tip": (True, False),
    "material.youngs_modulus": (1e6,),
    "material.poisson_ratio": (0.4,),
    "material.density": (1200.0,),
    "fluid.viscosity": (0.9,),
    "fluid.fluid_density": (1000.0,),
    "fluid.hydrodynamics": ("rft", "rss"),
    "fluid.resistive": ("lighthill",),
    "fluid.regularization": (1.5e-3,),
    "fluid.end_nodes": ("full",),
    "fluid.drag_matrix": ("lower_triangle", "symmetric"),
    "fluid.head_nodes": ("dropped", "excluded"),
    "fluid.spin_drag": (True, False),
    "head.drag": ("none", "stokes"),
    "head.C_t": (4.0,),
    "head.C_r": (0.3,),
    "head.rotation": ("full", "spin"),
    "head.arm": ("published",),
    "head.stiffness": (50.0,),
    "head.mass": (0.2,),
    "motor.hinge": ("published",),
    "motor.rpm": (50.0,),
    "motor.stall_torque": (2e-3, 3e-3),
    "motor.free_rpm": (90.0, 70.0),
    "motor.ripple": (0.2, 0.0),
    "motor.ripple_order": (4,),
    "contact.method": ("smooth", "none"),
    "contact.stiffness": (1000.0,),
    "contact.capacity": (5,),
    "friction.coefficient": (0.2,),
    "friction.slip_speed": (2e-3,),
    "time.step": (0.01, 0.005),
    "time.end": (0.4,),
    "time.frame": (0.1, 0.05),
    "time.scheme": ("trbdf2", "euler"),
    "time.tolerance": (1e-3,),
    "time.inertia": (False, True),
    "gravity.acceleration": ([0.0, 0.0, -1.6],),
    "solver.method": ("dense", "blocks"),
    "solver.tolerance": (1e-8,),
    "solver.max_iterations": (50,),
}
"""Other values for each key."""

ONCE = {
    "robot.kind": "single",
    "robot.shape": "single",
    "robot.edge_length": "single",
    "robot.n_flagella": "branched",
}
"""Keys for which one scene is enough: none is without effect, and new meshes take long."""

ELSEWHERE = {
    "motor.table",
    "motor.columns",
    "motor.counts_per_turn",
    "motor.time_unit",
    "motor.time_offset",
}
"""Keys of motor tables, which are refused where they have no effect (`test_motortable`)."""


def every_key() -> set[str]:
    keys = set()
    for table, field in SceneFile.model_fields.items():
        kinds = (field.annotation, *getattr(field.annotation, "__args__", ()))
        for kind in kinds:
            if isinstance(kind, type) and issubclass(kind, BaseModel) and not field.exclude:
                keys |= {f"{table}.{key}" for key in kind.model_fields}
    return keys


def content_of(name: str) -> dict[str, dict[str, Any]]:
    content = {table: dict(keys) for table, keys in SCENES[name].items()}
    content["robot"] = TINY | content.get("robot", {})
    return content


def made_of(content: dict[str, Any]) -> tuple[Any, list[np.ndarray]]:
    """All that a scene file makes: structure and numbers of the scene, frames and steps."""
    return built(checked(SceneFile, content).model_dump_json())


@cache  # many contents are the same once defaults are filled in
def built(text: str) -> tuple[Any, list[np.ndarray]]:
    file = SceneFile.model_validate_json(text)
    with jax.disable_jit():  # quicker than to compile so many
        scene = build(file)
        state = scene.start
    leaves, structure = jax.tree.flatten((replace(scene, parameters={}, source=None), state))
    return (structure, file.grid), [np.asarray(leaf) for leaf in leaves]


def differ(one: tuple[Any, list[np.ndarray]], other: tuple[Any, list[np.ndarray]]) -> bool:
    if one[0] != other[0] or len(one[1]) != len(other[1]):
        return True
    return not all(np.array_equal(a, b) for a, b in zip(one[1], other[1], strict=True))


@cache
def as_it_is(name: str) -> tuple[Any, list[np.ndarray]]:
    return made_of(content_of(name))


def without(name: str, key: str) -> tuple[Any, list[np.ndarray]]:
    table, entry = key.split(".")
    content = content_of(name)
    if entry not in content.get(table, {}):
        return as_it_is(name)
    del content[table][entry]
    return made_of(content)


def with_value(
    name: str, key: str, value: Any
) -> tuple[tuple[Any, list[np.ndarray]], dict[str, str]]:
    """What a scene is made of if a key has some value, and what is reported."""
    table, entry = key.split(".")
    content = content_of(name)
    content.setdefault(table, {})[entry] = value
    return made_of(content), idle_keys(checked(SceneFile, content), content)


def outcome(name: str, key: str) -> tuple[bool, bool] | None:
    """Whether a key changes a scene, and whether it is reported; None if there is no choice."""
    made, reports = [], []
    for value in OTHERS[key]:
        with contextlib.suppress(InputError):
            scene, reported = with_value(name, key, value)
            made.append(scene)
            reports.append(key in reported)
    if len(made) < min(2, len(OTHERS[key])) and not any(reports):
        return None  # all values but one are refused
    with contextlib.suppress(InputError):
        default = without(name, key)
        for scene, reported in zip(made, reports, strict=True):
            assert not (reported and differ(scene, default))
        made.append(default)
    return any(differ(made[0], other) for other in made[1:]), any(reports)


MAY_BE_IDLE = {
    f"{name}.{key}" for name, table in INGREDIENTS.items() for i in table.IDLE for key in i.keys
}
"""The keys that tables say have no effect in some scenes."""


def test_every_key_is_tried():
    assert OTHERS.keys() | ELSEWHERE == every_key()
    assert OTHERS.keys() >= MAY_BE_IDLE


@pytest.mark.slow
@pytest.mark.parametrize("key", OTHERS)
def test_a_key_changes_the_scene_or_is_reported(key):
    names = [ONCE[key]] if key in ONCE else SCENES
    outcomes = {name: found for name in names if (found := outcome(name, key)) is not None}
    wrong = [name for name, (changed, reported) in outcomes.items() if changed == reported]
    assert not wrong, outcomes
    assert any(changed for changed, _ in outcomes.values())
    expected = key in MAY_BE_IDLE
    assert any(reported for _, reported in outcomes.values()) == expected


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


IDLE_TEXT = "[fluid]\nhydrodynamics = 'rft'\nend_nodes = 'full'\n[head]\nstiffness = 5.0\n"


def test_a_scene_file_is_read_with_a_warning_for_each_such_key(tmp_path):
    path = write(tmp_path / "scene.toml", IDLE_TEXT)
    with pytest.warns(InputWarning) as found:
        scene = load_scene(path)
    assert scene.fluid.end_nodes == "full"
    assert [str(w.message) for w in found] == [
        f"{path}: [fluid] end_nodes: has no effect with hydrodynamics = 'rft'",
        f"{path}: [head] stiffness: has no effect on a robot of 1 flagellum, "
        "whose head has no arms",
    ]


def test_other_tables_are_named():
    content = {"contact": {"stiffness": 1.0}, "time": STEPS | {"tolerance": 1e-3}}
    assert list(idle_keys(checked(SceneFile, content), content).values()) == [
        "[contact] stiffness: has no effect with method = 'none'"
    ]
    content |= {"robot": {"kind": "two_flagella"}, "contact": {"method": "spillmann_teschner"}}
    assert idle_keys(checked(SceneFile, content), content)["time.tolerance"] == (
        "[time] tolerance: has no effect with [contact] method = 'spillmann_teschner', "
        "whose steps do not adapt"
    )


def test_what_the_command_new_writes_warns_of_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_scene(Path(cli.__file__).parents[1] / "scenes" / "templates" / "scene.toml")


def test_the_command_line_says_it_once(tmp_path, capsys, monkeypatch):
    path = write(tmp_path / "scene.toml", IDLE_TEXT)

    def twice(args: Any) -> int:
        load_scene(path)
        load_scene(path)
        warnings.warn("of something else", DeprecationWarning, stacklevel=1)
        return 0

    monkeypatch.setattr("derjax.commands.simulate.run", twice)
    with pytest.warns(DeprecationWarning, match="something else"):
        assert cli.main(["simulate", str(path), "-o", str(tmp_path)]) == 0
    said = capsys.readouterr().err.splitlines()
    assert [line for line in said if "end_nodes" in line] == [
        f"derjax: warning: {path}: [fluid] end_nodes: has no effect with hydrodynamics = 'rft'"
    ]
    assert len([line for line in said if line.startswith("derjax: warning: ")]) == 2


def test_a_sweep_warns_of_keys_that_never_have_an_effect(tmp_path):
    scene = write(tmp_path / "scene.toml", IDLE_TEXT)
    text = "scene = 'scene.toml'\n[vary]\n'contact.stiffness' = [1e3, 2e3]\n"
    path = write(tmp_path / "sweep.toml", text + "'head.stiffness' = [1.0, 2.0]\n")
    with pytest.warns(InputWarning) as found:
        load_sweep(path)
    assert {str(w.message).split(": has")[0] for w in found} == {
        f"{scene}: [fluid] end_nodes",
        f"{path}: [head] stiffness",
        f"{path}: [contact] stiffness",
    }
    varied = "'fluid.hydrodynamics' = ['rft', 'rss']\n'contact.method' = ['none', 'smooth']\n"
    path = write(tmp_path / "sweep.toml", text + varied)
    with pytest.warns(InputWarning) as found:
        load_sweep(path)
    assert {str(w.message).split(": has")[0] for w in found} == {f"{scene}: [head] stiffness"}
