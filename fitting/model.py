"""Tracks as functions of the parameters: what a search asks for.

A `Model` simulates all runs of a dataset with their derivatives, either to their ends, or as far
as is needed to see how the robot swims once it swims steadily (a preview; see `screw`). What it has
simulated it remembers, in a directory if it is given one, so that an interrupted fit which is
started again with the same words takes the same way without simulating it again.
"""

import hashlib
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from derjax import Status

from .levenberg import Evaluation
from .observe import exposed, interpolation, steps_until
from .residuals import Predicted, residuals
from .screw import Motion, extended, is_steady
from .simulate import SimulatedTrack, Simulator, motor_rate, steps_per_call
from .store import Store
from .tracks import Dataset, Run
from .transforms import Parameters

Free = Float[np.ndarray, " p"]

SMALL = 1e-4
"""Change of a free parameter for the derivatives of a motion that is continued."""


@dataclass(frozen=True)
class Work:
    """How much has been simulated: time steps, and the seconds that they took."""

    steps: int = 0
    seconds: float = 0.0

    @property
    def rate(self) -> float:
        """Steps per second; NaN before the first."""
        return self.steps / self.seconds if self.seconds > 0 else float("nan")


class Model:
    """The runs of a dataset, simulated with some parameters.

    Attributes:
        dataset: tracks and scene.
        parameters: what is varied.
        work: what has been simulated so far.
        failure: why the last evaluation gave nothing.
    """

    def __init__(
        self,
        dataset: Dataset,
        parameters: Parameters,
        on_steps: Callable[[int, int], None] = lambda done, wanted: None,
        store: Path | None = None,
    ) -> None:
        self.dataset, self.parameters = dataset, parameters
        self.step = dataset.scene.step
        self.rates = [motor_rate(dataset.scene, run) for run in dataset.runs]
        self.steps = [steps_until(run.time, run.exposure, self.step) for run in dataset.runs]
        self.simulator = Simulator(
            dataset.scene, parameters, steps_per_call(max(self.steps)), dataset.sight
        )
        self.periods = [_period(dataset, np.asarray(rate)) for rate in self.rates]
        self.work, self.failure = Work(), ""
        self._on_steps, self._lock = on_steps, threading.Lock()
        self._store = Store(store)

    def of(self, dataset: Dataset) -> "Model":
        """The model of other runs in the same scene, which shares the compiled program."""
        other = Model(dataset, self.parameters, self._on_steps, self._store.directory)
        other.simulator = self.simulator
        return other

    def values(self, free: Free) -> dict[str, float]:
        """The parameters by name, in the units of the scene."""
        named = self.parameters.values(jnp.asarray(free))
        return {name: float(value) for name, value in named.items()}

    def compile(self, free: Free) -> None:
        """Compile the program that all runs share."""
        self.simulator.compile(free, self.rates[0])

    def whole(self, free: Free) -> Evaluation[list[SimulatedTrack]] | None:
        """Runs simulated to their last frames; None if a step fails (`failure` says how)."""
        return self._trial(free, self.dataset.runs, preview=False)

    def preview(
        self, free: Free, runs: Sequence[Run] | None = None
    ) -> Evaluation[list[SimulatedTrack]] | None:
        """Runs simulated until they are steady, and continued from there.

        Args:
            free: (p,) free parameters.
            runs: other tracks of the same motions to compare with.
        """
        return self._trial(free, self.dataset.runs if runs is None else runs, preview=True)

    def _trial(
        self, free: Free, runs: Sequence[Run], preview: bool
    ) -> Evaluation[list[SimulatedTrack]] | None:
        simulated = self._recall(free, preview)
        for run, one in zip(runs, simulated, strict=True):
            if not one.report.ok:
                self.failure = f"run {run.name!r}: {one.report.message()}"
                return None
        predicted = [
            predict(run, one, self.step, period)
            for run, one, period in zip(runs, simulated, self.periods, strict=True)
        ]
        return Evaluation(residuals(runs, predicted), simulated)

    def _recall(self, free: Free, preview: bool) -> list[SimulatedTrack]:
        """What was simulated before, or now is.

        A preview stays one when the whole of it is known as well: a fit that is resumed has to
        find what it found before.
        """
        kinds = ("preview", "whole") if preview else ("whole",)
        keys = [_key(free, self.rates, kind) for kind in kinds]
        for key in keys:
            if (known := self._store.get(key, self.step)) is not None:
                return known
        simulated = self._simulate(free, preview)
        reached = [len(one.time) > steps for one, steps in zip(simulated, self.steps, strict=True)]
        self._store.put(keys[-1] if all(reached) else keys[0], simulated)
        return simulated

    def _simulate(self, free: Free, preview: bool) -> list[SimulatedTrack]:
        begun, before, done = time.perf_counter(), self.work, 0

        def on_steps(steps: int) -> None:
            nonlocal done
            with self._lock:
                done += steps
                seconds = before.seconds + time.perf_counter() - begun
                self.work = Work(before.steps + done, seconds)
            self._on_steps(done, sum(self.steps))

        enough = [
            partial(_is_enough, step=self.step, period=period, run=run) if preview else _never
            for run, period in zip(self.dataset.runs, self.periods, strict=True)
        ]
        simulated = self.simulator.runs(free, self.rates, self.steps, on_steps, enough)
        while any(one.report.status == Status.CAPACITY for one in simulated):
            self.simulator = self.simulator.enlarged()
            simulated = self.simulator.runs(free, self.rates, self.steps, on_steps, enough)
        return simulated


def _key(free: Free, rates: Sequence[Array], kind: str) -> str:
    numbers = [np.asarray(free, float), *(np.asarray(rate, float).ravel() for rate in rates)]
    return f"{kind}-{hashlib.sha256(np.concatenate(numbers).tobytes()).hexdigest()[:16]}"


def _never(motion: Motion) -> bool:
    return False


def _is_enough(motion: Motion, step: float, period: float | None, run: Run) -> bool:
    return period is not None and is_steady(motion, step, period, float(run.time[-1]))


def _period(dataset: Dataset, rpm: np.ndarray) -> float | None:
    """Length (s) of a turn of the motors after which everything repeats; None if nothing does."""
    rates = np.unique(np.abs(rpm))
    if dataset.scene.motor_table is not None or dataset.scene.gravity is not None:
        return None
    if dataset.sight is not None:
        return None  # the robot rolls: from a fixed side its silhouette is another one then
    return 60.0 / float(rates[0]) if len(rates) == 1 and rates[0] > 0 else None


def predict(run: Run, simulated: SimulatedTrack, step: float, period: float | None) -> Predicted:
    """What a run's camera would have seen, and the derivatives of that."""

    def simulated_at(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = interpolation(time, step)
        return at(simulated.observed), at(simulated.sensitivity)

    def continued_at(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert period is not None  # only such motions end before their last frame
        columns = []
        for k in range(simulated.sensitivity.shape[-1]):
            ends = [
                extended(simulated.moved(k, sign * SMALL), step, period, time) for sign in (-1, 1)
            ]
            columns.append((ends[1] - ends[0]) / (2 * SMALL))
        return extended(simulated.motion, step, period, time), np.stack(columns, axis=-1)

    whole = steps_until(run.time, run.exposure, step) < len(simulated.time)
    seen = exposed(simulated_at if whole else continued_at, run.time, run.exposure)
    return Predicted(*seen)
