"""Labelled trajectories, the numbers taken from them, their figures, and how files are written."""

import io
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from derjax import SceneFile, State, build
from derjax.core.pytree import replace
from derjax.io.files import atomic_path
from derjax.results import dataset as trajectory
from derjax.results import plots, summary
from derjax.rods.kinematics import angles, positions
from derjax.runs.progress import Progress

FILE = SceneFile.model_validate({"robot": {"edge_length": 0.03}, "motor": {"rpm": 90}})
SPEED, SPIN = -1e-3, -0.3


@pytest.fixture(scope="module")
def scene():
    return build(FILE)


@pytest.fixture(scope="module")
def states(scene) -> State:
    """A made-up motion: the robot glides along x and spins about it, whole turns taken out."""
    start = build(FILE).start
    topology = scene.rod.topology

    def at(time):
        turned = SPIN * time
        c, s = jnp.cos(turned), jnp.sin(turned)
        rotation = jnp.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])
        nodes = positions(topology, start.q) @ rotation.T + time * jnp.array([SPEED, 0, 0])
        turns = jnp.round(turned / (2 * jnp.pi))
        theta = jnp.full(topology.n_edges, turned - 2 * jnp.pi * turns)
        nodes_velocity = jnp.cross(jnp.array([SPIN, 0, 0]), positions(topology, start.q))
        nodes_velocity = nodes_velocity @ rotation.T + jnp.array([SPEED, 0, 0])
        spin = jnp.full(topology.n_edges, SPIN)
        return replace(
            start,
            q=jnp.concatenate([nodes.ravel(), theta]),
            velocity=jnp.concatenate([nodes_velocity.ravel(), spin]),
            turns=jnp.full(topology.n_edges, turns),
            time=time,
        )

    return jax.vmap(at)(jnp.linspace(0.0, 40.0, 81))


@pytest.fixture(scope="module")
def dataset(scene, states) -> xr.Dataset:
    return trajectory.to_dataset(scene, states, {"status": "ok"})


def test_every_variable_says_what_it_is(dataset):
    for name, variable in dataset.variables.items():
        assert variable.attrs["long_name"], name
        assert name == "axis" or variable.attrs["units"], name
    assert dataset.position.dims == ("time", "node", "axis")
    assert dataset.edge_angle.dims == ("time", "edge")
    assert list(dataset.axis.to_numpy()) == ["x", "y", "z"]


def test_values_are_those_of_the_states(dataset, scene, states):
    topology = scene.rod.topology
    np.testing.assert_array_equal(dataset.position, positions(topology, states.q))
    np.testing.assert_array_equal(dataset.velocity, positions(topology, states.velocity))
    np.testing.assert_array_equal(dataset.head_position, dataset.position.isel(node=0))
    np.testing.assert_array_equal(dataset.edge_end - dataset.edge_start, 1)
    assert np.abs(angles(topology, states.q)).max() <= math.pi + 1e-12
    np.testing.assert_allclose(dataset.head_angle, SPIN * dataset.time, rtol=1e-12)
    np.testing.assert_allclose(dataset.edge_angle[:, 3], SPIN * dataset.time, rtol=1e-12)


@pytest.mark.parametrize("end", [3e-6, 0.7, 30.0, 4e5])
def test_times_are_what_one_would_type(end):
    """Also after thousands of steps, however long or short they are."""
    n = 3000
    step = end / n
    time = np.cumsum(np.full(n, step))
    assert time[-1] != end
    rounded = trajectory.rounded(time)
    assert rounded[-1] == end
    assert rounded[n // 3 - 1] == pytest.approx(end / 3, rel=1e-9)
    np.testing.assert_allclose(rounded, time, rtol=0, atol=1e-9 * end)
    assert len(np.unique(rounded)) == n


def test_a_time_can_be_selected(scene, states):
    late = trajectory.to_dataset(scene, replace(states, time=states.time + 2e-12))
    assert late.sel(time=30.0).head_angle == late.head_angle[60]


def test_motor_has_turned_at_its_rate(dataset):
    rate = 90 * 2 * math.pi / 60
    np.testing.assert_allclose(dataset.motor_rate, rate, rtol=1e-14)
    np.testing.assert_allclose(dataset.motor_angle[:, 0], rate * dataset.time, rtol=1e-14)


def test_angular_velocity_is_that_of_the_rigid_motion(scene, states):
    """A head that tumbles about a tilted axis while it spins about its own."""
    topology = scene.rod.topology
    omega = np.array([0.3, -0.7, 0.5])
    nodes = positions(topology, states.q)
    velocity = jnp.cross(omega, nodes)
    along = nodes[:, 1] - nodes[:, 0]
    spin = (along @ omega) / jnp.linalg.norm(along, axis=1)
    moving = jnp.concatenate(
        [velocity.reshape(len(nodes), -1), jnp.tile(spin[:, None], topology.n_edges)], axis=1
    )
    dataset = trajectory.to_dataset(scene, replace(states, velocity=moving))
    np.testing.assert_allclose(
        dataset.head_angular_velocity, np.tile(omega, (len(nodes), 1)), atol=1e-12
    )


def test_file_opens_in_one_line_and_holds_the_scene(dataset, tmp_path):
    trajectory.write(dataset, tmp_path / "trajectory.nc")
    with xr.open_dataset(tmp_path / "trajectory.nc") as read:
        xr.testing.assert_identical(read.load(), dataset)
        assert read.attrs["C_t"] == FILE.head.C_t
        assert json.loads(read.attrs["scene_json"])["robot"]["edge_length"] == 0.03
        assert read.attrs["derjax_version"]
    assert [path.name for path in tmp_path.iterdir()] == ["trajectory.nc"]


def test_summary_of_a_steady_motion(dataset):
    numbers = summary.summarise(dataset)
    assert numbers["window_s"] == [20.0, 40.0]
    assert numbers["v_x_m_per_s"] == pytest.approx(SPEED, rel=1e-10)
    assert numbers["head_rate_rad_per_s"] == pytest.approx(SPIN, rel=1e-10)
    assert numbers["head_rate_lab_x_rad_per_s"] == pytest.approx(SPIN, rel=1e-10)
    nodes = build(FILE).start.q[: 3 * dataset.sizes["node"]].reshape(-1, 3)
    assert numbers["tail_to_head_m"] == pytest.approx(float(jnp.linalg.norm(nodes[-1] - nodes[0])))
    size, (c_t, c_r) = FILE.robot.head_radius, (FILE.head.C_t, FILE.head.C_r)
    assert numbers["propulsive_force_N"] == pytest.approx(6 * math.pi * size * c_t * SPEED)
    expected = 0.75 * c_t / c_r * abs(SPEED) / (size * abs(SPIN))
    assert numbers["efficiency"] == pytest.approx(expected)


def test_summary_says_none_where_it_cannot_know(dataset):
    undragged = dataset.drop_vars([name for name in dataset if "drag" in str(name)])
    numbers = summary.summarise(undragged)
    assert numbers["v_x_m_per_s"] is not None
    assert numbers["propulsive_force_N"] is None
    assert numbers["efficiency"] is None
    headless = dataset.drop_vars([name for name in dataset if str(name).startswith("head_")])
    assert all(summary.summarise(headless)[name] is None for name in summary.NAMES)
    short = dataset.isel(time=[0])
    assert all(summary.summarise(short)[name] is None for name in summary.NAMES)
    still = dataset.assign(head_angle=0.0 * dataset.head_angle)
    assert summary.summarise(still)["efficiency"] is None


def test_summary_file_is_plain_json(tmp_path):
    path = tmp_path / "summary.json"
    summary.write({"a": math.nan, "b": [math.inf, 1.0], "c": {"d": np.array([1.0, 2.0])}}, path)
    assert json.loads(path.read_text()) == {"a": None, "b": [None, 1.0], "c": {"d": [1.0, 2.0]}}


def test_figures(dataset):
    for figure in (plots.track(dataset), plots.shape(dataset), plots.speed(dataset)):
        assert figure is not None
        picture = io.BytesIO()
        figure.savefig(picture, format="png", dpi=40)
        assert picture.getvalue().startswith(b"\x89PNG")
    start = dataset.isel(time=[0])
    assert plots.track(start) is None
    assert plots.speed(start) is None
    assert len(plots.shape(start).axes) == 1


def test_atomic_path_replaces_on_success_only(tmp_path):
    path = tmp_path / "file.txt"
    with atomic_path(path) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".txt"
        temporary.write_text("first")
        assert not path.exists()

    def fail() -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("second")
            raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        fail()
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress():
    terminal = Terminal()
    with Progress(2.0, "simulated s", stream=terminal) as progress:
        progress.update(1.0)
    assert "1 of 2 simulated s" in terminal.getvalue()
    elsewhere = io.StringIO()
    with Progress(200, "frames", done=50, stream=elsewhere) as progress:
        progress.update(100)
        assert progress.line(100, 2.0) == "100 of 200 frames (50 %), 25 frames/s, 4 s left"
    assert elsewhere.getvalue() == ""
    with Progress(200, "frames", quiet=True, stream=terminal) as progress:
        before = terminal.getvalue()
        progress.update(100)
    assert terminal.getvalue() == before
