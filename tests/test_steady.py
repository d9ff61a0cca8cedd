"""Steady states: what long simulations end in, exact derivatives, modes, and thresholds."""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from helpers import rotation

import derjax as dj
from derjax.commands.main import main
from derjax.core.pytree import replace
from derjax.steady.stability import linearisation

TINY = {
    "robot": {"edge_length": 0.02, "helix_radius": 6.4e-3, "pitch": 31.8e-3},
    "fluid": {"hydrodynamics": "rft"},
    "motor": {"rpm": 80.0},
    "time": {"inertia": False},
}
FILE = dj.SceneFile.from_dict(TINY)

STEPS = {"inertia": False, "scheme": "trbdf2", "step": 0.005, "end": 14.0, "frame": 0.05}
SECOND_ORDER = dj.SceneFile.from_dict(TINY | {"time": STEPS})


@pytest.fixture(scope="module")
def swimming() -> dj.Steady:
    state = dj.steady(dj.build(FILE))
    state.raise_if_failed()
    return state


def test_the_forces_of_the_fluid_and_of_the_rod_balance(swimming):
    """On every node; drag alone has no resultant, neither force nor torque."""
    forces = dj.forces(swimming.scene, swimming.state)
    total = sum(forces.values())
    scale = np.abs(forces["ResistiveDrag"]).max()
    np.testing.assert_allclose(total, 0.0, atol=1e-6 * scale)
    drag = forces["ResistiveDrag"] + forces["HeadDrag"]
    np.testing.assert_allclose(np.sum(drag, axis=0), 0.0, atol=1e-7 * scale)


def test_a_long_simulation_ends_in_it(swimming):
    """Speed along the axis and rate of the head, with steps of second order."""
    run = dj.rollout(dj.build(SECOND_ORDER), end=14.0, reverse_mode=False)
    run.raise_if_failed()
    time, x = np.asarray(run.time), np.asarray(run.head_position)
    late = time > 7.0
    turning = float(np.linalg.norm(swimming.motion.rotation)) * time[late]
    waves = np.stack([time[late], np.ones(late.sum()), np.cos(turning), np.sin(turning)], axis=1)
    path = np.linalg.lstsq(waves, x[late])[0][0]
    rate = np.polyfit(time[late], np.asarray(run.head_angle)[late], 1)[0]
    assert np.linalg.norm(path) == pytest.approx(abs(float(swimming.speed)), rel=1e-4)
    assert rate == pytest.approx(float(swimming.head_rate), rel=1e-4)


def test_it_does_not_depend_on_where_the_robot_is_and_how_it_is_turned(swimming):
    """Nor on what the state is measured from."""
    scene = swimming.scene
    turn = np.asarray(rotation([1.0, 2.0, -0.5], 0.8))
    start = scene.start
    x = dj.positions(scene.rod.topology, start.q) @ turn.T + jnp.array([0.1, -0.2, 0.05])
    n = 3 * scene.rod.topology.n_nodes
    moved = replace(
        start,
        q=jnp.concatenate([x.ravel(), start.q[n:]]),
        reference_director=start.reference_director @ turn.T,
    )
    other = dj.steady(replace(scene, initial=moved))
    other.raise_if_failed()
    for name in ("speed", "head_rate", "tail_to_head"):
        np.testing.assert_allclose(getattr(other, name), getattr(swimming, name), rtol=1e-6)


NAMES = (
    *("C_t", "C_r", "youngs_modulus", "viscosity"),
    *("pitch", "helix_radius", "regularization", "rpm"),
)
STOKESLETS = dj.build(dj.SceneFile.from_dict(TINY | {"fluid": {"hydrodynamics": "rss"}}))
NUMBERS = jnp.stack([STOKESLETS.parameters[name] for name in NAMES])


def quantities(parts: jax.Array) -> jax.Array:
    """Speed, head rate and length of a robot whose numbers are parts of those it was built with."""
    state = dj.steady(STOKESLETS.replace(**dict(zip(NAMES, parts * NUMBERS, strict=True))))
    return jnp.stack([1e3 * state.speed, state.head_rate, 10.0 * state.tail_to_head])


@pytest.mark.slow
def test_derivatives_forward_and_reverse_agree_with_differences():
    """By all that a fit or a design may change, against differences of fourth order."""
    at, h = jnp.ones(len(NAMES)), 3e-3
    forward = jax.jit(jax.jacfwd(quantities))(at)
    reverse = jax.jit(jax.jacrev(quantities))(at)
    evaluate = jax.jit(quantities)

    def difference(way: jax.Array) -> jax.Array:
        near, far = (evaluate(at + k * h * way) - evaluate(at - k * h * way) for k in (1, 2))
        return (8.0 * near - far) / (12.0 * h)

    each = jnp.stack([difference(way) for way in jnp.eye(len(NAMES))], axis=1)
    np.testing.assert_allclose(forward, each, rtol=1e-6, atol=1e-6 * jnp.abs(each).max())
    np.testing.assert_allclose(reverse, forward, rtol=1e-8, atol=1e-10)


def test_a_motor_that_stands_still_leaves_the_robot_at_rest():
    state = dj.steady(dj.build(FILE, {"rpm": 0.0}))
    assert state.ok
    np.testing.assert_allclose(state.motion.velocity, 0.0, atol=1e-12)
    start = dj.positions(state.scene.rod.topology, state.scene.start.q)
    np.testing.assert_allclose(state.positions, start, atol=1e-12)


def test_rigid_motions_are_modes_of_the_linearisation(swimming):
    """0, 0 and twice +-i |Omega|: pairs of equal ones to the root of rounding."""
    assert dj.stability(swimming).rigid_error < 1e-5


THIN = {"rpm": 60.0, "viscosity": 0.3, "youngs_modulus": 4e5}
"""A fluid in which masses count."""


@pytest.mark.slow
def test_masses_count_in_how_displacements_decay():
    """Rigid motions are modes, and the slowest is what the last of a simulation is made of."""
    file = dj.SceneFile.from_dict(TINY | {"time": STEPS | {"inertia": True, "end": 6.0}})
    scene = dj.build(file, THIN)
    state = dj.steady(scene)
    found = dj.stability(state)
    assert found.rigid_error < 1e-5
    mode = np.asarray(found.modes[0]).real
    near = replace(state.state, q=state.state.q + 1e-3 * mode / np.abs(mode).max())
    run = dj.rollout(scene, state=near, reverse_mode=False)
    run.raise_if_failed()
    x, there = np.asarray(run.positions), np.asarray(state.positions)
    lengths = np.linalg.norm(x[:, 2:] - x[:, :1], axis=-1)
    away = (lengths - np.linalg.norm(there[2:] - there[0], axis=-1))[40:]
    # What takes one frame to the next, in the four directions that are left (dynamic mode
    # decomposition: Schmid, J. Fluid Mech. 656, 5, 2010).
    u, s, v = np.linalg.svd(away[:-1].T, full_matrices=False)
    step = u[:, :4].T @ away[1:].T @ v[:4].T / s[:4]
    seen = np.log(np.linalg.eigvals(step).astype(complex)) / STEPS["frame"]
    value = found.eigenvalues[0]
    assert np.min(np.abs(seen - value)) < 1e-3 * abs(value.real)
    light = dj.stability(dj.steady(dj.build(FILE, THIN))).eigenvalues[0]
    assert abs(light.real - value.real) > 5e-3 * abs(value.real)  # else it would say nothing


def test_modes_balance_drag_and_stiffness(swimming):
    """-J xi = lambda D xi on all degrees of freedom, those without drag among them."""
    found, matrices = dj.stability(swimming), linearisation(swimming)
    stiffness, drag = np.asarray(matrices.stiffness), np.asarray(matrices.drag)
    free = swimming.scene.rod.topology.free_dofs
    for value, right, left in zip(found.eigenvalues, found.modes, found.left, strict=True):
        xi, w = right[free], left[free].conj()
        for matrix, vector in ((stiffness, xi), (stiffness.T, w)):
            other = drag if matrix is stiffness else drag.T
            size = np.abs(matrix) @ np.abs(vector) + abs(value) * (np.abs(other) @ np.abs(vector))
            assert np.all(np.abs(matrix @ vector + value * (other @ vector)) <= 1e-8 * size.max())
    # As many as there are degrees of freedom with drag, but for rigid motions.
    pairs = np.sum(found.eigenvalues.imag > 0.0)
    dragged = np.any(drag, axis=0) | np.any(drag, axis=1)
    assert len(found.eigenvalues) + pairs == np.sum(dragged) - 6


def test_the_slowest_mode_is_how_a_simulation_settles(swimming):
    """A small displacement along it decays with its growth rate."""
    found = dj.stability(swimming)
    assert found.is_stable
    mode = np.asarray(found.modes[0])
    mode = mode.real / np.abs(mode.real).max()
    start = replace(swimming.state, q=swimming.state.q + 1e-3 * jnp.asarray(mode))
    run = dj.rollout(replace(dj.build(SECOND_ORDER), initial=start), end=2.0, reverse_mode=False)
    run.raise_if_failed()
    length = np.linalg.norm(run.positions[:, -1] - run.positions[:, 0], axis=1)
    part = np.asarray(run.time) > 0.5  # fast modes are gone
    away, time = length[part] - float(swimming.tail_to_head), np.asarray(run.time)[part]
    value = found.eigenvalues[0]
    waves = np.exp(value.real * time)[:, None] * np.stack(
        [np.cos(value.imag * time), np.sin(value.imag * time)], axis=1
    )
    weights = np.linalg.lstsq(waves, away)[0]
    assert np.linalg.norm(waves @ weights - away) < 0.03 * np.linalg.norm(away)


@pytest.mark.slow
def test_the_threshold_scales_as_dimensions_say():
    """The buckling rate goes as E / mu: its logarithmic derivatives are 1 and -1."""
    scene = dj.build(FILE, {"rpm": 200.0})
    found = dj.threshold(scene)
    assert abs(found.stability.growth_rate) < 1e-6
    slopes = found.derivatives(["youngs_modulus", "viscosity"])
    assert slopes["youngs_modulus"] * 1.255e6 == pytest.approx(found.value, rel=1e-5)
    assert -slopes["viscosity"] == pytest.approx(found.value, rel=1e-5)


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"robot": {"kind": "two_flagella"}}, "2 motors turn"),
        ({"solver": {"method": "blocks"}}, "blocks"),
    ],
)
def test_what_cannot_be_steady_says_so(tables, message):
    file = dj.SceneFile.from_dict(TINY | tables)
    with pytest.raises(dj.InputError, match=message):
        dj.steady(dj.build(file))


HELD = {"robot": TINY["robot"] | {"kind": "clamped", "n_flagella": 1}}
HEAVY = {"fluid": {"hydrodynamics": "rft", "fluid_density": 1250.0}}


@pytest.mark.slow
@pytest.mark.parametrize(
    "tables",
    [
        pytest.param({"motor": {"rpm": 80.0, "hinge": "published"}}, id="limp once a turn"),
        pytest.param(
            HELD | HEAVY | {"gravity": {"acceleration": [0.0, 0.0, -9.81]}}, id="held, and heavy"
        ),
    ],
)
def test_forces_that_change_as_the_shape_turns_are_noticed(tables):
    """At one moment they balance, which says nothing of the next."""
    state = dj.steady(dj.build(dj.SceneFile.from_dict(TINY | tables)))
    assert state.status == dj.Status.NOT_STEADY
    with pytest.raises(dj.SolverError, match="has no steady state"):
        state.raise_if_failed()


@pytest.mark.slow
def test_a_robot_that_is_heavier_than_the_fluid_swims_and_sinks(swimming):
    """Along gravity, up or down; the sum of both speeds is twice that without."""
    speeds = []
    for direction in (-1.0, 1.0):
        gravity = {"gravity": {"acceleration": [9.81 * direction, 0.0, 0.0]}}
        state = dj.steady(dj.build(dj.SceneFile.from_dict(TINY | HEAVY | gravity)))
        state.raise_if_failed()
        forces = dj.forces(state.scene, state.state)
        drag = forces["ResistiveDrag"] + forces["HeadDrag"]
        assert np.sum(forces["Gravity"][:, 0]) * direction > 0.0
        np.testing.assert_allclose(
            np.sum(drag + forces["Gravity"], axis=0), 0.0, atol=1e-6 * np.abs(drag).max()
        )
        speeds.append(float(state.motion.velocity[0]))
    assert speeds[0] < 0.0 < speeds[1]
    assert np.mean(speeds) == pytest.approx(float(swimming.speed), rel=1e-3)


@pytest.mark.slow
def test_a_branch_is_followed_around_a_fold():
    """Beyond the fold there is no steady state; before it there are two."""
    scene = dj.build(FILE, {"rpm": 585.0})
    branch = dj.branch(scene, "rpm", 620.0)
    assert (branch.complete, branch.message) == (True, "came back to the start")
    (fold,) = branch.folds
    assert all(state.ok for state in branch.states)
    assert np.all(np.diff(branch.values)[:fold] > 0.0)
    assert np.all(np.diff(branch.values)[fold:] < 0.0)
    first, before, last = (branch.states[k] for k in (0, fold - 1, -1))
    assert branch.values[-1] == pytest.approx(585.0, rel=1e-9)
    assert float(last.speed) != pytest.approx(float(first.speed), rel=1e-3)
    for part, found in ((0.999, True), (1.001, False)):
        value = part * branch.values[fold]
        assert dj.steady(scene.replace(rpm=value), guess=before).ok == found


def test_a_curve_finds_the_same_states_as_one_by_one(swimming):
    """Also where a value comes twice; a name that is no number is told before anything is done."""
    curve = list(dj.steady_curve(swimming.scene, "rpm", [60.0, 70.0, 70.0, 80.0]))
    assert all(state.ok for state in curve)
    assert float(curve[1].speed) == pytest.approx(float(curve[2].speed), rel=1e-9)
    assert float(curve[-1].speed) == pytest.approx(float(swimming.speed), rel=1e-7)
    with pytest.raises(KeyError, match="no such parameter"):
        dj.steady_curve(swimming.scene, "speed", [1.0])


@pytest.mark.slow
def test_along_a_branch_a_change_of_stability_is_located():
    branch = dj.branch(dj.build(FILE, {"rpm": 120.0}), "rpm", 280.0)
    assert branch.complete
    growth = branch.growth_rates()
    assert growth[0] < 0.0 < growth[-1]
    (found,) = branch.thresholds()
    assert abs(found.stability.growth_rate) < 1e-7
    assert found.value == pytest.approx(dj.threshold(dj.build(FILE, {"rpm": 200.0})).value)


def test_failure_names_the_rate_that_was_reached():
    state = replace(dj.steady(dj.build(FILE)), status=jnp.array(1), motor_rate=jnp.array(1.0))
    with pytest.raises(dj.SolverError, match=r"beyond 9\.5493 rpm"):
        state.raise_if_failed()


@pytest.mark.slow
def test_a_filament_on_a_fixed_motor_turns_about_its_axis():
    """With the rate of the motor; and its simulation ends there."""
    tables = TINY | {"robot": TINY["robot"] | {"kind": "clamped", "n_flagella": 1}}
    scene = dj.build(dj.SceneFile.from_dict(tables | {"motor": {"rpm": 60.0}}))
    state = dj.steady(scene)
    state.raise_if_failed()
    np.testing.assert_allclose(state.motion.rotation, [2 * np.pi, 0.0, 0.0], rtol=1e-12, atol=1e-12)
    stepped = dj.build(dj.SceneFile.from_dict(tables | {"motor": {"rpm": 60.0}, "time": STEPS}))
    run = dj.rollout(stepped, end=6.0, reverse_mode=False)
    run.raise_if_failed()
    end = np.linalg.norm(run.positions[-1, -1] - run.positions[-1, 0])
    assert end == pytest.approx(float(state.tail_to_head), rel=1e-5)


SCENE = """
[robot]
edge_length = 0.02
pitch = 31.8e-3
[fluid]
hydrodynamics = "rft"
[time]
inertia = false
"""


@pytest.mark.slow
def test_the_command_finds_a_curve_its_threshold_and_goes_on(tmp_path, capsys):
    """From `--vary` to table, shapes and figures; what is there is kept, and added to."""
    path, out = tmp_path / "scene.toml", tmp_path / "out"
    path.write_text(SCENE)
    argv = ["steady", str(path), "-o", str(out), "--stability", "--vary"]
    assert main([*argv, "rpm=60:180:60"]) == 0
    table = pd.read_csv(out / "steady.csv")
    assert table.columns[0] == "rpm"
    assert list(table.rpm) == [60.0, 120.0, 180.0]
    assert {p.name for p in out.glob("*.png")} == {"curves.png", "shapes.png", "mode.png"}
    state = dj.steady(dj.build(dj.load_scene(path), {"rpm": 120.0}))
    assert table.v_m_per_s[1] == pytest.approx(float(state.speed), rel=1e-7)
    # All of the motor's power is dissipated: torque times rate against drag on nodes and head.
    forces, velocity = dj.forces(state.scene, state.state), state.state.velocity
    n = 3 * state.scene.rod.topology.n_nodes
    drag = (forces["ResistiveDrag"] + forces["HeadDrag"]).ravel() @ velocity[:n]
    spin = float(state.scene[dj.HeadDrag].spin) * float(state.head_rate) ** 2
    assert table.torque_N_m[1] * float(state.motor_rate) == pytest.approx(
        float(spin - drag), rel=1e-6
    )
    assert main([*argv, "rpm=60:180:60"]) == 2
    assert "exists already" in capsys.readouterr().err
    assert main([*argv, "rpm=60:180:40", "--resume"]) == 0
    assert list(pd.read_csv(out / "steady.csv").rpm) == [60.0, 100.0, 120.0, 140.0, 180.0]
    shapes = xr.load_dataset(out / "steady.nc")
    assert shapes.position.shape == (4, state.scene.rod.topology.n_nodes, 3)


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ("rpm=10:", "should be like"),
        ("speed=1,2", "no such number; the scene has"),
        ("rpm=1,1", "given twice"),
        ("pitch=-0.1", "pitch"),
    ],
)
def test_wrong_values_are_named_and_leave_nothing(tmp_path, capsys, vary, message):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    assert main(["steady", str(path), "-o", str(tmp_path / "out"), "--vary", vary]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
