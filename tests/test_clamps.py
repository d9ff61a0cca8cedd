"""What is held, and what bends beside it; all through scene files."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from helpers import order, settled

import derjax
from derjax import State, build, load_scene, positions
from derjax.core.errors import InputError
from derjax.rods.rod import Rod
from derjax.scenes.file import SceneFile
from derjax.terms import Bend, Gravity, Stretch, Twist

LENGTH, RADIUS, MODULUS, DENSITY = 0.5, 5e-3, 50e9, 2700.0
BENDING = MODULUS * np.pi * RADIUS**4 / 4
WEIGHT = DENSITY * 9.81 * np.pi * RADIUS**2
"""N/m."""

HEAVY_ROD = """
[robot]
kind = "clamped"
n_flagella = 1
shape = "straight"
axial_length = 0.5
rod_radius = 5e-3
edge_length = {edge}
clamped_tip = {tip}
[material]
youngs_modulus = 50e9
poisson_ratio = 0.3
density = 2700.0
[fluid]
fluid_density = 0.0
hydrodynamics = "rft"
[motor]
rpm = 0.0
[gravity]
acceleration = [0.0, 0.0, -9.81]
"""


def written(path: Path, text: str) -> SceneFile:
    """The scene of a file."""
    path.write_text(text, encoding="utf-8")
    return load_scene(path)


def hanging(file: SceneFile) -> tuple[Rod, State]:
    """The rod of a scene, and its equilibrium under its own weight."""
    scene = build(file)
    state = scene.start
    terms = tuple(t for t in scene.terms if isinstance(t, Bend | Stretch | Twist | Gravity))
    assert len(terms) == 4
    return scene.rod, settled(scene.rod, state, terms, scene.rod.topology.fixed_dofs)


@pytest.mark.parametrize(
    ("tip", "sag"),
    [
        ("false", WEIGHT * LENGTH**4 / (8 * BENDING)),
        ("true", WEIGHT * LENGTH**4 / (384 * BENDING)),
    ],
    ids=["one end", "both ends"],
)
def test_a_heavy_rod_sags_as_in_beam_theory(tmp_path, tip, sag):
    """Of second order in the edges, which begin where the rod comes out of the wall."""
    errors = []
    for edges in (10, 50):
        text = HEAVY_ROD.format(edge=LENGTH / edges, tip=tip)
        rod, state = hanging(written(tmp_path / "scene.toml", text))
        x = np.asarray(positions(rod.topology, state.q))
        errors.append(-x[:, 2].min() / sag - 1)
    assert errors[1] == pytest.approx(0.0, abs=1e-3 if tip == "false" else 4e-3)
    assert order([1 / 10, 1 / 50], np.abs(errors).tolist()) == pytest.approx(2, abs=0.1)


def twisted(path: Path, moment: float) -> float:
    """How far a rod held at both ends gets from its axis, over its length.

    It is twisted until it carries a moment (in units of E I / L), and then left to itself. Its
    Poisson ratio is small, which needs less twist for a moment: hinges that are twisted much
    bend too easily.
    """
    turns = moment * (1 - 0.5) / (2 * np.pi)  # E I / G J = 1 + nu
    rpm = 60 * turns
    (path.parent / "motor.csv").write_text(f"time,rpm\n0,{rpm}\n1,{rpm}\n1.000001,0\n6,0\n")
    text = """
        [robot]
        kind = "clamped"
        n_flagella = 1
        shape = "straight"
        axial_length = 0.1
        rod_radius = 1e-2
        edge_length = 5e-3
        clamped_tip = true
        [material]
        youngs_modulus = 1e4
        poisson_ratio = -0.5
        [fluid]
        fluid_density = 0.0
        hydrodynamics = "rft"
        [motor]
        table = "motor.csv"
        [time]
        end = 6.0
        frame = 0.1
        inertia = false
        [gravity]
        acceleration = [0.0, 0.0, -1e-3]
    """
    file = written(path, text)
    scene = build(file)
    state = scene.start
    run = jax.jit(derjax.march_frames, static_argnums=(2, 3))
    states, report = run(scene, state, file.n_frames, file.steps_per_frame)
    report.raise_if_failed()
    x = np.asarray(positions(scene.rod.topology, states.q))[-1]
    return float(np.hypot(x[:, 1], x[:, 2]).max()) / file.robot.axial_length


def test_a_twisted_rod_leaves_its_axis(tmp_path):
    """At M L / E I = 8.987 (Greenhill; Love, Mathematical Theory of Elasticity, section 272)."""
    assert twisted(tmp_path / "scene.toml", 8.8) < 1e-3
    assert twisted(tmp_path / "scene.toml", 9.2) > 0.02


@pytest.mark.parametrize("shape", ["straight", "helix"])
def test_a_held_tip_is_one_more_edge_in_line(shape):
    robot = {"kind": "clamped", "n_flagella": 2, "shape": shape}
    free, held = (
        build(SceneFile.model_validate({"robot": robot | {"clamped_tip": tip}}))
        for tip in (False, True)
    )
    one, two = (scene.rod.topology for scene in (free, held))
    assert two.n_nodes == one.n_nodes + 2
    for path in two.filaments:
        x = np.asarray(positions(two, held.start.q))[list(path)]
        np.testing.assert_allclose(x[-1] - x[-2], x[-2] - x[-3], atol=1e-15)
        ends = [3 * node + axis for node in (*path[:2], *path[-2:]) for axis in range(3)]
        assert set(ends) <= set(two.fixed_dofs)
    angles = {dof for dof in two.fixed_dofs if dof >= 3 * two.n_nodes}
    assert len(two.fixed_dofs) - len(angles) == 2 * 4 * 3
    tips = two.edge_dofs([two.edges.index(path[-2:]) for path in two.filaments])
    assert angles == {*two.edge_dofs(two.driven_edges).tolist(), *tips.tolist()}


@pytest.mark.parametrize("kind", ["single_flagellum", "two_flagella", "branched"])
def test_only_filaments_that_are_held_have_a_held_tip(tmp_path, kind):
    count = "n_flagella = 2\n" if kind == "branched" else ""
    text = f"[robot]\nkind = '{kind}'\n{count}clamped_tip = true\n"
    said = rf"scene.toml: \[robot\] clamped_tip = true: is for kind = 'clamped'.*{kind}"
    with pytest.raises(InputError, match=said):
        written(tmp_path / "scene.toml", text)


def test_hinges_beside_a_held_edge_have_half_the_length():
    robot: dict[str, Any] = {"kind": "clamped", "n_flagella": 1, "shape": "straight"}
    scene = build(SceneFile.model_validate({"robot": robot | {"clamped_tip": True}}))
    length, edge = np.asarray(scene.rod.hinge_length), scene.rod.rest_length[0]
    np.testing.assert_allclose(length[[0, -1]], edge / 2, rtol=1e-12)
    np.testing.assert_allclose(length[1:-1], edge, rtol=1e-12)
    assert length.sum() == pytest.approx(95.4e-3, rel=1e-12)
