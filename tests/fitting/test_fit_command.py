"""The command `derjax fit`: from files to files, stopped, resumed, refused."""

import errno
import json
import os
import shlex
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from derjax.commands.main import main
from fitting.calibrate import calibrate
from fitting.model import Model
from fitting.simulate import Simulator

SCENE = """
[robot]
edge_length = 0.03
[head]
C_t = 1.0
C_r = 1.0
[time]
step = 0.05
end = 3.0
inertia = false
"""

NO_FIGURES = {"fit.json", "fit.nc"}
ALL = {*NO_FIGURES, "fit.png", "report.html"}

DRIFT = np.array([0.0, 1e-3, 0.0, 0.0])
"""m/s, of tracks that say so to nobody."""


@pytest.fixture(scope="module", autouse=True)
def _previews_are_shorter() -> Iterator[None]:
    """Take every motion for steady after one call, so that previews are half as long as tracks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fitting.model.is_steady", lambda *_: True)
        yield


def written(dataset, directory: Path) -> Path:
    """The synthetic dataset as files; the path of the dataset file."""
    (directory / "scene.toml").write_text(SCENE)
    rng = np.random.default_rng(3)
    noise = np.array([2e-5, 2e-5, 2e-5, 0.005])
    text = 'scene = "scene.toml"\n'
    for run in dataset.runs:
        content = np.c_[run.time, run.values + noise * rng.normal(size=run.values.shape)]
        np.savetxt(
            directory / f"{run.name}.csv", content, "%.12g", ",", header="t,x,y,z,a", comments=""
        )
        text += f'[[runs]]\ntrack = "{run.name}.csv"\nmotor_rpm = {run.motor_rpm}\n'
        text += 'columns = { t = "t", x = "x", y = "y", z = "z", head_angle = "a" }\n'
    path = directory / "dataset.toml"
    path.write_text(text)
    return path


class Runs:
    """Counts the simulations of runs, and stops before one of them.

    Attributes:
        done: how many were simulated.
        stop: what is called instead of simulating once `left` of them have begun.
    """

    def __init__(self, patch: pytest.MonkeyPatch, left: int = 10**9, stop=None) -> None:
        self.done, self.begun, self.lock = 0, 0, threading.Lock()
        true_run = Simulator.run

        def run(simulator, free, rpm, n_steps, *args):
            if n_steps == 1:  # to compile
                return true_run(simulator, free, rpm, n_steps, *args)
            with self.lock:
                self.begun += 1
                late = self.begun > left
            if late and stop is not None:
                stop()
            simulated = true_run(simulator, free, rpm, n_steps, *args)
            with self.lock:
                self.done += 1
            return simulated

        patch.setattr(Simulator, "run", run)


def ctrl_c() -> None:
    raise KeyboardInterrupt


def terminate() -> None:
    """SIGTERM, by which queues end jobs."""
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.5)
    raise RuntimeError("was not interrupted")


@pytest.fixture(scope="module")
def finished(dataset, tmp_path_factory) -> tuple[Path, int]:
    """The directory of a dataset and, in `out`, of its fit; and how many runs that took."""
    directory = tmp_path_factory.mktemp("finished")
    path = written(dataset, directory)
    with pytest.MonkeyPatch.context() as patch:
        runs = Runs(patch)
        assert main(["fit", str(path), "-o", str(directory / "out")]) == 0
    return directory, runs.done


@pytest.fixture
def path(dataset, tmp_path) -> Path:
    """Of the dataset file, in a directory of its own."""
    return written(dataset, tmp_path)


@pytest.fixture
def unfinished(path, monkeypatch, capsys) -> Path:
    """Of the dataset file, beside it in `out` a fit that was stopped after two evaluations."""
    with monkeypatch.context() as patch:
        Runs(patch, 4, ctrl_c)
        assert main(["fit", str(path), "-o", str(path.parent / "out")]) == 130
    capsys.readouterr()
    return path


@pytest.fixture
def nothing_simulated(monkeypatch) -> None:
    """Whoever compiles or simulates has noticed too late."""

    def refuse(*_, **__) -> None:
        raise AssertionError("this was noticed too late")

    monkeypatch.setattr(Model, "compile", refuse)
    monkeypatch.setattr(Simulator, "run", refuse)


def numbers(directory: Path) -> dict:
    """Of fit.json, without what differs from run to run."""
    content = json.loads((directory / "fit.json").read_text())
    return {k: v for k, v in content.items() if k not in ("wall_time_s", "dataset")}


def names(directory: Path) -> set[str]:
    return {path.name for path in directory.iterdir()}


def contents(directory: Path) -> dict[str, bytes]:
    """Of all files in a directory and below."""
    files = (path for path in directory.rglob("*") if path.is_file())
    return {str(path.relative_to(directory)): path.read_bytes() for path in files}


def test_the_command_fits_and_writes(finished) -> None:
    out = finished[0] / "out"
    content = json.loads((out / "fit.json").read_text())
    assert content["status"] == "converged"
    assert content["parameters"]["C_t"]["value"] == pytest.approx(4.8, rel=0.1)
    assert content["parameters"]["C_r"]["value"] == pytest.approx(0.36, rel=0.01)
    assert content["parameters"]["C_t"]["start"] == 1.0
    assert content["goodness"]["good"]
    assert names(out) == ALL


def test_what_is_printed(path, capsys) -> None:
    out = path.parent / "out"
    argv = ["fit", str(path), "-o", str(out), "--start", "C_t=3", "C_r=0.5"]
    assert main(argv) == 0
    said = capsys.readouterr().out
    for words in ("explore  0: loss", "fit  0: loss", "steps/s, about", "converged after"):
        assert words in said
    assert "previews and" in said
    assert "C_t = 4." in said
    assert "The simulation describes the tracks" in said
    assert str(out / "fit.png") in said
    before = contents(out)

    assert main(argv) == 2
    assert "fit.json: exists already; use --overwrite" in capsys.readouterr().err
    assert contents(out) == before
    more = ["--overwrite", "--max-iterations", "1", "--quiet", "--no-figures"]
    assert main(["fit", str(path), "-o", str(out), "--start", "C_t=3", "C_r=2", *more]) in (0, 2)
    assert capsys.readouterr().out == ""
    assert json.loads((out / "fit.json").read_text())["parameters"]["C_r"]["start"] == 2.0


@pytest.mark.parametrize("stop", [ctrl_c, pytest.param(terminate, marks=pytest.mark.slow)])
@pytest.mark.parametrize("when", ["first", "explore", "fit", "compare"])
def test_a_fit_that_was_stopped_is_resumed(finished, path, monkeypatch, capsys, stop, when) -> None:
    """It gives what an uninterrupted one gives, bit by bit, and simulates nothing twice."""
    directory, total = finished
    left = {"first": 0, "explore": 6, "fit": total - 4, "compare": total - 2}[when]
    out = path.parent / "out"
    argv = ["fit", str(path), "-o", str(out)]
    with monkeypatch.context() as patch:
        first = Runs(patch, left, stop)
        status = main(argv)
    said = capsys.readouterr().err
    assert first.done == left
    if when == "compare":
        # The fit itself is done: it counts, without the picture of the start.
        assert status == 0
        assert names(out) == ALL
        assert numbers(out) == numbers(directory / "out")
        return
    assert status == 130
    result = set() if when == "first" else ALL
    assert names(out) == {"evaluations", *result}
    assert len(list((out / "evaluations").glob("*.npz"))) == left // 2
    if result:
        assert numbers(out)["status"] == "interrupted"
        assert all(p["value"] > 0 for p in numbers(out)["parameters"].values())
    (advice,) = [line for line in said.splitlines() if "resume with: derjax fit" in line]

    with monkeypatch.context() as patch:
        second = Runs(patch)
        assert main(shlex.split(advice.split("resume with: derjax ")[1])) == 0
    assert first.done + second.done == total
    assert numbers(out) == numbers(directory / "out")
    assert (out / "fit.png").read_bytes() == (directory / "out" / "fit.png").read_bytes()
    assert names(out) == ALL


def test_the_printer_may_be_interrupted(path, monkeypatch) -> None:
    """Progress is told from the threads that simulate."""
    told = 0

    def interrupt(self, progress) -> None:
        nonlocal told
        told += progress.latest is None and progress.stage == "explore"
        if told == 7:
            raise KeyboardInterrupt

    monkeypatch.setattr("fitting.cli._Printer.__call__", interrupt)
    out = path.parent / "out"
    assert main(["fit", str(path), "-o", str(out)]) == 130
    assert numbers(out)["status"] == "interrupted"
    assert len(list((out / "evaluations").glob("*.npz"))) >= 2


@pytest.mark.slow
@pytest.mark.parametrize("after", [1, 40])
def test_the_search_for_causes_may_be_interrupted(
    dataset, tmp_path, monkeypatch, capsys, after
) -> None:
    """Also in the midst of one of its own searches."""
    runs = [replace(run, values=run.values + np.outer(run.time, DRIFT)) for run in dataset.runs]
    path, out = written(replace(dataset, runs=tuple(runs)), tmp_path), tmp_path / "out"
    argv = ["fit", str(path), "-o", str(out), "--start", "C_t=4", "C_r=0.4", "--no-figures"]
    told = 0

    def interrupt(self, progress) -> None:
        nonlocal told
        told += progress.stage == "check"
        if told == after:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("fitting.cli._Printer.__call__", interrupt)
        assert main(argv) == 130
    content = numbers(out)
    assert content["status"] == "interrupted"
    assert content["likely_causes"] == []
    assert any("was interrupted before" in warning for warning in content["warnings"])
    kept = len(list((out / "evaluations").glob("*.npz")))
    (advice,) = [line for line in capsys.readouterr().err.splitlines() if "resume with" in line]

    again = Runs(monkeypatch)
    assert main(shlex.split(advice.split("resume with: derjax ")[1])) == 0
    assert again.done > 0
    assert kept > 4
    assert "a steady drift" in numbers(out)["likely_causes"][0]["sentence"]
    assert names(out) == NO_FIGURES


def test_a_fit_that_ran_out_of_iterations_goes_on(path, monkeypatch, capsys) -> None:
    """With more of them, and without simulating again what it has simulated."""
    monkeypatch.setattr("fitting.cli.calibrate", partial(calibrate, explored=False))
    out = path.parent / "out"
    argv = ["fit", str(path), "-o", str(out), "--no-figures", "--max-iterations", "2"]
    with monkeypatch.context() as patch:
        first = Runs(patch)
        assert main(argv) == 2
    assert numbers(out)["status"] == "max_iterations"
    assert numbers(out)["likely_causes"] == []  # of a misfit that is none yet
    assert names(out) == {*NO_FIGURES, "evaluations"}
    (advice,) = [line for line in capsys.readouterr().err.splitlines() if "go on with" in line]
    assert advice.endswith("--max-iterations 4 --no-figures --resume")
    more = [*argv[:-1], "30"]
    with monkeypatch.context() as patch:
        second = Runs(patch)
        assert main([*more, "--resume"]) == 0
    assert names(out) == NO_FIGURES
    resumed = numbers(out)
    alone = Runs(monkeypatch)
    assert main([*more, "--overwrite"]) == 0
    assert first.done + second.done == alone.done
    assert numbers(out) == resumed


def test_an_unfinished_fit_is_not_lost(unfinished, capsys, nothing_simulated) -> None:
    out = unfinished.parent / "out"
    before = contents(out)
    assert main(["fit", str(unfinished), "-o", str(out)]) == 2
    said = capsys.readouterr().err
    assert f"{out / 'evaluations'}: here is an unfinished fit: --resume continues it" in said
    assert "--overwrite starts anew" in said
    wrong = ["--parameters", "C_x"]
    assert main(["fit", str(unfinished), "-o", str(out), "--overwrite", *wrong]) == 2
    assert "no parameter 'C_x'" in capsys.readouterr().err
    assert contents(out) == before


def test_an_unfinished_fit_is_overwritten_on_demand(unfinished, finished) -> None:
    out = unfinished.parent / "out"
    assert main(["fit", str(unfinished), "-o", str(out), "--overwrite"]) == 0
    assert numbers(out) == numbers(finished[0] / "out")


def changed_track(path: Path) -> list[str]:
    track = path.parent / "rpm45.csv"
    lines = track.read_text().splitlines()
    cells = lines[5].split(",")
    lines[5] = ",".join([cells[0], f"{float(cells[1]) + 1e-6:.12g}", *cells[2:]])
    track.write_text("\n".join(lines) + "\n")
    return []


def changed_scene(path: Path) -> list[str]:
    (path.parent / "scene.toml").write_text(SCENE + "[fluid]\nviscosity = 1.1\n")
    return []


OTHERS = {
    "tracks": changed_track,
    "scene": changed_scene,
    "start": lambda path: ["--start", "C_t=2"],
    "parameters": lambda path: ["--parameters", "C_r", "C_t"],
}


@pytest.mark.parametrize("what", OTHERS)
def test_another_fit_is_not_resumed(unfinished, capsys, nothing_simulated, what) -> None:
    out = unfinished.parent / "out"
    before = contents(out)
    words = OTHERS[what](unfinished)
    assert main(["fit", str(unfinished), "-o", str(out), "--resume", *words]) == 2
    said = capsys.readouterr().err
    assert f"this is an unfinished fit with other {what}. Only the same fit can be resumed" in said
    assert contents(out) == before


def test_nothing_to_resume(path, finished, capsys, nothing_simulated) -> None:
    out = path.parent / "out"
    assert main(["fit", str(path), "-o", str(out), "--resume"]) == 2
    assert f"{out / 'evaluations'}: there is no unfinished fit" in capsys.readouterr().err
    assert not out.exists()
    before = contents(finished[0] / "out")
    assert main(["fit", str(path), "-o", str(finished[0] / "out"), "--resume"]) == 2
    assert "there is no unfinished fit to resume" in capsys.readouterr().err
    assert contents(finished[0] / "out") == before


def no_room(error: int, suffix: str):
    """An `os.replace` that fails for files with a suffix."""
    replace = os.replace

    def refuse(old: Path, new: Path) -> None:
        if Path(new).suffix == suffix:
            raise OSError(error, os.strerror(error))
        replace(old, new)

    return refuse


def test_a_full_disk_does_not_stop_a_fit(path, finished, monkeypatch, capsys) -> None:
    """It goes on and says so once."""
    monkeypatch.setattr("derjax.io.files.os.replace", no_room(errno.ENOSPC, ".npz"))
    out = path.parent / "out"
    assert main(["fit", str(path), "-o", str(out)]) == 0
    assert numbers(out) == numbers(finished[0] / "out")
    assert names(out) == ALL
    said = capsys.readouterr().err
    assert said.count("derjax: warning: ") == 1
    assert ".npz: cannot be written: No space left on device; the fit goes on" in said
    assert "WriteWarning" not in said


def test_a_result_that_cannot_be_written_is_not_lost(path, finished, monkeypatch, capsys) -> None:
    out = path.parent / "out"
    with monkeypatch.context() as patch:
        patch.setattr("derjax.io.files.os.replace", no_room(errno.ENOSPC, ".png"))
        assert main(["fit", str(path), "-o", str(out)]) == 2
    said = capsys.readouterr()
    assert f"{out / 'fit.png'}: cannot be written: No space left on device" in said.err
    assert "C_t = 4." in said.out
    (advice,) = [line for line in said.err.splitlines() if "resume with: derjax fit" in line]
    assert str(out / "evaluations") in advice
    runs = Runs(monkeypatch)
    assert main(shlex.split(advice.split("resume with: derjax ")[1])) == 0
    assert runs.done == 0
    assert numbers(out) == numbers(finished[0] / "out")


def test_results_that_appear_meanwhile_are_not_replaced(path, monkeypatch, capsys) -> None:
    out = path.parent / "out"

    def progress(self, progress) -> None:
        (out / "fit.json").write_text("another's")

    monkeypatch.setattr("fitting.cli._Printer.__call__", progress)
    assert main(["fit", str(path), "-o", str(out)]) == 2
    assert f"{out / 'fit.json'}: was written by another program" in capsys.readouterr().err
    assert (out / "fit.json").read_text() == "another's"
    assert names(out) == {"fit.json", "evaluations"}


def test_a_directory_that_cannot_be_written_to(path, monkeypatch, capsys, nothing_simulated):
    def read_only(*_, **__) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("derjax.io.files.os.fsync", read_only)
    out = path.parent / "out"
    assert main(["fit", str(path), "-o", str(out)]) == 2
    assert f"{out}: cannot be written to: Read-only file system" in capsys.readouterr().err
    assert not out.exists()
    out.write_text("")
    assert main(["fit", str(path), "-o", str(out)]) == 2
    assert "not a directory" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--start", "C_t"], "--start C_t: should be NAME=VALUE"),
        (["--start", "C_t=much"], "NAME=VALUE"),
        (["--start", "C_t=-1"], "C_t = -1: must be positive"),
        (["--start", "viscosity=2"], "viscosity, which is not among"),
        (["--parameters", "C_x"], "no parameter 'C_x'"),
        (["--max-iterations", "0"], "at least 1"),
    ],
)
def test_wrong_arguments(path, capsys, nothing_simulated, words, says) -> None:
    assert main(["fit", str(path), "-o", str(path.parent / "out"), *words]) == 2
    assert says in capsys.readouterr().err
    assert not (path.parent / "out").exists()


def test_a_start_that_cannot_be_simulated_leaves_nothing(path, capsys, fails_below) -> None:
    fails_below(1.1)
    assert main(["fit", str(path), "-o", str(path.parent / "out")]) == 2
    said = capsys.readouterr().err
    assert "with C_t = 1, C_r = 1: run 'rpm45'" in said
    assert "Or start from other parameters" in said
    assert not (path.parent / "out").exists()
