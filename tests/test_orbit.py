"""Relative periodic orbits: steady states, long simulations, differences, and wrong input."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import derjax as dj
from benchmarks.orbits import scene_of as touching
from derjax.commands.main import main
from derjax.steady.orbit import period_of

pytestmark = pytest.mark.slow

TINY = {
    "robot": {"edge_length": 0.02, "helix_radius": 6.4e-3, "pitch": 44.8e-3},
    "fluid": {"hydrodynamics": "rft"},
    "motor": {"rpm": 80.0},
    "time": {"inertia": False, "scheme": "trbdf2", "step": 0.015, "end": 30.0, "frame": 0.75},
    "contact": {"method": "none"},
}
STEPS = 50


SEPARATION = 0.1
"""m, for flagella that do not touch: with contact there are several such motions."""


def scene_of(**robot) -> dj.Scene:
    return dj.build(dj.SceneFile.from_dict(TINY | {"robot": TINY["robot"] | robot}))


@pytest.fixture(scope="module")
def alone() -> tuple[dj.Scene, dj.Orbit]:
    scene = scene_of()
    return scene, dj.orbit(scene, steps=STEPS)


@pytest.fixture(scope="module")
def pair() -> dj.Orbit:
    return dj.orbit(scene_of(kind="two_flagella", separation=SEPARATION), steps=STEPS)


def test_of_one_flagellum_it_is_the_steady_state(alone):
    """Speed, head rate, and multipliers exp(eigenvalue T), with errors of steps of time."""
    scene, found = alone
    state = dj.steady(scene)
    assert found.period == pytest.approx(0.75)
    assert found.speed == pytest.approx(float(state.speed), rel=1e-3)
    assert found.head_rate == pytest.approx(float(state.head_rate), rel=1e-3)
    slowest = np.log(np.abs(found.multipliers(2)[0])) / found.period
    assert slowest == pytest.approx(dj.stability(state).growth_rate, rel=1e-2)


def test_derivatives_agree_with_differences(alone):
    """By a number of the shape, and by the rate of the motor, with its period."""
    scene, found = alone
    names = ("pitch", "rpm")
    agree_with_differences(scene, found, names, 2e-4)


def agree_with_differences(
    scene: dj.Scene, found: dj.Orbit, names: Sequence[str], tolerance: float
) -> None:
    slopes = found.derivatives(names)
    for name in names:
        value = float(scene.parameters[name])
        h = 2e-3 * value
        near = [
            dj.orbit(
                scene.replace(**{name: value + s * h}), found.state, steps=STEPS, tolerance=1e-9
            )
            for s in (1, -1)
        ]
        for what in ("speed", "head_rate"):
            difference = (getattr(near[0], what) - getattr(near[1], what)) / (2 * h)
            scale = 1e-5 * abs(getattr(found, what)) / value
            assert slopes[name][what] == pytest.approx(difference, rel=tolerance, abs=scale)


def test_two_flagella_repeat_themselves_and_a_long_simulation_ends_in_that(pair):
    """After five turns the robot has moved five times as in one; and after many it was no other."""
    found = pair
    assert np.abs(found.multipliers(2)).max() < 1.0
    five = dj.rollout(found.scene, end=3.75, state=found.state, reverse_mode=False)
    five.raise_if_failed()
    x = np.asarray(five.positions[0])
    for _ in range(5):
        x = x @ found.turn.T + found.shift
    length = np.linalg.norm(np.ptp(x, axis=0))
    np.testing.assert_allclose(five.positions[-1], x, atol=1e-4 * length)
    assert float(five.head_angle[-1]) == pytest.approx(3.75 * found.head_rate, rel=1e-3)
    run = dj.rollout(found.scene, reverse_mode=False)
    last = jax.tree.map(lambda leaf: leaf[-1], run.states)
    again = dj.orbit(found.scene, last, steps=STEPS)
    assert again.iterations <= 1
    assert again.speed == pytest.approx(found.speed, rel=1e-5)
    assert again.head_rate == pytest.approx(found.head_rate, rel=1e-5)
    agree_with_differences(found.scene, again, ["separation"], 1e-3)


def test_derivatives_agree_with_differences_in_contact():
    """On the orbit on which flagella touch, and in which a simulation of a minute ends."""
    started = dj.orbit(touching(5, 60), steps=STEPS)
    run = dj.rollout(started.scene, frame=1.0, reverse_mode=False)
    found = dj.orbit(started.scene, run.last, steps=STEPS, tolerance=1e-9)
    assert np.abs(dj.forces(found.scene, found.state)["Contact"]).max() > 0.0
    slopes = found.derivatives(["C_t", "separation"])
    for name in slopes:
        value = float(found.scene.parameters[name])
        h = 1e-4 * value
        near = [
            dj.orbit(
                found.scene.replace(**{name: value + s * h}),
                found.state,
                steps=STEPS,
                tolerance=1e-10,
            )
            for s in (1, -1)
        ]
        for what in ("speed", "head_rate"):
            difference = (getattr(near[0], what) - getattr(near[1], what)) / (2 * h)
            assert slopes[name][what] == pytest.approx(difference, rel=1e-3)


@pytest.mark.parametrize(
    ("rpm", "message"),
    [([80.0, 79.0], "no period of at most 6 turns"), (0.0, "motors that turn")],
)
def test_motors_without_a_period_say_so(rpm, message):
    file = TINY | {"robot": TINY["robot"] | {"kind": "two_flagella"}, "motor": {"rpm": rpm}}
    with pytest.raises(dj.InputError, match=message):
        dj.orbit(dj.build(dj.SceneFile.from_dict(file)))


def test_names_that_are_no_numbers_are_told(alone):
    scene, found = alone
    with pytest.raises(KeyError, match="speed: no such parameter; the scene has C_r"):
        found.derivatives(["speed"])
    with pytest.raises(KeyError, match="no such parameter"):
        dj.branch(scene, "speed", 1.0)
    two = dj.build(
        dj.SceneFile.from_dict(
            TINY | {"robot": {"kind": "two_flagella"}, "motor": {"rpm": [60.0, 50.0]}}
        )
    )
    with pytest.raises(ValueError, match="rpm: has several values"):
        dj.branch(two, "rpm", 80.0)


@pytest.mark.parametrize(("rpm", "period"), [([80.0, 40.0], 1.5), ([60.0, 90.0], 2.0)])
def test_motors_at_simple_ratios_have_a_period(rpm, period):
    file = TINY | {"robot": TINY["robot"] | {"kind": "two_flagella"}, "motor": {"rpm": rpm}}
    assert period_of(dj.build(dj.SceneFile.from_dict(file))) == pytest.approx(period)


SIDE_BY_SIDE = f"""
[robot]
kind = "two_flagella"
edge_length = 0.02
helix_radius = 6.4e-3
pitch = 44.8e-3
separation = {SEPARATION}
[fluid]
hydrodynamics = "rft"
[motor]
rpm = 80.0
[time]
inertia = false
scheme = "trbdf2"
step = 0.015
end = 30.0
frame = 0.75
[contact]
method = "none"
"""


def test_the_command_follows_orbits_of_several_flagella(pair, tmp_path, capsys):
    """A row for each value with the numbers of its orbit; motors without a period are refused."""
    path, out = tmp_path / "scene.toml", tmp_path / "out"
    path.write_text(SIDE_BY_SIDE)
    argv = ["steady", str(path), "-o", str(out), "--vary", "separation=0.1,0.102"]
    assert main([*argv, "--stability", "--no-figures"]) == 0
    table = pd.read_csv(out / "steady.csv")
    assert list(table.status) == ["ok", "ok"]
    found = pair
    assert table.v_m_per_s[0] == pytest.approx(found.speed, rel=1e-4)
    assert table.growth_rate_per_s[0] == pytest.approx(
        np.log(np.abs(found.multipliers(2)[0])) / found.period, rel=1e-2
    )
    # Over a turn the power of both motors is dissipated by fluid and head.
    turn = found.one_turn()
    every = [jax.tree.map(lambda leaf, k=k: leaf[k], turn) for k in range(STEPS)]
    power = np.mean([dissipated(found.scene, state) for state in every])
    rate = float(found.scene.motor.rate[0, 0])
    assert 2.0 * table.torque_N_m[0] * rate == pytest.approx(power, rel=2e-2)
    path.write_text(path.read_text().replace("rpm = 80.0", "rpm = [80.0, 79.0]"))
    assert main([*argv, "--overwrite"]) == 2
    assert "no period of at most 6 turns" in capsys.readouterr().err
    assert list(pd.read_csv(out / "steady.csv").status) == ["ok", "ok"]


def dissipated(scene: dj.Scene, state: dj.State) -> float:
    """W, by drag on nodes and head."""
    forces = dj.forces(scene, state)
    n = 3 * scene.rod.topology.n_nodes
    drag = (forces["ResistiveDrag"] + forces["HeadDrag"]).ravel() @ state.velocity[:n]
    head = scene.rod.topology.edge_dofs(scene.rod.topology.head.edges)
    spin = float(scene[dj.HeadDrag].spin) * float(jnp.mean(state.velocity[head])) ** 2
    return spin - float(drag)
