"""How runs are divided into steps and frames where the scene file does not say."""

import pytest

from derjax.core.errors import InputError
from derjax.runs.sweeps.points import programs
from derjax.scenes.file import SceneFile
from derjax.scenes.load import load_scene
from derjax.scenes.timing import time_grid, usual_frame


def scene(**tables) -> SceneFile:
    return SceneFile.model_validate(tables)


@pytest.mark.parametrize(
    ("rpm", "frame"),
    [(60, 0.1), (100, 0.1), (-100, 0.1), (101, 0.05), (30, 0.2), (13_200, 5e-4), (0, 0.1)],
)
def test_a_turn_of_the_motor_has_at_least_six_frames(rpm, frame):
    file = scene(motor={"rpm": rpm})
    assert file.step * file.steps_per_frame == pytest.approx(frame, rel=1e-12)
    assert file.step == pytest.approx(frame / 2, rel=1e-12)
    assert file.n_frames * frame == pytest.approx(file.time.end, rel=1e-12)


def test_frames_scale_with_time():
    for exponent in range(-6, 7):
        scale = 10.0**exponent
        assert usual_frame(20 * scale, 60 / scale) == pytest.approx(0.1 * scale, rel=1e-12)


def test_the_fastest_motor_decides():
    rates = {"kind": "two_flagella"}
    assert scene(robot=rates, motor={"rpm": [30, -300]}).step == pytest.approx(0.01)


def test_the_motor_table_decides(tmp_path):
    (tmp_path / "motor.csv").write_text("time,rpm\n0,0\n5,-600\n20,60\n")
    (tmp_path / "scene.toml").write_text("[motor]\ntable = 'motor.csv'\n")
    assert load_scene(tmp_path / "scene.toml").step == pytest.approx(0.005)
    (tmp_path / "scene.toml").write_text("[motor]\ntable = 'motor.csv'\n[time]\nend = 1e8\n")
    (tmp_path / "motor.csv").write_text("time,rpm\n0,0\n1e8,600\n")
    with pytest.raises(
        InputError, match=r"scene.toml: \[time\] end = 1e\+08: .* steps are too many"
    ):
        load_scene(tmp_path / "scene.toml")


def test_any_end_will_do_without_a_step():
    grid = time_grid(0.2503, None, None, 60)
    assert grid.n_frames == 3
    assert grid.step * grid.steps_per_frame * grid.n_frames == pytest.approx(0.2503, rel=1e-12)


def test_a_slow_motor_leaves_frames_to_measure_with():
    grid = time_grid(20.0, None, None, 0.1)
    assert (grid.n_frames, grid.steps_per_frame, grid.step) == (2, 2, 5.0)
    grid = time_grid(20.0, 1e-6, None, 0.1)
    assert (grid.n_frames, grid.steps_per_frame) == (2, 10_000_000)


@pytest.mark.parametrize(("frame", "step"), [(0.05, 0.025), (0.1, 0.05), (1.0, 0.05), (0.3, 0.05)])
def test_a_frame_that_is_given_is_used(frame, step):
    """Steps are half of it, or less where it is longer than a sixth of a turn."""
    grid = time_grid(3.0, None, frame, 60)
    assert grid.step * grid.steps_per_frame == pytest.approx(frame, rel=1e-12)
    assert grid.step == pytest.approx(step, rel=1e-12)


@pytest.mark.parametrize("step", [1e-3, 0.05, 0.25])
def test_a_step_that_is_given_is_used(step):
    grid = time_grid(2.0, step, None, 600)
    assert grid.step == step
    assert grid.step * grid.steps_per_frame == pytest.approx(max(step, 0.01), rel=1e-12)


def test_points_with_frames_of_their_own_have_programs_of_their_own():
    def groups(*rates: float) -> int:
        robot = {"kind": "clamped", "n_flagella": 1, "shape": "straight", "edge_length": 0.03}
        files = {k: scene(robot=robot, motor={"rpm": rpm}) for k, rpm in enumerate(rates)}
        return len(programs(files)[0])

    assert groups(60.0, 70.0) == 1
    assert groups(60.0, 300.0) == 2
