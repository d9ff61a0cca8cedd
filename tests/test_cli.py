"""The command line, from arguments to files and exit codes."""

import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import jax
import pytest
import xarray as xr

from derjax.commands.main import main
from derjax.core import runtime
from derjax.runs import simulation
from derjax.runs.progress import Progress

SCENE = """
[robot]
edge_length = 0.03
[fluid]
hydrodynamics = "rft"
[time]
step = 0.01
end = 0.5
frame = 0.05
"""
RESULTS = {"trajectory.nc", "summary.json", "track.png", "shape.png", "speed.png"}


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    return path


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a scene and, in `out`, of its uninterrupted run."""
    directory = tmp_path_factory.mktemp("finished")
    (directory / "scene.toml").write_text(SCENE)
    assert main(["simulate", str(directory / "scene.toml"), "-o", str(directory / "out")]) == 0
    return directory


def contents(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir()}


def summary_of(directory: Path) -> dict:
    return json.loads((directory / "summary.json").read_text())


def interrupt_after(monkeypatch: pytest.MonkeyPatch, time: float) -> None:
    """Ctrl-C when the simulation has come to some time (s)."""

    def update(self: Progress, done: float) -> None:
        if done == pytest.approx(time):
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Progress, "update", update)


def assert_same_trajectory(one: Path, other: Path) -> None:
    """Bit by bit."""
    with (
        xr.open_dataset(one / "trajectory.nc") as a,
        xr.open_dataset(other / "trajectory.nc") as b,
    ):
        assert set(a.variables) == set(b.variables)
        for name in a.variables:
            assert a[name].to_numpy().tobytes() == b[name].to_numpy().tobytes(), name


def test_version_of_the_module():
    command = [sys.executable, "-m", "derjax", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("derjax ")


def test_help_lists_the_commands(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["--help"])
    assert caught.value.code == 0
    said = capsys.readouterr().out
    assert "simulate a scene file" in said
    assert "write a commented example" in said


@pytest.mark.parametrize("argv", [[], ["swim"], ["simulate"], ["simulate", "a.toml"]])
def test_wrong_arguments(argv, capsys):
    with pytest.raises(SystemExit) as caught:
        main(argv)
    assert caught.value.code == 2
    assert "usage: derjax" in capsys.readouterr().err


def test_simulate_writes_trajectory_summary_and_figures(finished):
    out = finished / "out"
    assert {path.name for path in out.iterdir()} == RESULTS
    with xr.open_dataset(out / "trajectory.nc") as trajectory:
        assert trajectory.sizes["time"] == 11
        assert float(trajectory.time[3]) == 0.15
        assert trajectory.attrs["scene"] == SCENE
        assert trajectory.attrs["status"] == "ok"
        assert trajectory.attrs["command"].startswith("derjax simulate ")
    summary = summary_of(out)
    assert summary["status"] == "ok"
    assert summary["time_s"] == pytest.approx(0.5)
    assert summary["steps"] == 50
    assert summary["newton_iterations"] >= 50
    assert summary["worst_residual"] < 1e-6
    assert summary["wall_time_s"] > 0
    assert summary["window_s"] == [0.25, 0.5]
    assert summary["head_rate_rad_per_s"] < 0  # against the flagellum
    assert summary["propulsive_force_N"] * summary["v_x_m_per_s"] > 0
    assert summary["efficiency"] > 0
    assert summary["parameters"]["C_t"] == 4.8


def test_results_are_not_overwritten_unless_asked(finished, capsys):
    out = finished / "out"
    before = contents(out)
    argv = ["simulate", str(finished / "scene.toml"), "-o", str(out)]
    assert main(argv) == 2
    said = capsys.readouterr().err
    assert str(out / "trajectory.nc") in said
    assert "--overwrite" in said
    assert main([*argv, "--resume"]) == 2
    assert "nothing to resume" in capsys.readouterr().err
    assert contents(out) == before
    assert main([*argv, "--overwrite", "--quiet", "--no-figures"]) == 0
    assert capsys.readouterr() == ("", "")
    assert contents(out)["summary.json"] != before["summary.json"]
    assert contents(out)["track.png"] == before["track.png"]


def test_interrupted_and_resumed_is_the_same_bit_by_bit(scene, finished, monkeypatch, capsys):
    out = scene.parent / "out"
    argv = ["simulate", str(scene), "-o", str(out), "--no-figures"]
    with monkeypatch.context() as patch:
        interrupt_after(patch, 0.2)
        assert main(argv) == 130
    said = capsys.readouterr().err
    resume = f"derjax simulate {scene} -o {out} --resume --no-figures"
    assert resume in said
    assert "t = 0.2 of 0.5 s" in said
    summary = summary_of(out)
    assert summary["status"] == "interrupted"
    assert resume in summary["message"]
    assert summary["steps"] == 20
    with xr.open_dataset(out / "trajectory.nc") as trajectory:
        assert trajectory.sizes["time"] == 5
    before = contents(out)

    assert main(argv) == 2
    assert "--resume continues it" in capsys.readouterr().err
    scene.write_text(SCENE + "[head]\nC_t = 5\n")
    assert main([*argv, "--resume"]) == 2
    assert "[head] C_t was 4.8, is 5.0" in capsys.readouterr().err
    assert contents(out) == before

    scene.write_text(SCENE + "# a remark changes nothing\n")
    with monkeypatch.context() as patch:
        interrupt_after(patch, 0.35)
        assert main(resume.split()[1:]) == 130
    assert main(resume.split()[1:]) == 0
    assert {path.name for path in out.iterdir()} == {"trajectory.nc", "summary.json"}
    assert_same_trajectory(out, finished / "out")
    ours, theirs = summary_of(out), summary_of(finished / "out")
    for name in ("v_x_m_per_s", "steps", "newton_iterations", "worst_residual", "status"):
        assert ours[name] == theirs[name]


def test_a_killed_run_resumes_from_its_last_checkpoint(scene, finished, monkeypatch):
    out = scene.parent / "out"
    argv = ["simulate", str(scene), "-o", str(out), "--no-figures"]

    def update(self: Progress, done: float) -> None:
        if done == pytest.approx(0.3):
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Progress, "update", update)
        patch.setattr(simulation, "SECONDS_BETWEEN_SAVES", 0.0)
        assert main(argv) == 130
    assert [path.name for path in out.iterdir()] == ["checkpoint.npz"]
    assert main([*argv, "--resume"]) == 0
    assert_same_trajectory(out, finished / "out")


def test_interrupted_while_compiling(scene, monkeypatch, capsys):
    def compile_frame(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(simulation, "compile_frame", compile_frame)
    assert main(["simulate", str(scene), "-o", str(scene.parent / "out")]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert not (scene.parent / "out").exists()


def test_terminated_is_interrupted(scene, monkeypatch, capsys):
    """SIGTERM, by which queues end jobs, at a moment at which nothing can be saved."""

    def compile_frame(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(simulation, "compile_frame", compile_frame)
    assert main(["simulate", str(scene), "-o", str(scene.parent / "out")]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def full_disk(monkeypatch: pytest.MonkeyPatch, *suffixes: str, times: int = 1000) -> None:
    """Leaves no room for files with some suffixes, the first so many times."""
    left = dict.fromkeys(suffixes, times)
    replace = os.replace

    def refuse(old: Path, new: Path) -> None:
        if left.get(Path(new).suffix, 0):
            left[Path(new).suffix] -= 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(old, new)

    monkeypatch.setattr("derjax.io.files.os.replace", refuse)


def test_a_full_disk_does_not_stop_a_run(scene, finished, monkeypatch, capsys):
    """It goes on, says so once, and ends well when there is room again."""
    out = scene.parent / "out"
    monkeypatch.setattr(simulation, "SECONDS_BETWEEN_SAVES", 0.0)
    full_disk(monkeypatch, ".npz", times=4)
    assert main(["simulate", str(scene), "-o", str(out), "--no-figures"]) == 0
    said = capsys.readouterr().err
    warning = f"{out / 'checkpoint.npz'}: cannot be written: No space left on device"
    assert said.count(warning) == 1
    assert {path.name for path in out.iterdir()} == {"trajectory.nc", "summary.json"}
    assert_same_trajectory(out, finished / "out")


def test_what_a_full_disk_does_not_take_is_kept(scene, finished, monkeypatch, capsys):
    out = scene.parent / "out"
    argv = ["simulate", str(scene), "-o", str(out), "--no-figures"]
    with monkeypatch.context() as patch:
        full_disk(patch, ".nc")
        assert main(argv) == 2
    said = capsys.readouterr().err
    assert f"{out / 'trajectory.nc'}: cannot be written: No space left on device" in said
    assert f"What was computed is in {out / 'checkpoint.npz'}; resume with: derjax" in said
    assert main([*argv, "--resume"]) == 0
    assert_same_trajectory(out, finished / "out")


def test_a_checkpoint_finds_another_place(scene, finished, monkeypatch, tmp_path, capsys):
    """Where neither results nor a checkpoint can be written; the advice works when followed."""
    out = scene.parent / "out"
    argv = ["simulate", str(scene), "-o", str(out), "--no-figures"]
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with monkeypatch.context() as patch:
        full_disk(patch, ".nc")
        full_disk(patch, ".npz", times=1)
        assert main(argv) == 2
    said = capsys.readouterr().err
    (kept,) = tmp_path.glob("derjax-*/checkpoint.npz")
    resume = f"derjax simulate {scene} -o {kept.parent} --resume --no-figures"
    assert f"{kept}; resume with: {resume}" in said
    assert main(resume.split()[1:]) == 0
    assert_same_trajectory(kept.parent, finished / "out")


def test_interrupted_on_a_full_disk(scene, monkeypatch, tmp_path, capsys):
    out = scene.parent / "out"
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    full_disk(monkeypatch, ".npz", times=1)
    interrupt_after(monkeypatch, 0.2)
    assert main(["simulate", str(scene), "-o", str(out), "--no-figures"]) == 130
    (kept,) = tmp_path.glob("derjax-*/checkpoint.npz")
    assert f"interrupted. What was computed is in {kept}; resume with: " in capsys.readouterr().err


def test_results_that_appear_meanwhile_are_not_replaced(scene, monkeypatch, capsys):
    out = scene.parent / "out"

    def update(self: Progress, done: float) -> None:
        (out / "summary.json").write_text("another's")

    monkeypatch.setattr(Progress, "update", update)
    assert main(["simulate", str(scene), "-o", str(out), "--no-figures"]) == 2
    said = capsys.readouterr().err
    assert f"{out / 'summary.json'}: was written by another program" in said
    assert f"What was computed is in {out / 'checkpoint.npz'}" in said
    assert (out / "summary.json").read_text() == "another's"
    assert {path.name for path in out.iterdir()} == {"summary.json", "checkpoint.npz"}


def test_two_runs_into_one_directory(scene, monkeypatch, capsys):
    out = scene.parent / "out"
    argv = ["simulate", str(scene), "-o", str(out), "--no-figures", "--quiet"]
    codes = []

    def update(self: Progress, done: float) -> None:
        if not codes:
            codes.append(main([*argv, "--overwrite"]))

    monkeypatch.setattr(Progress, "update", update)
    assert main(argv) == 0
    assert codes == [2]
    assert f"{out}: process {os.getpid()} on" in capsys.readouterr().err


@pytest.mark.parametrize("what", [b"", b"not a checkpoint"])
def test_nothing_to_resume(scene, what, capsys):
    out = scene.parent / "out"
    argv = ["simulate", str(scene), "-o", str(out), "--resume"]
    assert main(argv) == 2
    assert str(out / "checkpoint.npz") in capsys.readouterr().err
    assert not out.exists()
    out.mkdir()
    (out / "checkpoint.npz").write_bytes(what)
    assert main(argv) == 2
    assert "not a checkpoint" in capsys.readouterr().err
    assert contents(out) == {"checkpoint.npz": what}


def test_failed_newton_keeps_what_was_computed(scene, capsys):
    scene.write_text(SCENE + "[motor]\ntable = 'motor.csv'\n[solver]\nmax_iterations = 1\n")
    (scene.parent / "motor.csv").write_text("time,rpm\n0,0\n0.2,0\n0.201,20000\n1,20000\n")
    out = scene.parent / "out"
    assert main(["simulate", str(scene), "-o", str(out)]) == 2
    said = capsys.readouterr().err
    for part in (
        str(scene),
        "t = 0.2 s failed",
        "scaled residual",
        "smaller [time] step",
        str(out),
    ):
        assert part in said
    summary = summary_of(out)
    assert summary["status"] == "max_iterations"
    assert "t = 0.2 s" in summary["message"]
    assert summary["steps"] == 20
    with xr.open_dataset(out / "trajectory.nc") as trajectory:
        assert float(trajectory.time[-1]) == 0.2
        assert trajectory.attrs["status"] == "max_iterations"
        assert trajectory.attrs["motor_table"].startswith("time,rpm")
    assert not (out / "checkpoint.npz").exists()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[robot]\nhelix_radius = 6.4", "did you mean 0.0064?"),
        ("[robot]\npitch = 0", "[robot] pitch"),
        ("[robot]\nptich = 1", "Did you mean 'pitch'?"),
        ("[fluid]\nviscosity = nan", "[fluid] viscosity"),
        ("[robot", "line 1"),
        ("[motor]\ntable = 'none.csv'", "none.csv: no such file"),
    ],
)
def test_bad_input_writes_nothing(scene, text, expected, capsys):
    scene.write_text(text)
    out = scene.parent / "out"
    out.mkdir()
    (out / "keep.txt").write_text("mine")
    assert main(["simulate", str(scene), "-o", str(out), "--overwrite"]) == 2
    said = capsys.readouterr().err
    assert str(scene) in said
    assert expected in said
    assert contents(out) == {"keep.txt": b"mine"}


def test_output_that_is_a_file(scene, capsys):
    assert main(["simulate", str(scene), "-o", str(scene)]) == 2
    assert "is not a directory" in capsys.readouterr().err
    assert scene.read_text() == SCENE


def test_new_writes_files_that_work(tmp_path, capsys):
    from fitting.tracks import load_dataset

    directory = tmp_path / "project"
    assert main(["new", str(directory)]) == 0
    assert f"derjax simulate {directory / 'scene.toml'}" in capsys.readouterr().out
    assert {path.name for path in directory.iterdir()} == {
        "scene.toml",
        "two_flagella.toml",
        "sweep.toml",
        "design.toml",
        "motor.csv",
        "dataset.toml",
        "track.csv",
    }
    load_dataset(directory / "dataset.toml")
    before = contents(directory)
    (directory / "motor.csv").unlink()
    assert main(["new", str(directory)]) == 2
    assert str(directory / "scene.toml") in capsys.readouterr().err
    assert contents(directory) == {k: v for k, v in before.items() if k != "motor.csv"}


def test_compilation_cache(monkeypatch, tmp_path):
    chosen = jax.config.jax_compilation_cache_dir
    assert runtime.enable_compilation_cache() == Path(chosen)
    try:
        jax.config.update("jax_compilation_cache_dir", None)
        monkeypatch.setattr(sys, "platform", "linux")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        directory = runtime.enable_compilation_cache()
        assert directory is not None
        assert directory.is_dir()
        assert directory.parent == tmp_path / "derjax"
        jax.config.update("jax_compilation_cache_dir", None)
        (tmp_path / "file").touch()
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
        assert runtime.enable_compilation_cache() is None
    finally:
        jax.config.update("jax_compilation_cache_dir", chosen)
