"""Numbers of each flagellum: in scene files, in Python, in sweeps and in fits."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import derjax as dj
from derjax.commands.main import main

TABLES = {
    "robot": {"kind": "two_flagella", "edge_length": 0.025, "separation": 0.1},
    "fluid": {"hydrodynamics": "rft"},
    "contact": {"method": "none"},
    "time": {"step": 0.02, "end": 0.2, "frame": 0.02},
}


def file_of(**tables: dict) -> dj.SceneFile:
    merged = {name: TABLES.get(name, {}) | table for name, table in tables.items()}
    return dj.SceneFile.from_dict(TABLES | merged)


PITCHES, MODULI = [0.0445, 0.05], [1.255e6, 2.5e6]
DIFFERENT = file_of(robot={"pitch": PITCHES}, material={"youngs_modulus": MODULI})


@pytest.mark.parametrize(
    "tables",
    [
        {},
        pytest.param({"robot": {"kind": "branched", "n_flagella": 2}}, marks=pytest.mark.slow),
        pytest.param({"fluid": {"hydrodynamics": "rss"}}, marks=pytest.mark.slow),
    ],
    ids=["two", "branched", "segments"],
)
def test_equal_lists_are_what_one_number_is(tables):
    plain = file_of(**tables)
    robot = tables.get("robot", {}) | {"pitch": [0.0445] * 2, "helix_radius": [6.4e-3] * 2}
    lists = file_of(**(tables | {"robot": robot, "material": {"youngs_modulus": [1.255e6] * 2}}))
    one, other = (dj.build(file) for file in (plain, lists))
    np.testing.assert_allclose(one.start.q, other.start.q, atol=1e-15)
    ends = [dj.rollout(scene, end=0.04, reverse_mode=False).last.q for scene in (one, other)]
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-12)


def test_each_flagellum_has_its_shape_and_stiffness():
    scene = dj.build(DIFFERENT)
    nodes = np.asarray(dj.positions(scene.rod.topology, scene.start.q))
    sides, edges = (-1, 1), (5, 4)
    for k, path in enumerate(scene.rod.topology.filaments):
        pitch, side, n = PITCHES[k], sides[k], edges[k]
        helix = nodes[list(path)[-n - 1 :]]
        along = np.diff(helix[:, 0])
        np.testing.assert_allclose(along, 0.0954 / n, rtol=1e-12)
        across = helix[:, 1:] - [side * 0.05, 0.0]
        np.testing.assert_allclose(np.linalg.norm(across, axis=1), 6.4e-3, rtol=1e-12)
        turn = np.sum(across[1:] * across[:-1], axis=1) / 6.4e-3**2
        np.testing.assert_allclose(turn, np.cos(2 * np.pi * along / pitch), atol=1e-9)
    stiffness = np.asarray(scene[dj.Stretch].stiffness)
    area = np.pi * float(scene.parameters["rod_radius"]) ** 2
    flagellum = scene.rod.topology.edge_filaments
    for k, modulus in enumerate(MODULI):
        np.testing.assert_allclose(stiffness[flagellum == k], modulus * area)
    np.testing.assert_allclose(stiffness[flagellum < 0], np.mean(MODULI) * area)
    bend = np.asarray(scene[dj.Bend].stiffness)
    inner = (flagellum[scene.rod.topology.hinge_edges] == 1).all(axis=1)
    inertia = np.pi * float(scene.parameters["rod_radius"]) ** 4 / 4
    np.testing.assert_allclose(bend[inner], MODULI[1] * inertia)


def test_one_of_them_by_its_index():
    """In `build`, in `replace`, and as what is differentiated."""
    by_index = dj.build(file_of(), {"pitch[1]": 0.046, "youngs_modulus[1]": 2.5e6})
    tables = {"robot": {"pitch": [0.0445, 0.046]}, "material": {"youngs_modulus": MODULI}}
    scene = dj.build(file_of(**tables))
    np.testing.assert_allclose(by_index.parameters["pitch"], [0.0445, 0.046])
    np.testing.assert_allclose(by_index.start.q, scene.start.q, atol=1e-15)
    replaced = dj.build(file_of()).replace(**{"pitch[1]": 0.05}).replace(**{"pitch[0]": 0.04})
    np.testing.assert_allclose(replaced.parameters["pitch"], [0.04, 0.05])

    def height(pitch: jax.Array) -> jax.Array:
        return jnp.sum(dj.build(file_of(), {"pitch[1]": pitch}).start.q ** 2)

    slope = float(jax.jit(jax.grad(height))(0.05))
    ends = [float(height(jnp.asarray(0.05 + s * 1e-6))) for s in (-1, 1)]
    assert slope == pytest.approx((ends[1] - ends[0]) / 2e-6, rel=1e-5)


def test_each_motor_has_its_rate():
    scene = dj.build(file_of(motor={"rpm": [60.0, 30.0]}), {"rpm[0]": 50.0})
    np.testing.assert_allclose(scene.parameters["rpm"], [50.0, 30.0])


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"robot": {"pitch": [0.04] * 3}}, r"\[robot\] pitch: 3 given for 2 flagella"),
        (
            {"material": {"youngs_modulus": [1e6] * 3}},
            r"\[material\] youngs_modulus: 3 given for 2 flagella",
        ),
        ({"robot": {"pitch": [0.04, -1.0]}}, r"\[robot\].*pitch.*greater than 0"),
        ({"robot": {"pitch": [0.04, 44.5]}}, r"pitch = 44.5: lengths are in metres"),
        ({"robot": {"pitch": [0.04, 0.002]}}, r"less than half the pitch of 0.002 m"),
    ],
)
def test_lists_that_cannot_be(tables, said):
    with pytest.raises(dj.InputError, match=said):
        file_of(**tables)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("pitch[5]", r"no parameter 'pitch\[5\]'; the robot has pitch\[0\], pitch\[1\]"),
        ("viscosity[0]", r"viscosity is not one of each flagellum"),
        ("pich[0]", r"no parameter 'pich\[0\]'; the scene has helix_radius"),
    ],
)
def test_names_that_do_not_exist(name, said, tmp_path, capsys):
    with pytest.raises(KeyError, match=said):
        dj.build(DIFFERENT, {name: 0.05})
    (tmp_path / "scene.toml").write_text('[robot]\nkind = "two_flagella"\n')
    sweep = tmp_path / "sweep.toml"
    sweep.write_text(f'scene = "scene.toml"\n[vary]\n"{name}" = [0.04, 0.05]\n')
    assert main(["sweep", str(sweep), "-o", str(tmp_path / "out"), "--quiet"]) == 2
    assert f"[vary] {name}: no parameter" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


SCENE = """
[robot]
kind = "two_flagella"
edge_length = 0.025
separation = 0.1
pitch = [0.0445, 0.05]
[fluid]
hydrodynamics = "rft"
[contact]
method = "none"
[time]
step = 0.02
end = 0.4
frame = 0.02
[material]
youngs_modulus = [1.255e6, {modulus}]
"""


@pytest.mark.slow
def test_a_sweep_over_one_of_them(tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE.format(modulus=2.5e6))
    sweep = tmp_path / "sweep.toml"
    sweep.write_text('scene = "scene.toml"\n[vary]\n"pitch[1]" = [0.045, 0.05]\n')
    assert main(["sweep", str(sweep), "-o", str(tmp_path / "out"), "--quiet"]) == 0
    table = pd.read_csv(next((tmp_path / "out").glob("*.csv")))
    assert list(table["pitch[1]"]) == [0.045, 0.05]
    assert (table["status"] == "ok").all()
    assert table["v_x_m_per_s"].nunique() == 2


@pytest.mark.slow
def test_a_fit_of_one_of_them_finds_the_truth(tmp_path):
    (tmp_path / "truth.toml").write_text(SCENE.format(modulus=2.5e6))
    truth = dj.rollout(dj.build(dj.load_scene(tmp_path / "truth.toml")), reverse_mode=False)
    track = pd.DataFrame(np.asarray(truth.head_position[1:]), columns=["x", "y", "z"])
    track += 1e-7 * np.random.default_rng(2).normal(size=track.shape)
    track.insert(0, "t", np.asarray(truth.time[1:]))
    track.to_csv(tmp_path / "track.csv", index=False)
    (tmp_path / "start.toml").write_text(SCENE.format(modulus=1.5e6))
    columns = '{ t = "t", x = "x", y = "y", z = "z" }'
    (tmp_path / "dataset.toml").write_text(
        f'scene = "start.toml"\n[[runs]]\ntrack = "track.csv"\ncolumns = {columns}\n'
    )
    arguments = ["fit", str(tmp_path / "dataset.toml"), "-o", str(tmp_path / "fit"), "--quiet"]
    assert main([*arguments, "--parameters", "youngs_modulus[1]"]) == 0
    fit = json.loads((tmp_path / "fit" / "fit.json").read_text())
    found = fit["parameters"]["youngs_modulus[1]"]
    assert abs(found["value"] - 2.5e6) < 4 * found["std"]
    assert found["std"] < 2.5e5
    assert found["unit"] == "Pa"
