"""A robot of nine nodes and two short synthetic tracks of it, compiled once for all tests."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from derjax import SceneFile, Status
from derjax.scenes.messages import check
from fitting.observe import interpolation
from fitting.simulate import Simulator, motor_rate, steps_per_call
from fitting.tracks import Dataset, Run
from fitting.transforms import select_parameters

TRUTH = {"C_t": 4.8, "C_r": 0.36}
TIMES = np.linspace(0.11, 2.65, 24) ** 1.05
"""Not those of the steps, nor evenly spaced; s."""

RATES = (45.0, 65.0)
"""Revolutions per minute. With steps of 50 ms the robot turns smoothly at these."""


@pytest.fixture(scope="session", autouse=True)
def _short_calls() -> Iterator[None]:
    """Let short tracks take two calls of the compiled program, as long ones do."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fitting.simulate.STEPS_PER_CALL", 30)
        yield


@pytest.fixture(scope="session")
def scene() -> SceneFile:
    """A coarse robot; the drag prefactors of its file are a start far from the truth."""
    content = {
        "robot": {"edge_length": 0.03},
        "head": {"C_t": 1.0, "C_r": 1.0},
        "time": {"step": 0.05, "end": 3.0, "inertia": False},
    }
    return check(SceneFile, content, Path("tiny.toml"))


@pytest.fixture(scope="session")
def simulator(scene: SceneFile) -> Simulator:
    """Simulates it with respect to the two drag prefactors."""
    steps = steps_per_call(interpolation(TIMES, scene.step).n_steps)  # as in `Model`: one program
    return Simulator(scene, select_parameters(("C_t", "C_r"), scene.parameters), steps)


def synthetic_run(
    simulator: Simulator, rpm: float, times: np.ndarray, truth: dict[str, float], **fields
) -> Run:
    """The track that a perfect camera would give at some times (s)."""
    bare = Run("", times, (), np.empty((len(times), 0)), rpm)
    free = simulator.parameters.free(truth)
    at_frames = interpolation(times, simulator.scene.step)
    simulated = simulator.run(free, motor_rate(simulator.scene, bare), at_frames.n_steps)
    assert simulated.report.ok
    values = at_frames(simulated.observed)
    return Run(f"rpm{rpm:g}", times, (0, 1, 2, 3), values, rpm, **fields)


@pytest.fixture(scope="session")
def dataset(simulator: Simulator) -> Dataset:
    """Two runs without noise."""
    runs = [synthetic_run(simulator, rpm, TIMES, TRUTH) for rpm in RATES]
    return Dataset(simulator.scene, tuple(runs))


@pytest.fixture
def short_previews(monkeypatch) -> None:
    """Take every motion for steady after one call, so that previews are half as long as tracks."""
    monkeypatch.setattr("fitting.model.is_steady", lambda *_: True)


@pytest.fixture
def fails_below(monkeypatch) -> Callable[[float], None]:
    """Makes simulations fail where C_r is less than a number."""

    def install(least: float) -> None:
        true_run = Simulator.run

        def run(self, free, *args):
            simulated = true_run(self, free, *args)
            if np.exp(free[1]) >= least:
                return simulated
            code = np.asarray(Status.LINE_SEARCH)
            failed = replace(simulated.report, status=code, failed_at=np.asarray(0.5))
            return replace(simulated, report=failed)

        monkeypatch.setattr(Simulator, "run", run)

    return install
