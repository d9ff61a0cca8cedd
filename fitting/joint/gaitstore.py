"""Gaits that have been found, kept for a fit that is interrupted and started again."""

import hashlib
import warnings
from pathlib import Path

import numpy as np

from derjax.core.errors import WriteWarning
from derjax.io.files import atomic_path

from .sources import Known


class GaitStore:
    """Gaits by what they are of and the numbers that vary, in a directory; nothing without one."""

    def __init__(self, directory: Path | None) -> None:
        self.directory = directory

    def _path(self, label: str, values: np.ndarray) -> Path | None:
        if self.directory is None:
            return None
        content = label.encode() + np.ascontiguousarray(values, float).tobytes()
        return self.directory / f"gait-{hashlib.sha256(content).hexdigest()[:24]}.npz"

    def get(self, label: str, values: np.ndarray) -> Known | None:
        """What was kept; None if nothing was."""
        path = self._path(label, values)
        if path is None or not path.exists():
            return None
        with np.load(path, allow_pickle=False) as file:
            return Known(file["gait"], file["jacobian"])

    def put(self, label: str, values: np.ndarray, known: Known) -> None:
        """Keep a gait; on a full disk the fit goes on without."""
        path = self._path(label, values)
        if path is None:
            return
        try:
            with atomic_path(path) as temporary, open(temporary, "wb") as file:
                np.savez(file, gait=known.gait, jacobian=known.jacobian)
        except OSError as error:
            told = (
                f"{error}; the fit goes on, but the gaits that it finds from here on are not kept"
            )
            warnings.warn(told, WriteWarning, stacklevel=2)
            self.directory = None
