"""Sweeps on full disks, and into directories that others write to."""

import csv
import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from derjax.commands.main import main
from derjax.runs import turns
from derjax.runs.sweeps import sweep as sweeps

SCENE = """
[robot]
edge_length = 0.03
[fluid]
hydrodynamics = "rft"
[time]
step = 0.05
end = 0.1
frame = 0.05
"""
SWEEP = """
scene = "scene.toml"
trajectories = true
[vary]
C_t = [4.0, 4.4, 4.8]
"""


@pytest.fixture(scope="module", autouse=True)
def one_processor() -> Iterator[None]:
    """However many there are: points are done in their order."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(turns, "processors", lambda: 1)
        yield


@pytest.fixture
def argv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The command for a sweep of one point after the other into the directory `out`."""
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "sweep.toml").write_text(SWEEP)
    monkeypatch.setattr(sweeps, "ON_A_CPU", 1)
    out = tmp_path / "out"
    return ["sweep", str(tmp_path / "sweep.toml"), "-o", str(out), "--no-figures", "--quiet"]


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def rows(path: Path) -> list[str]:
    with path.open(newline="") as stream:
        return [row["index"] for row in csv.DictReader(stream)]


def full_disk(monkeypatch: pytest.MonkeyPatch, suffix: str, times: int) -> None:
    """Leaves no room for the next few files with some suffix."""
    left, replace = [times], os.replace

    def refuse(old: Path, new: Path) -> None:
        if Path(new).suffix == suffix and left[0]:
            left[0] -= 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(old, new)

    monkeypatch.setattr("derjax.io.files.os.replace", refuse)


@pytest.mark.slow
def test_a_table_is_tried_again(argv, out, monkeypatch, capsys):
    full_disk(monkeypatch, ".csv", 2)
    assert main(argv) == 0
    said = capsys.readouterr().err
    assert said.count(f"warning: {out / 'results.csv'}: cannot be written: No space left") == 1
    assert rows(out / "results.csv") == ["0", "1", "2"]


def test_points_whose_trajectories_are_lost_are_computed_again(argv, out, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        full_disk(patch, ".nc", 2)
        assert main(argv) == 2
    said = capsys.readouterr().err
    assert "2 points are not kept" in said
    assert "--resume" in said
    assert rows(out / "results.csv") == ["2"]
    assert main([*argv, "--resume"]) == 0
    assert rows(out / "results.csv") == ["0", "1", "2"]
    assert len(list((out / "trajectories").iterdir())) == 3


def test_a_table_that_appears_meanwhile_is_not_replaced(argv, out, monkeypatch, capsys):
    write = sweeps.Book.add

    def add(self: sweeps.Book, outcomes: list) -> None:
        if outcomes:
            (out / "results.csv").write_text("another's")
        write(self, outcomes)

    monkeypatch.setattr(sweeps.Book, "add", add)
    assert main(argv) == 2
    said = capsys.readouterr().err
    assert f"{out / 'results.csv'}: was written by another program" in said
    beside = f"results-{os.getpid()}.csv"
    assert f"The table of this sweep is in {beside}" in said
    assert (out / "results.csv").read_text() == "another's"
    assert rows(out / beside) == ["0", "1", "2"]


def test_two_sweeps_into_one_directory(argv, out, monkeypatch, capsys):
    codes, write = [], sweeps.Book.add

    def add(self: sweeps.Book, outcomes: list) -> None:
        if outcomes and not codes:
            codes.append(main([*argv, "--overwrite"]))
        write(self, outcomes)

    monkeypatch.setattr(sweeps.Book, "add", add)
    assert main(argv) == 0
    assert codes == [2]
    assert f"{out}: process {os.getpid()} on" in capsys.readouterr().err
