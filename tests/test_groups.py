"""Nondimensional groups: what a robot does depends on nothing else."""

import json

import numpy as np
import pytest

import derjax as dj
from derjax.commands.main import main
from derjax.scenes.file import SceneFile
from derjax.scenes.groups import DIMENSIONS, OTHER_UNITS, groups, nondimensional, rescaled, units_of
from derjax.scenes.ingredients import INGREDIENTS

TABLES = {
    "robot": {
        "kind": "two_flagella",
        "edge_length": 20e-3,
        "separation": 0.02,
        "phase": [0.0, 0.7],
    },
    "motor": {"stall_torque": 4e-4, "free_rpm": 120.0},
    "friction": {"coefficient": 0.3},
    "gravity": {"acceleration": [0.0, 0.0, -0.5]},
    "contact": {"stiffness": 5e3},
    "time": {"end": 0.5, "frame": 0.1},
}


@pytest.mark.parametrize("kind", ["single_flagellum", "two_flagella"])
def test_groups_in_place_of_keys(kind):
    """What a scene says of itself makes it again, at its own size and at another."""
    robot = {"kind": kind, "pitch": 0.04, "helix_radius": 7e-3, "rod_radius": 1.4e-3}
    first = SceneFile.from_dict({"robot": robot, "motor": {"rpm": -45.0}})
    given = groups(first) | {"omega_bar": -groups(first)["omega_bar"]}
    again = SceneFile.from_dict({"robot": {"kind": kind}, "nondimensional": given})
    for name, value in first.parameters.items():
        np.testing.assert_allclose(again.parameters[name], value, rtol=1e-12, err_msg=name)
    small = {"kind": kind, "axial_length": 1e-5, "edge_length": 5e-7}
    fluid = {"viscosity": 1e-3}
    tables = {"robot": small, "fluid": fluid, "material": {"youngs_modulus": 1e7}}
    bacterium = SceneFile.from_dict(tables | {"nondimensional": given})
    assert groups(bacterium) == pytest.approx(groups(first), rel=1e-12)
    assert "nondimensional" not in bacterium.model_dump()


@pytest.mark.parametrize(
    ("tables", "says"),
    [
        ({"nondimensional": {"omegabar": 1.0}}, r"\[nondimensional\] omegabar: unknown key"),
        ({"nondimensional": {"omega_bar": "fast"}}, r"\[nondimensional\] omega_bar = \"fast\""),
        ({"nondimensional": 3}, r"\[nondimensional\]: should be a table"),
        (
            {"robot": {"pitch": 0.03}, "nondimensional": {"pitch_over_radius": 5.0}},
            r"pitch_over_radius: is given by \[robot\] pitch as well",
        ),
        (
            {"motor": {"stall_torque": 1e-4}, "nondimensional": {"omega_bar": 80.0}},
            r"omega_bar: is for motors of one constant rate; leave it or .* stall_torque out",
        ),
        (
            {"robot": {"axial_length": "long"}, "nondimensional": {"omega_bar": 80.0}},
            r"\[robot\] axial_length = \"long\"",
        ),
    ],
)
def test_wrong_groups(tables, says):
    with pytest.raises(dj.InputError, match=says):
        SceneFile.from_dict(tables)


def test_every_number_with_a_unit_is_known():
    """A key that is new has to say what its unit is, or rescaling would leave it out."""
    numbers = set()
    for table, kind in INGREDIENTS.items():
        for key, field in kind.model_fields.items():
            if "float" in str(field.annotation):
                numbers.add(f"{table}.{key}")
    known = set(OTHER_UNITS)
    for table, kind in INGREDIENTS.items():
        known |= {f"{table}.{key}" for key in kind.PARAMETERS}
        assert {p.unit for p in kind.PARAMETERS.values()} <= DIMENSIONS.keys()
    pure = {"head.stiffness", "solver.tolerance", "time.tolerance"}
    logs = {"motor.counts_per_turn", "motor.time_offset"}
    assert numbers - known == pure | logs


@pytest.mark.slow
def test_a_robot_at_another_scale_does_the_same():
    """To round-off, with all ingredients; a bacterium's scale beside that of the robot."""
    file = SceneFile.from_dict(TABLES)
    other = rescaled(file, 1e-4, 1e-2, 1e-9)
    found = []
    for scene in (file, other):
        run = dj.rollout(dj.build(scene))
        run.raise_if_failed()
        found.append(nondimensional(scene, run.summary()) | {"steps": int(run.stats.steps)})
    assert groups(file).keys() < found[0].keys()
    assert abs(found[0]["head_rate"]) > 1e-3
    for name, value in found[0].items():
        np.testing.assert_allclose(found[1][name], value, rtol=1e-6, atol=1e-9, err_msg=name)
    assert units_of(other).length == pytest.approx(1e-4 * units_of(file).length)


def test_in_its_own_units_a_robot_has_length_viscosity_and_stiffness_one():
    file = SceneFile.from_dict({"robot": {"edge_length": 20e-3}, "time": {"end": 1.0}})
    units = units_of(file)
    own = rescaled(file, *(1.0 / unit for unit in units))
    np.testing.assert_allclose(units_of(own), 1.0, rtol=1e-12)
    assert own.fluid.viscosity == pytest.approx(1.0)
    assert own.fastest_rpm * 2 * np.pi / 60 == pytest.approx(groups(file)["omega_bar"])
    assert groups(file)["omega_bar"] == pytest.approx(80.6, abs=0.1)


def test_what_cannot_be_rescaled(tmp_path):
    table = tmp_path / "motor.csv"
    table.write_text("time,rpm\n0,10\n5,20\n")
    scene = tmp_path / "scene.toml"
    scene.write_text("[motor]\ntable = 'motor.csv'\n[time]\nend = 1.0\n")
    with pytest.raises(ValueError, match="motor's table"):
        rescaled(dj.load_scene(scene), 2.0, 1.0, 1.0)


def test_the_command_tells_them(tmp_path, capsys):
    scene, output = tmp_path / "scene.toml", tmp_path / "out"
    scene.write_text("[robot]\nedge_length = 0.03\n[time]\nend = 0.4\n")
    arguments = ["simulate", str(scene), "-o", str(output), "--no-figures", "--nondimensional"]
    assert main(arguments) == 0
    summary = json.loads((output / "summary.json").read_text())
    own = summary["nondimensional"]
    units = units_of(dj.load_scene(scene))
    assert own["omega_bar"] == pytest.approx(80.6, abs=0.1)
    assert own["v"] == pytest.approx(summary["v_x_m_per_s"] * units.time / units.length)
    assert "omega_bar 80.5" in capsys.readouterr().out
