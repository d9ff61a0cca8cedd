"""What is run: robots, drag, meshes, schemes, lengths of steps and tolerances."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from derjax.scenes.file import SceneFile
from derjax.scenes.ingredients.time import TOLERANCES as DEFAULTS

FRAME = 0.1
FINEST_STEP = 0.05 / 64
STEPS = (0.1, 0.05, 0.1 / 3, 0.025, 0.0125, 0.00625, 0.003125)
TOLERANCES = (1e-2, 5e-3, 3e-3, 2e-3, 1e-3, 5e-4, 3e-4, 1e-4, 3e-5, 1e-5)
EXPLICIT = (1e-4, 2.5e-4, 5e-4, 1e-3, 2e-3)
MESHES = {"single": (10e-3, 5e-3, 2.5e-3), "two": (10e-3, 5e-3)}
FINEST_MESH = 2.5e-3
MESH_TOLERANCE = 3e-4
"""Of implicit Euler, with which meshes are compared: what it adds is the same on all of them."""

CASES: dict[str, dict[str, Any]] = {
    "single": {"robot": {"pitch": 44.5e-3}, "end": 20.0},
    "two": {
        "robot": {"kind": "two_flagella", "pitch": 31.8e-3, "phase": [np.pi, 0.0]},
        "end": 10.0,
    },
}


@dataclass(frozen=True)
class Setting:
    """One run: what is simulated, and how.

    Attributes:
        case: of `CASES`.
        drag: "rss" or "rft".
        mesh: m, shortest that an edge may be.
        scheme: as in scene files.
        step: s; of the first step only, if there is a tolerance.
        tolerance: of steps that adapt.
    """

    case: str
    drag: str
    mesh: float
    scheme: str
    step: float
    tolerance: float | None = None

    @property
    def name(self) -> str:
        """For files and for people."""
        how = f"{self.step:.6g}" if self.tolerance is None else f"tol{self.tolerance:g}"
        return f"{self.case}-{self.drag}-{1e3 * self.mesh:g}mm-{self.scheme}-{how}"

    @property
    def file(self) -> SceneFile:
        """The scene."""
        case = CASES[self.case]
        times = {"step": self.step, "end": case["end"], "frame": FRAME, "scheme": self.scheme}
        if self.tolerance is not None:
            times["tolerance"] = self.tolerance
        return SceneFile.model_validate(
            {
                "robot": case["robot"] | {"edge_length": self.mesh},
                "fluid": {"hydrodynamics": self.drag},
                "time": times,
            }
        )

    @property
    def program(self) -> tuple[Any, ...]:
        """What decides which program is compiled."""
        return self.case, self.drag, self.mesh, self.scheme, self.tolerance is None


def default(case: str, drag: str = "rss", mesh: float = 5e-3) -> Setting:
    """What a scene file that says nothing of steps gets."""
    file = SceneFile()
    return Setting(case, drag, mesh, file.time.scheme, file.step, file.time.tolerance)


def reference(case: str, drag: str, mesh: float) -> Setting:
    """The run in the finest steps."""
    return Setting(case, drag, mesh, "trbdf2", FINEST_STEP)


def settings(case: str, quick: bool) -> list[Setting]:
    """All runs of a case."""
    chosen: list[Setting] = []
    drags = ("rss",) if quick else ("rss", "rft")
    steps = STEPS[:5] if quick else STEPS
    tolerances = sorted({*DEFAULTS.values(), *((3e-3,) if quick else TOLERANCES)})
    for drag in drags:
        for mesh in (5e-3,) if quick else MESHES[case]:
            fixed = [Setting(case, drag, mesh, s, h) for s in ("trbdf2", "euler") for h in steps]
            adaptive = [
                Setting(case, drag, mesh, s, SceneFile().step, tolerance)
                for s in ("trbdf2", "euler")
                for tolerance in tolerances
            ]
            chosen += [reference(case, drag, mesh), *fixed, *adaptive]
        if not quick:
            explicit = EXPLICIT if case == "single" else EXPLICIT[:1]
            chosen += [Setting(case, drag, 5e-3, "explicit", h) for h in explicit]
            finer = (1.25e-3,) if case == "single" else (FINEST_MESH,)
            start = SceneFile().step
            chosen += [Setting(case, drag, m, "euler", start, MESH_TOLERANCE) for m in finer]
    return chosen
