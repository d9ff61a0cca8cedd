"""What has been simulated comes back as it was, from memory and from files."""

import errno
import os
import warnings
from dataclasses import fields, replace

import numpy as np
import pytest

from derjax import Status
from derjax.core.errors import WriteWarning
from derjax.integrate.frames import RolloutStats, new_stats
from fitting.simulate import SimulatedTrack
from fitting.store import ARRAYS, MOST_IN_MEMORY, Store

STEP = 0.05


def simulated(steps: int, seed: int = 0, **report) -> SimulatedTrack:
    """Random numbers in the shape of a run of some steps with two parameters."""
    rng = np.random.default_rng(seed)
    t = steps + 1
    return SimulatedTrack(
        time=STEP * np.arange(t),
        observed=rng.normal(size=(t, 4)),
        sensitivity=rng.normal(size=(t, 4, 2)),
        orientation=rng.normal(size=(t, 3, 3)),
        turning=rng.normal(size=(t, 3, 3, 2)),
        report=replace(new_stats(), **report),
    )


def assert_same(found: list[SimulatedTrack] | None, expected: list[SimulatedTrack]) -> None:
    """Bit by bit, and of the same types."""
    assert found is not None
    for one, other in zip(found, expected, strict=True):
        for name in ("time", *ARRAYS):
            a, b = getattr(one, name), getattr(other, name)
            assert a.dtype == b.dtype
            assert a.shape == b.shape
            assert a.tobytes() == b.tobytes()
        for field in fields(RolloutStats):
            a, b = (np.asarray(getattr(x.report, field.name)) for x in (one, other))
            assert a.dtype == b.dtype
            assert a.tobytes() == b.tobytes()
        assert one.report.ok == other.report.ok
        assert one.report.message() == other.report.message()


@pytest.fixture
def runs() -> list[SimulatedTrack]:
    """Two runs of different lengths, one of which failed."""
    failed = {
        "status": np.asarray(Status.LINE_SEARCH, np.int32),
        "failed_at": np.asarray(0.15),
        "residual": np.asarray(3e-4),
    }
    return [simulated(7), simulated(3, 1, **failed)]


@pytest.mark.parametrize("on_disk", [False, True])
def test_what_was_put_comes_back(runs, on_disk, tmp_path) -> None:
    store = Store(tmp_path if on_disk else None)
    store.put("whole-1", runs)
    assert_same(store.get("whole-1", STEP), runs)
    assert store.get("whole-2", STEP) is None
    assert len(list(tmp_path.iterdir())) == on_disk


def test_another_store_reads_the_files(runs, tmp_path) -> None:
    Store(tmp_path).put("preview-1", runs)
    store = Store(tmp_path)
    assert store.get("whole-1", STEP) is None
    found = store.get("preview-1", STEP)
    assert_same(found, runs)
    assert found is not None
    assert not found[1].report.ok
    assert "line search" in found[1].report.message()


def test_memory_is_limited_and_files_are_not(tmp_path) -> None:
    for directory in (None, tmp_path):
        store = Store(directory)
        for k in range(MOST_IN_MEMORY + 1):
            store.put(f"whole-{k}", [simulated(2, k)])
        first = store.get("whole-0", STEP)
        if directory is None:
            assert first is None
        else:
            assert_same(first, [simulated(2, 0)])
        assert_same(store.get("whole-1", STEP), [simulated(2, 1)])


def test_a_full_disk_is_told_of_once_and_memory_goes_on(runs, tmp_path, monkeypatch) -> None:
    def full(*_, **__) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    store = Store(tmp_path)
    store.put("whole-0", runs)
    monkeypatch.setattr(np, "savez", full)
    with pytest.warns(WriteWarning, match="whole-1.npz: cannot be written: No space left"):
        store.put("whole-1", runs)
    with warnings.catch_warnings(action="error"):
        store.put("whole-2", runs)
    for key in ("whole-0", "whole-1", "whole-2"):
        assert_same(store.get(key, STEP), runs)
    assert [path.name for path in tmp_path.iterdir()] == ["whole-0.npz"]
