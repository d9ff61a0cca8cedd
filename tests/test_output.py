"""Directories of results: tried out, locked, and nothing in them lost."""

import errno
import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from derjax.core.errors import InputError
from derjax.io.files import WriteError, atomic_path, make_room, writable_directory
from derjax.io.locking import LOCK, locked
from derjax.io.output import output_directory


def no_space(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def write(path: Path, text: str, error: Exception | None = None) -> None:
    """Writes a file in one go, or fails halfway."""
    with atomic_path(path) as temporary:
        temporary.write_text(text)
        if error is not None:
            raise error


def test_a_writable_directory_is_made(tmp_path):
    writable_directory(tmp_path / "a" / "b")
    assert list((tmp_path / "a" / "b").iterdir()) == []


def test_what_is_no_writable_directory(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file: is not a directory"):
        writable_directory(tmp_path / "file")
    with pytest.raises(InputError, match=r"file/below: cannot be made: Not a directory"):
        writable_directory(tmp_path / "file" / "below")
    monkeypatch.setattr("os.fsync", no_space)
    with pytest.raises(InputError, match="out: cannot be written to: No space left"):
        writable_directory(tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
        RuntimeError("Can't decrement id ref count (file write failed: errno = 28, ...)"),
    ],
)
def test_errors_of_writing_name_the_file_and_the_cause(tmp_path, error):
    path = tmp_path / "results.csv"
    path.write_text("old")
    with pytest.raises(WriteError) as caught:
        write(path, "half", error)
    assert str(caught.value) == f"{path}: cannot be written: No space left on device"
    assert caught.value.errno == errno.ENOSPC
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_other_errors_are_not_called_errors_of_writing(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.csv"), atomic_path(tmp_path / "a"):
        (tmp_path / "none.csv").open()
    with pytest.raises(WriteError, match=r"none/a: cannot be written: No such file"):
        write(tmp_path / "none" / "a", "")


def test_room_is_made_or_refused(tmp_path):
    make_room(tmp_path / "a", 10_000)
    assert (tmp_path / "a").stat().st_size in (0, 10_000)
    with pytest.raises(OSError, match=r"No space|too large"):
        make_room(tmp_path / "b", 1 << 62)


HOLD = """
import sys, time
from pathlib import Path
from derjax.io.locking import locked
with locked(Path(sys.argv[1])):
    print("locked", flush=True)
    time.sleep(60)
"""


def test_a_directory_has_one_writer(tmp_path):
    """The one that comes second is told who was first; a lock whose holder was killed is free."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True
    ) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "locked\n"
        said = rf"process {first.pid} on {platform.node()} writes its results there"
        with pytest.raises(InputError, match=said), locked(tmp_path):
            pass
        first.kill()
    assert (tmp_path / LOCK).exists()
    with locked(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()
        with pytest.raises(InputError, match=f"process {os.getpid()} on"), locked(tmp_path):
            pass
    assert not (tmp_path / LOCK).exists()


def test_a_lock_of_another_machine_is_not_taken_over(tmp_path):
    (tmp_path / LOCK).write_text('{"host": "far away", "pid": 7}')
    said = rf"process 7 on far away .* delete .*{LOCK}"
    with pytest.raises(InputError, match=said), locked(tmp_path):
        pass
    (tmp_path / LOCK).write_text("half a")
    with locked(tmp_path):
        pass


def test_results_that_come_from_elsewhere_are_left_alone(tmp_path):
    (tmp_path / "old.csv").write_text("old")
    (tmp_path / "changing.csv").write_text("old")
    with output_directory(tmp_path) as output:
        for _ in range(2):  # what is there, and one's own
            for name in ("old.csv", "new.csv"):
                with output.replacing(name) as temporary:
                    temporary.write_text("mine")
        (tmp_path / "foreign.csv").write_text("another's")
        (tmp_path / "changing.csv").write_text("another's")
        for name in ("foreign.csv", "changing.csv"):
            with pytest.raises(InputError, match=f"{name}: was written by another program"):
                output.check(["old.csv", name])
            output.remove(name)
        with pytest.raises(InputError, match="late"), output.replacing("late.csv"):
            (tmp_path / "late.csv").write_text("another's")
        output.remove("new.csv")
    texts = {path.name: path.read_text() for path in tmp_path.iterdir()}
    foreign = dict.fromkeys(["foreign.csv", "changing.csv", "late.csv"], "another's")
    assert texts == {"old.csv": "mine", **foreign}


def test_a_directory_that_stays_empty_is_gone_again(tmp_path):
    path = tmp_path / "a" / "b"
    with pytest.raises(KeyboardInterrupt), output_directory(path):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
    with output_directory(Path(path)) as output:
        (output.path / "kept").touch()
    assert [file.name for file in path.iterdir()] == ["kept"]
