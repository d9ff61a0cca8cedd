"""Sweeps, from a file to a table and a figure."""

import csv
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import pytest
import xarray as xr

from derjax.commands.main import main
from derjax.core.errors import InputError
from derjax.runs import turns
from derjax.runs.sweeps import dask as farm
from derjax.runs.sweeps import marching, points
from derjax.runs.sweeps import sweep as sweeps
from derjax.runs.sweeps.figure import figure
from derjax.runs.sweeps.file import PLACES, _fields, load_sweep
from derjax.runs.sweeps.points import Chunk, compute
from derjax.runs.sweeps.threads import compute_all as by_threads
from derjax.runs.turns import stored_march
from derjax.scenes.file import SceneFile

SCENE = """
[robot]
edge_length = 0.03
[fluid]
hydrodynamics = "rft"
[time]
step = 0.05
end = 0.4
frame = 0.1
"""
SWEEP = """
scene = "scene.toml"
[vary]
rpm = { from = 30, to = 60, count = 4 }
C_t = [4.0, 4.8]
"""


@pytest.fixture(scope="module", autouse=True)
def one_processor() -> Iterator[None]:
    """However many there are: points are done in their order."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(turns, "processors", lambda: 1)
        yield


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "sweep.toml").write_text(SWEEP)
    return tmp_path


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a sweep and, in `out`, of its uninterrupted results."""
    directory = tmp_path_factory.mktemp("finished")
    (directory / "scene.toml").write_text(SCENE)
    (directory / "sweep.toml").write_text("trajectories = true\n" + SWEEP)
    argv = ["sweep", str(directory / "sweep.toml"), "-o", str(directory / "out")]
    assert main(argv) == 0
    return directory


def table(directory: Path) -> list[dict[str, str]]:
    with (directory / "results.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def timeless(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    return [{k: v for k, v in row.items() if k != "wall_time_s"} for row in rows]


def assert_close(one: list[dict[str, str]], other: list[dict[str, str]]) -> None:
    """The same points with the same results, to what the solver leaves open."""
    assert [row["index"] for row in one] == [row["index"] for row in other]
    for a, b in zip(one, other, strict=True):
        for name in ("v_x_m_per_s", "head_rate_rad_per_s"):
            assert float(a[name]) == pytest.approx(float(b[name]), rel=1e-6)
        assert (a["rpm"], a["C_t"], a["status"]) == (b["rpm"], b["C_t"], b["status"])


def test_a_sweep_writes_a_table_a_figure_and_trajectories(finished):
    out = finished / "out"
    assert {path.name for path in out.iterdir()} == {
        "results.csv",
        "sweep.json",
        "sweep.png",
        "trajectories",
    }
    rows = table(out)
    assert [row["index"] for row in rows] == [str(k) for k in range(8)]
    assert [row["rpm"] for row in rows] == ["30", "30", "40", "40", "50", "50", "60", "60"]
    assert [row["C_t"] for row in rows[:2]] == ["4.0", "4.8"]
    assert {row["status"] for row in rows} == {"ok"}
    assert all(row["time_s"] == "0.4" and row["steps"] == "8" for row in rows)
    rates = [float(row["head_rate_rad_per_s"]) for row in rows]
    assert rates[0] > rates[-1]  # against the flagellum
    with xr.open_dataset(out / "trajectories" / "point_00003.nc") as trajectory:
        assert trajectory.attrs["rpm"] == 40
        assert trajectory.sizes["time"] == 5
        assert json.loads(trajectory.attrs["scene_json"])["head"]["C_t"] == 4.8


def test_points_with_more_frames_share_the_program():
    """Frames are some for a turn of the motor, so that slower ones have more of them."""
    lengths = {
        marching._piece(SceneFile.from_dict({"time": {"end": end}}))[0] for end in (4, 16, 20)
    }
    assert len(lengths) == 1


def test_a_point_is_what_simulate_makes_of_it(finished, tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE + "[motor]\nrpm = 50\n[head]\nC_t = 4.8\n")
    argv = ["simulate", str(scene), "-o", str(tmp_path / "out"), "--no-figures", "--quiet"]
    assert main(argv) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    row = table(finished / "out")[5]
    for name in ("v_x_m_per_s", "head_rate_rad_per_s", "tail_to_head_m", "efficiency"):
        assert float(row[name]) == pytest.approx(summary[name], rel=1e-6)


def test_every_parameter_has_a_place_in_the_scene_file():
    for place in PLACES.values():
        name, key = place.split(".")
        assert key in _fields(SceneFile.model_fields[name].annotation)


def test_points_that_differ_in_numbers_share_a_program(directory):
    plan = load_sweep(directory / "sweep.toml")
    groups, invalid = points.programs({k: plan.file(k) for k in range(len(plan.points))})
    assert groups == [list(range(8))]
    assert not invalid


def test_other_choices_make_other_programs(directory):
    (directory / "sweep.toml").write_text(
        'scene = "scene.toml"\n[vary]\nrpm = [30, 60]\n'
        '"fluid.hydrodynamics" = ["rft", "none"]\n"head.mass" = [0.1, 0.2]\n'
        "axial_length = [0.0954, 0.2]\n"
    )
    plan = load_sweep(directory / "sweep.toml")
    files = {k: plan.file(k) for k in range(len(plan.points))}
    groups, _ = points.programs(files)
    # Two choices and two numbers of nodes; masses and rates are numbers.
    assert [len(group) for group in groups] == [4] * 4
    for group in groups:
        assert (
            len({(files[k].fluid.hydrodynamics, files[k].robot.axial_length) for k in group}) == 1
        )


def test_chunks_of_one_program_are_compiled_once(directory, monkeypatch):
    monkeypatch.setattr(sweeps, "ON_A_CPU", 3)
    monkeypatch.setattr(sweeps, "CHUNKS_OF_EACH", 1)
    monkeypatch.setattr(turns, "processors", lambda: 2)
    compiled, chunks = [], []

    def counted_compile(*arguments: Any) -> Any:
        compiled.append(arguments)
        return stored_march.compile(*arguments)

    def counted_compute(chunk: Chunk, on_progress: Any) -> list[points.Outcome]:
        chunks.append((len(chunk.files), chunk.slots))
        return compute(chunk, on_progress)

    monkeypatch.setattr(turns, "_programs", {})
    monkeypatch.setattr(turns, "stored_march", SimpleNamespace(compile=counted_compile))
    monkeypatch.setattr(points, "compute", counted_compute)
    (directory / "scene.toml").write_text(SCENE.replace("0.4", "0.3"))  # a program of its own
    argv = ["sweep", str(directory / "sweep.toml"), "-o", str(directory / "out")]
    assert main([*argv, "--quiet", "--no-figures"]) == 0
    assert sorted(chunks) == [(2, 3), (3, 3), (3, 3)]
    assert len(compiled) == 1


def test_who_is_free_takes_the_next_chunk(directory, monkeypatch):
    """The first one ends when all others have been done, which it would wait for in vain."""
    others = threading.Semaphore(0)

    def compute(chunk: Chunk, on_progress: Any) -> list[points.Outcome]:
        (number,) = chunk.files
        if number == 0:
            for _ in range(4):
                assert others.acquire(timeout=60)
        else:
            others.release()
        return [points.Outcome(number, {"status": "ok"})]

    monkeypatch.setattr(points, "compute", compute)
    file = load_sweep(directory / "sweep.toml").file(0)
    chunks = [Chunk({k: file}, 1) for k in range(5)]
    found = list(by_threads(chunks, 2, lambda: False, lambda done: None))
    assert sorted(o.number for outcomes in found for o in outcomes) == [0, 1, 2, 3, 4]
    assert {o.row["status"] for outcomes in found for o in outcomes} == {"ok"}


def test_threads_stop_when_they_are_asked_to(directory, monkeypatch):
    """What has been done is kept, what is under way is given up, and what waits never begins."""
    begun: list[int] = []

    def compute(chunk: Chunk, on_progress: Any) -> list[points.Outcome]:
        (number,) = chunk.files
        begun.append(number)
        if number > 0:
            stop.set()
            on_progress(0.5)
        return [points.Outcome(number, {"status": "ok"})]

    stop = threading.Event()
    monkeypatch.setattr(points, "compute", compute)
    file = load_sweep(directory / "sweep.toml").file(0)
    chunks = [Chunk({k: file}, 1) for k in range(5)]
    found = list(by_threads(chunks, 1, stop.is_set, lambda done: None))
    assert [outcomes[0].number for outcomes in found] == [0]
    assert begun == [0, 1]


def test_failed_points_are_rows(directory, capsys):
    (directory / "sweep.toml").write_text(
        'scene = "scene.toml"\nmode = "together"\n[vary]\nC_t = [4.0, -1, 4.8]\n'
        "rpm = [10, 20, 90000]\n"
    )
    out = directory / "out"
    assert main(["sweep", str(directory / "sweep.toml"), "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert "3 points, 2 of them failed" in said
    good, wrong, failed = table(out)
    assert good["status"] == "ok"
    assert float(good["head_rate_rad_per_s"]) < 0
    assert wrong["status"] == "invalid"
    assert "[head] C_t = -1" in wrong["message"]
    assert failed["status"] in ("max_iterations", "line_search", "non_finite")
    assert " s failed" in failed["message"]
    assert failed["v_x_m_per_s"] == ""
    assert float(failed["time_s"]) < 0.4
    assert (out / "sweep.png").exists()


def test_overlapping_flagella_are_a_failed_point(directory):
    (directory / "scene.toml").write_text(
        '[robot]\nkind = "two_flagella"\nhandedness = ["left", "right"]\n'
    )
    (directory / "sweep.toml").write_text(
        'scene = "scene.toml"\n[vary]\nseparation = [0.004, 0.028]\n'
    )
    plan = load_sweep(directory / "sweep.toml")
    groups, invalid = points.programs({k: plan.file(k) for k in range(2)})
    assert groups == [[1]]
    assert invalid[0].number == 0
    assert "overlap at the start" in str(invalid[0].row["message"])


def test_a_breakdown_is_that_of_one_point(directory, monkeypatch):
    plan = load_sweep(directory / "sweep.toml")
    chunk = Chunk({k: plan.file(k) for k in range(3)}, 3)

    def compute(chunk: Chunk, on_progress: Any) -> list[points.Outcome]:
        if 1 in chunk.files:
            raise MemoryError("no more")
        return [points.Outcome(number, {"status": "ok"}) for number in chunk.files]

    monkeypatch.setattr(points, "compute", compute)
    outcomes = points.compute_surely(chunk)
    assert [(o.number, o.row["status"]) for o in outcomes] == [(0, "ok"), (1, "error"), (2, "ok")]
    assert outcomes[1].row["message"] == "MemoryError: no more"


@pytest.mark.slow
def test_lists_of_contacts_grow():
    """A point with too short a list is computed again, with a longer one."""
    filaments = {"kind": "clamped", "n_flagella": 2, "shape": "straight", "separation": 0.0034}
    scene = {
        "robot": {**filaments, "axial_length": 0.03, "edge_length": 0.01},
        "fluid": {"hydrodynamics": "none"},
        "motor": {"rpm": 10},
        "time": {"step": 0.02, "end": 0.04, "frame": 0.02, "scheme": "euler"},
        "contact": {"capacity": 5},
    }
    (outcome,) = compute(Chunk({0: SceneFile.model_validate(scene)}, 1))
    assert outcome.row["status"] == "ok"
    assert outcome.row["steps"] == 2
    assert outcome.row["minimum_distance_m"] == pytest.approx(0.0034, rel=1e-3)


def test_results_are_not_overwritten_unless_asked(finished, capsys):
    before = {p.name: p.stat().st_mtime_ns for p in (finished / "out").iterdir()}
    argv = ["sweep", str(finished / "sweep.toml"), "-o", str(finished / "out")]
    assert main(argv) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main([*argv, "--resume"]) == 2
    assert "nothing to resume" in capsys.readouterr().err
    assert {p.name: p.stat().st_mtime_ns for p in (finished / "out").iterdir()} == before


def test_interrupted_and_resumed(directory, finished, monkeypatch, capsys):
    """Finished points are kept, the others computed; and only for the same sweep."""
    monkeypatch.setattr(sweeps, "ON_A_CPU", 2)
    out = directory / "out"
    argv = ["sweep", str(directory / "sweep.toml"), "-o", str(out)]
    told, stopped = [], threading.Event()

    def add(self: Any, outcomes: Any, entered: Any = sweeps.Book.add) -> None:
        entered(self, outcomes)
        told.append(len(self.rows))
        if len(self.rows) == 4:
            os.kill(os.getpid(), signal.SIGINT)
            stopped.set()

    def compute_slowly(chunk: Chunk, on_progress: Any) -> list[points.Outcome]:
        if 4 in chunk.files:
            assert stopped.wait(timeout=60)
        return compute(chunk, on_progress)

    with monkeypatch.context() as patch:
        patch.setattr(points, "compute", compute_slowly)
        patch.setattr(sweeps.Book, "add", add)
        assert main(argv) == 130
    assert told == [0, 2, 4]
    said = capsys.readouterr().err
    assert "4 of 8 points are done" in said
    assert f"derjax sweep {directory / 'sweep.toml'} -o {out} --resume" in said
    kept = table(out)
    assert [row["index"] for row in kept] == ["0", "1", "2", "3"]
    assert not (out / "sweep.png").exists()

    assert main(argv) == 2
    assert "--resume computes what is missing" in capsys.readouterr().err
    (directory / "scene.toml").write_text(SCENE.replace("0.03", "0.025"))
    assert main([*argv, "--resume"]) == 2
    assert "scene robot edge_length was 0.03, is 0.025" in capsys.readouterr().err
    (directory / "scene.toml").write_text(SCENE)
    (directory / "sweep.toml").write_text(SWEEP.replace("4.8", "5.8"))
    assert main([*argv, "--resume"]) == 2
    assert "vary head.C_t" in capsys.readouterr().err
    (directory / "sweep.toml").write_text(SWEEP)

    assert main([*argv, "--resume"]) == 0
    assert table(out)[:4] == kept
    assert_close(table(out), table(finished / "out"))
    assert (out / "sweep.png").exists()


def test_nothing_to_resume(directory, capsys):
    argv = ["sweep", str(directory / "sweep.toml"), "-o", str(directory / "out"), "--resume"]
    assert main(argv) == 2
    assert "no sweep to resume" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("rpm = { from = 1, too = 2, count = 3 }", "[vary] rpm: too: unknown key. Did you mean"),
        ("rpm = { from = 1, to = 2 }", "[vary] rpm: count: is missing"),
        ("rpm = { from = -1, to = 2, count = 3, scale = 'log' }", "must be more than 0"),
        ("rpm = { from = 1, to = 2, count = 3, scale = 'ln' }", "'linear' or 'log'"),
        ("rpm = []", "[vary] rpm: no values"),
        ("rpm = 60", "should be a list"),
        ("ptich = [0.04]", "Did you mean 'pitch'?"),
        ("hydrodynamics = ['rss']", "Did you mean 'fluid.hydrodynamics'?"),
        ("separation = [0.02]", "this scene has no such parameter"),
        ("rpm = [1]\n'motor.rpm' = [1]", "motor.rpm is given twice"),
        (
            "C_t = { from = 1, to = 2, count = 2000 }\nrpm = { from = 1, to = 2, count = 2000 }",
            "too",
        ),
        ("pitch = [44, 50]", "did you mean 0.044?"),
    ],
)
def test_wrong_sweeps_write_nothing(directory, text, expected, capsys):
    path = directory / "sweep.toml"
    path.write_text(f'scene = "scene.toml"\n[vary]\n{text}\n')
    assert main(["sweep", str(path), "-o", str(directory / "out")]) == 2
    said = capsys.readouterr().err
    assert expected in said
    assert str(directory) in said
    assert not (directory / "out").exists()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('scene = "none.toml"\n[vary]\nrpm = [1]', "none.toml: no such file"),
        ('scene = "scene.toml"', "vary: is missing"),
        ('scene = "scene.toml"\nmod = 1\n[vary]\nrpm = [1]', "Did you mean 'mode'?"),
        (
            'scene = "scene.toml"\nmode = "together"\n[vary]\nrpm = [1, 2]\nC_t = [1]',
            "2 of rpm, 1 of C_t",
        ),
    ],
)
def test_wrong_files(directory, text, expected):
    path = directory / "sweep.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"sweep\.toml") as caught:
        load_sweep(path)
    assert expected in str(caught.value)


def test_wrong_options(directory, capsys):
    argv = ["sweep", str(directory / "sweep.toml"), "-o", str(directory / "out")]
    assert main([*argv, "--workers", "0"]) == 2
    assert "--workers 0" in capsys.readouterr().err
    assert main([*argv, "--distributed", "here"]) == 2
    assert "ADDRESS:PORT" in capsys.readouterr().err


def test_without_dask(directory, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    argv = ["sweep", str(directory / "sweep.toml"), "-o", str(directory / "out")]
    assert main([*argv, "--workers", "2"]) == 2
    assert "pip install 'derjax[sweep]'" in capsys.readouterr().err


def test_nested_tables_and_whole_numbers(directory):
    path = directory / "sweep.toml"
    path.write_text(
        'scene = "scene.toml"\n[vary]\nrobot.pitch = [0.04]\n'
        "C_t = { from = 1, to = 4, count = 3, scale = 'log' }\n"
        '"solver.max_iterations" = { from = 10, to = 30, count = 3 }\n'
    )
    plan = load_sweep(path)
    assert plan.keys == ("robot.pitch", "head.C_t", "solver.max_iterations")
    assert [point[2] for point in plan.points[:3]] == [10, 20, 30]
    assert plan.points[3][1] == pytest.approx(2.0)
    assert plan.file(1).solver.max_iterations == 20


def test_figures_of_many_curves_and_of_words(directory):
    path = directory / "sweep.toml"
    rows = {}
    for text in (
        "rpm = [1, 2]\nC_t = { from = 1, to = 4, count = 13 }",
        "'robot.handedness' = ['left', 'right']",
        "C_t = { from = 1, to = 4, count = 3, scale = 'log' }",
    ):
        path.write_text(f'scene = "scene.toml"\n[vary]\n{text}\n')
        plan = load_sweep(path)
        rows = {k: {"status": "ok", "v_x_m_per_s": f"{k}e-3"} for k in range(len(plan.points))}
        assert figure(plan, rows) is not None
    assert figure(load_sweep(path), {0: {"status": "invalid"}}) is None


def test_workers_of_a_scheduler(directory, finished, monkeypatch):
    """Two workers in this process, reached by the address of their scheduler."""
    from distributed import LocalCluster

    monkeypatch.setattr(sweeps, "MOST_OF_A_WORKER", 3)
    monkeypatch.setattr(farm, "SECONDS_BETWEEN_LOOKS", 0.05)
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        argv = ["sweep", str(directory / "sweep.toml"), "-o", str(directory / "out"), "--quiet"]
        assert main([*argv, "--scheduler", cluster.scheduler_address]) == 0
    assert_close(table(directory / "out"), table(finished / "out"))


@pytest.mark.slow
def test_a_lost_worker_is_replaced(directory, finished):
    """The chunk that killed its process is computed by another one."""
    program = f"""
import os, sys
from pathlib import Path
from derjax.runs.sweeps import dask as farm
from derjax.commands.main import main
from derjax.runs.sweeps.points import compute_surely

def fatal(chunk):
    mark = Path({str(directory / "killed")!r})
    if 0 in chunk.files and not mark.exists():
        mark.touch()
        os._exit(1)
    return compute_surely(chunk)

if __name__ == "__main__":
    farm._on_worker = fatal
    sys.exit(main(sys.argv[1:]))
"""
    (directory / "sweep.toml").write_text(SWEEP.replace("to = 60, count = 4", "to = 30, count = 1"))
    script = directory / "fatal.py"
    script.write_text(program)
    argv = ["sweep", str(directory / "sweep.toml"), "-o", str(directory / "out"), "--workers", "1"]
    kept = str(jax.config.jax_compilation_cache_dir)  # pyright: ignore
    done = subprocess.run(
        [sys.executable, str(script), *argv],
        env={**os.environ, "JAX_COMPILATION_CACHE_DIR": kept},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert (directory / "killed").exists()
    assert_close(table(directory / "out"), table(finished / "out")[:2])
