"""What has been simulated, kept for a fit that is interrupted and started again."""

import warnings
from dataclasses import fields
from pathlib import Path

import numpy as np

from derjax.core.errors import WriteWarning
from derjax.integrate.frames import RolloutStats
from derjax.io.files import atomic_path

from .simulate import SimulatedTrack

MOST_IN_MEMORY = 64
"""Evaluations that are kept without a directory."""

ARRAYS = ("observed", "sensitivity", "orientation", "turning")


class Store:
    """Simulations of all runs, by a key, in a directory or, without one, in memory.

    Attributes:
        directory: where they are; None if only in memory.
    """

    def __init__(self, directory: Path | None) -> None:
        self.directory = directory
        self._memory: dict[str, list[SimulatedTrack]] = {}

    def put(self, key: str, simulated: list[SimulatedTrack]) -> None:
        """Keep the simulations of all runs."""
        self._memory[key] = simulated
        if len(self._memory) > MOST_IN_MEMORY:
            del self._memory[next(iter(self._memory))]
        if self.directory is None:
            return
        arrays = {}
        for k, one in enumerate(simulated):
            arrays |= {f"{k}.{name}": getattr(one, name) for name in ARRAYS}
            arrays |= {
                f"{k}.report.{f.name}": getattr(one.report, f.name) for f in fields(RolloutStats)
            }
        try:
            with atomic_path(self.directory / f"{key}.npz") as temporary:
                np.savez(temporary, **arrays)
        except OSError as error:
            told = f"{error}; the fit goes on, but what it simulates from here on is not kept"
            warnings.warn(told, WriteWarning, stacklevel=2)
            self.directory = None

    def get(self, key: str, step: float) -> list[SimulatedTrack] | None:
        """What was kept under a key; None if nothing was.

        Args:
            key: as for `put`.
            step: s, of the simulation.
        """
        if key in self._memory:
            return self._memory[key]
        if self.directory is None:
            return None
        try:
            with np.load(self.directory / f"{key}.npz", allow_pickle=False) as file:
                arrays = dict(file)
        except FileNotFoundError:
            return None
        simulated = []
        for k in range(len({name.split(".")[0] for name in arrays})):
            kept = {name: arrays[f"{k}.{name}"] for name in ARRAYS}
            report = RolloutStats(
                **{f.name: arrays[f"{k}.report.{f.name}"] for f in fields(RolloutStats)}
            )
            time = step * np.arange(len(kept["observed"]))
            simulated.append(SimulatedTrack(time=time, report=report, **kept))
        self._memory[key] = simulated
        return simulated
