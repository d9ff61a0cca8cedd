"""Scene files: what is accepted, and what is said about the rest."""

import re
import tomllib
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from pydantic import Field

from derjax import build
from derjax.commands.new import template
from derjax.core.errors import InputError
from derjax.io.fields import Finite, Table
from derjax.scenes.file import SceneFile
from derjax.scenes.load import load_scene
from derjax.scenes.messages import check
from derjax.scenes.parameters import PLACES

TABLES = [name for name, field in SceneFile.model_fields.items() if not field.exclude]


def scene_with(tmp_path: Path, text: str, **others: str) -> Path:
    """A scene file of that text, with other files beside it (their dots as underscores)."""
    for name, content in others.items():
        (tmp_path / name.replace("_", ".")).write_text(content)
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return path


def complaint(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        load_scene(path)
    return str(caught.value)


def test_empty_file_is_a_scene_with_the_defaults(tmp_path):
    assert load_scene(scene_with(tmp_path, "")) == SceneFile()


def test_integers_will_do(tmp_path):
    scene = load_scene(scene_with(tmp_path, "[fluid]\nviscosity = 2\n[time]\nend = 3\n"))
    assert scene.fluid.viscosity == 2.0
    assert isinstance(scene.fluid.viscosity, float)
    assert scene.n_steps == 60


def test_every_parameter_has_a_unit():
    everything = [
        SceneFile(),
        SceneFile.model_validate({"robot": {"kind": "two_flagella"}, "friction": {}}),
        SceneFile.model_validate({"robot": {"shape": "arc"}}),
        SceneFile.model_validate(
            {"motor": {"stall_torque": 1e-3, "free_rpm": 60.0, "ripple": 0.1}}
        ),
    ]
    assert set().union(*(scene.parameters for scene in everything)) == set(PLACES)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[robot]\nhelix_radius = 6.4", "[robot] helix_radius = 6.4: lengths are in metres"),
        ("[robot]\nhelix_radius = 6.4", "did you mean 0.0064?"),
        ("[fluid]\nregularization = 1.67", "did you mean 0.00167?"),
        ("[fluid]\nregularization = 0.167", "[fluid] regularization = 0.167"),
        ("[material]\nyoungs_modulus = 1.255", "did you mean 1.255e+06?"),
        ("[material]\ndensity = 1.26", "did you mean 1260?"),
        ("[robot]\npitch = 0", "[robot] pitch = 0: should be greater than 0"),
        ("[robot]\npitch = -1e-3", "[robot] pitch = -0.001: should be greater than 0"),
        ("[robot]\npitch = '0.04'", '[robot] pitch = "0.04"'),
        ("[robot]\npitch = '0.04'", "without quotes"),
        ("[robot]\npitch = true", "[robot] pitch = true: should be a valid number"),
        ("[fluid]\nviscosity = inf", "[fluid] viscosity = inf: should be a finite number"),
        ("[head]\nC_t = nan", "[head] C_t = nan: should be a finite number"),
        ("[head]\nC_t = -1", "[head] C_t = -1"),
        ("[robot]\nptich = 1", "[robot] ptich: unknown key. Did you mean 'pitch'?"),
        ("[robot]\nviscosity = 1", "It belongs in the table [fluid]"),
        ("viscosity = 1", "viscosity: unknown key. It belongs in the table [fluid]"),
        ("[robt]\npitch = 1", "[robt]: unknown table. Did you mean [robot]?"),
        ("[motor_table]\ntime = [0]\nrpm = [1]", "[motor_table]: unknown table"),
        ("robot = 3", "robot: should be a table, not 3"),
        ("[robot]\nkind = 'fish'", "'single_flagellum'"),
        ("[robot]\nrod_radius = 0.03", "rod_radius = 0.03: the turns of the helix overlap"),
        ("[robot]\nedge_length = 0.08", "edge_length = 0.08"),
        ("[robot]\nhelix_radius = 1e-4", "helix_radius = 0.0001: too small"),
        ("[robot]\nedge_length = 3e-4", "[fluid] regularization = 0.00167: more than 3.5 times"),
        ("[material]\npoisson_ratio = 0.6", "[material] poisson_ratio = 0.6"),
        ("[motor]\nrpm = 1e9", "[motor] rpm = 1e+09: beyond any motor"),
        ("[motor]\nrpm = 1\ntable = 'm.csv'", "either rpm or table"),
        ("[time]\nstep = 0.03\nend = 1", "[time] end = 1: must be a whole number"),
        ("[time]\nstep = 2\nend = 1", "[time] step = 2: must not be longer"),
        ("[time]\nstep = 1e-9\nend = 1e3", "1e+12 steps are too many"),
        ("[time]\nend = 1\nframe = 0.015", "[time] frame = 0.015"),
        ("[time]\nend = 1\nframe = 0.3", "[time] frame = 0.3"),
        ("[time]\ninertia = 1", "[time] inertia = 1: should be a valid boolean"),
        ("[solver]\nmax_iterations = 2.5", "[solver] max_iterations = 2.5"),
        ("[gravity]\nacceleration = [0, 'a', 0]", "[gravity] acceleration (entry 2)"),
        ("[gravity]\nacceleration = [0, 0]", "[gravity] acceleration (entry 3): is missing"),
        ("[robot]\npitch = 0.04.4", "line 2"),
    ],
)
def test_complaints_name_file_and_key(tmp_path, text, expected):
    said = complaint(scene_with(tmp_path, text))
    assert said.startswith(f"{tmp_path / 'scene.toml'}: ")
    assert expected in said


def test_all_problems_are_told_at_once(tmp_path):
    said = complaint(scene_with(tmp_path, "[robot]\npitch = -1\n[fluid]\nviscosity = 'thick'\n"))
    assert "[robot] pitch" in said
    assert "[fluid] viscosity" in said


def test_missing_file_and_directory(tmp_path):
    assert "no such file" in complaint(tmp_path / "none.toml")
    assert str(tmp_path) in complaint(tmp_path)


TABLE = "[motor]\ntable = 'motor.csv'\n[time]\nend = 2\n"


def test_motor_table(tmp_path):
    text = "# a comment\ntime, rpm\n0, 0\n1, 30\n2, 60\n"
    scene = load_scene(scene_with(tmp_path, TABLE, motor_csv=text))
    assert scene.motor_table is not None
    assert scene.motor_table.time == (0.0, 1.0, 2.0)
    np.testing.assert_array_equal(scene.parameters["rpm"], [0.0, 30.0, 60.0])


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ("time,rpm\n0,1\n1,1\n", "covers 0 to 1 s, but the run lasts from 0 to 2 s"),
        ("time,rpm\n0.5,1\n3,1\n", "covers 0.5 to 3 s"),
        ("time,rpm\n0,1\n2,1\n1,1\n", "line 4: times must increase"),
        ("time,rpm\n0,1\n0,1\n2,1\n", "line 3: times must increase"),
        ("time,speed\n0,1\n2,1\n", "no column 'rpm'"),
        ("time,rpm\n0,fast\n2,1\n", "line 2 (row 1), column 'rpm': not a number: 'fast'"),
        ("time,rpm\n0,1\n2,inf\n", "line 3 (row 2), column 'rpm': not a number: 'inf'"),
        ("time,rpm\n0,1\n2,1e7\n", "line 3: rpm = 1e+07: beyond any motor"),
        ("time,rpm\n", "has a header but no rows"),
        ("", "the file is empty"),
        ("time,rpm\n0,1,2,3\n1,2\n\n2,3,4,5,6\n", "motor.csv"),
    ],
)
def test_motor_table_complaints(tmp_path, table, expected):
    said = complaint(scene_with(tmp_path, TABLE, motor_csv=table))
    assert f"{tmp_path / 'scene.toml'}: [motor] table: {tmp_path / 'motor.csv'}: " in said
    assert expected in said


def test_motor_table_that_is_not_there(tmp_path):
    assert "motor.csv: no such file" in complaint(scene_with(tmp_path, TABLE))


def test_explicit_scheme(tmp_path):
    scene = load_scene(scene_with(tmp_path, "[time]\nscheme = 'explicit'\nstep = 1e-4\nend = 1\n"))
    assert (scene.n_steps, scene.steps_per_frame, scene.n_frames) == (10000, 1000, 10)


@pytest.mark.parametrize(("step", "end"), [(0.01, 20.0), (0.1, 0.3), (0.5, 2.0), (0.03, 0.21)])
def test_frames_divide_the_run(step, end):
    scene = check(SceneFile, {"time": {"step": step, "end": end}}, Path("scene.toml"))
    assert scene.n_frames * scene.steps_per_frame == scene.n_steps == round(end / step)


def test_template_has_every_key_with_its_default():
    text = template("scene.toml")
    assert check(SceneFile, tomllib.loads(text), Path("scene.toml")) == SceneFile()
    given = tomllib.loads(text)
    everything = re.sub(r"^# (\[\w+\]|\w+ = \S)", r"\1", text, flags=re.MULTILINE)
    everything = everything.replace('table = "motor.csv"', "", 1)  # excludes rpm ...
    everything = re.sub(
        r"^(stall_torque|free_rpm) = .*$", "", everything, flags=re.MULTILINE
    )  # ... too
    documented = tomllib.loads(everything)
    assert set(documented) == set(TABLES)
    for name in TABLES:
        table = SceneFile.model_fields[name].annotation
        model = next(
            kind
            for kind in (table, *getattr(table, "__args__", ()))
            if hasattr(kind, "model_fields")
        )
        assert set(documented[name]) == set(model.model_fields) - {
            "table",
            "stall_torque",
            "free_rpm",
        }, name
        for key, value in given.get(name, {}).items():
            assert value == model.model_fields[key].default, f"[{name}] {key}"
    assert '# table = "motor.csv"' in text
    limited = dict(re.findall(r"^# (stall_torque|free_rpm) = (\S+)", text, flags=re.MULTILINE))
    check(SceneFile, {"motor": {k: float(v) for k, v in limited.items()}}, Path("scene.toml"))
    documented["motor"] = {"table": "motor.csv"} | documented["motor"]
    del documented["motor"]["rpm"]
    check(SceneFile, documented, Path("scene.toml"))  # the examples of what is off are valid


def test_template_motor_table(tmp_path):
    path = scene_with(tmp_path, "[motor]\ntable = 'motor.csv'\n", motor_csv=template("motor.csv"))
    assert load_scene(path).motor_table is not None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[robot]\nphase = 'a'", '[robot] phase = "a": should be a valid number'),
        (
            "[robot]\nkind = 'two_flagella'\nhandedness = ['left', 'up']",
            "[robot] handedness (entry 2) = \"up\": should be 'left' or 'right'",
        ),
        ("[motor]\nrpm = 'fast'", '[motor] rpm = "fast": should be a valid number'),
    ],
)
def test_values_or_lists_of_them_are_refused_in_one_line(tmp_path, text, said):
    assert complaint(scene_with(tmp_path, text)).splitlines() == [f"{tmp_path}/scene.toml: {said}"]


def test_parts_that_overlap_at_the_start_are_refused():
    robot = {"kind": "two_flagella", "separation": 4e-3, "handedness": ["left", "right"]}
    with pytest.raises(InputError, match=r"\[robot\].*overlap at the start.*separation"):
        build(SceneFile.model_validate({"robot": robot}))


@pytest.mark.parametrize("key", ["phase", "bend"])
@pytest.mark.parametrize("angle", [90, -90.0])
def test_angles_in_degrees_are_refused(key, angle):
    robot = {"shape": "arc", key: angle}
    said = rf"\[robot\] {key} = {angle:g}: {key} is in rad; did you mean {angle / 90 * 1.5708:g}\?"
    with pytest.raises(InputError, match=said):
        check(SceneFile, {"robot": robot}, Path("scene.toml"))
    check(SceneFile, {"robot": {"shape": "arc", key: 2 * np.pi}}, Path("scene.toml"))


class Entry(Table):
    """One of a list of tables."""

    unit: Literal["m", "mm"] = "m"
    names: Finite | tuple[Finite, ...] = 0.0


class Listed(Table):
    """Tables in a list, as in files of tracks."""

    entries: tuple[Entry, ...] = Field(min_length=1)


def problems(content: dict[str, Any]) -> list[str]:
    with pytest.raises(InputError) as error:
        check(Listed, content, Path("file.toml"))
    return str(error.value).splitlines()


def test_a_fault_within_a_list_is_told_once():
    (only,) = problems({"entries": [{"unit": "furlong"}]})
    assert only.startswith('file.toml: [entries] (entry 1) unit = "furlong"')
    assert len(problems({"entries": [{"unit": "furlong"}, {"unit": "mile"}]})) == 2
    (only,) = problems({"entries": []})
    assert "at least 1" in only


def test_a_value_or_list_is_faulted_as_what_it_is_however_deep():
    (only,) = problems({"entries": [{"names": "x"}]})
    assert only == 'file.toml: [entries] (entry 1) names = "x": should be a valid number'
    (only,) = problems({"entries": [{"names": [1.0, "x"]}]})
    assert only.startswith("file.toml: [entries] (entry 1) names (entry 2)")
    (only,) = problems({"entries": [{"names": [1.0, "2"]}]})
    assert only.endswith("write it without quotes")


def test_columns_of_a_motor_are_faulted_as_what_they_are():
    for given, said in ((3, "columns.rpm = 3"), (["a", 4], "columns.rpm (entry 2)")):
        with pytest.raises(InputError) as error:
            check(SceneFile, {"motor": {"table": "x", "columns": {"rpm": given}}}, Path("f"))
        (only,) = str(error.value).splitlines()
        assert said in only
