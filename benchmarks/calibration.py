"""Does a calibration find the truth, whatever was tracked, and does it say so where it cannot?

Tracks of a robot with known prefactors, with noise, are fitted from starts that are off by up to a
factor of five: for five kinds of tracked channels, several frame rates and seeds of the noise, with
one and with two flagella. Counted are fits whose truth lies within three standard errors, fits
that say that something is not determined, and, which must not be, fits that are wrong and
say nothing.

    python -m benchmarks.calibration [--quick] [--only one|two]
"""

import argparse
import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from derjax import SceneFile
from derjax.runtime import enable_compilation_cache, use_one_blas_thread
from fitting.calibrate import calibrate
from fitting.model import Model
from fitting.observe import interpolation
from fitting.outcome import Fit
from fitting.tracks import Dataset, Run
from fitting.transforms import choose

FIGURES = Path(__file__).parent.parent / "docs" / "figures"
TRUTH = {"C_t": 4.0, "C_r": 0.45}
NAMES = tuple(TRUTH)
CHANNELS = {"x": (0,), "x, y": (0, 1), "x, y, z": (0, 1, 2), "angle": (3,), "all": (0, 1, 2, 3)}
FRAMES = {0.2: 60.0, 1.0: 60.0, 30.0: 10.0}
"""Frames per second, and s."""

STARTS = ((0.2, 0.2), (5.0, 5.0), (0.2, 5.0), (5.0, 0.2))
"""Over the truth."""

SEEDS = (1, 2, 3)
NOISE = np.array([1e-4, 1e-4, 1e-4, 0.02])
"""m and rad."""

# Flagella so far apart that they do not touch: one calibration of touching ones takes as long as
# all others together.
SCENES = {
    "one": {"robot": {"edge_length": 0.015}, "time": {"step": 0.05, "end": 60.0}},
    "two": {
        "robot": {"edge_length": 0.015, "kind": "two_flagella", "separation": 0.06},
        "contact": {"method": "none"},
        "time": {"step": 0.05, "end": 60.0, "tolerance": 5e-3},
    },
}
COLUMNS = (
    "flagella", "channels", "frames_per_s", "start_C_t", "start_C_r", "seed", "status", "C_t",
    "C_t_std", "C_r", "C_r_std", "inside", "warnings", "iterations", "previews", "seconds",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One calibration of the grid."""

    flagella: str
    channels: str
    frames_per_s: float
    start: tuple[float, float]
    seed: int


def cases(quick: bool, only: str | None) -> Iterator[Case]:
    """The grid; two flagella at one frame rate."""
    rates = (1.0,) if quick else tuple(FRAMES)
    starts, seeds = (STARTS[:2], SEEDS[:1]) if quick else (STARTS, SEEDS)
    if only != "two":
        for channels, rate, start, seed in itertools.product(CHANNELS, rates, starts, seeds):
            yield Case("one", channels, rate, start, seed)
    if only != "one":
        for channels, start in itertools.product(CHANNELS, starts[:2]):
            for seed in seeds[:2]:
                yield Case("two", channels, 1.0, start, seed)


def scene_of(flagella: str) -> SceneFile:
    """A coarse robot, in steps of 50 ms."""
    return SceneFile.model_validate(SCENES[flagella])


def track(scene: SceneFile, end: float) -> np.ndarray:
    """(t, 4) what a camera with a frame in every step would see of the true robot."""
    times = np.arange(1, round(end / scene.step)) * scene.step
    run = Run("", times, (0,), np.zeros((len(times), 1)))
    model = Model(Dataset(scene, (run,)), choose(NAMES, scene.parameters))
    trial = model.whole(model.parameters.free(TRUTH))
    if trial is None:
        raise SystemExit(model.failure)
    return trial.model[0].observed


def dataset_of(case: Case, scene: SceneFile, seen: np.ndarray) -> Dataset:
    """The tracks of a case, with noise that the fit has to find out."""
    end = FRAMES[case.frames_per_s]
    times = np.arange(1, round(end * case.frames_per_s) + 1) / case.frames_per_s
    rng = np.random.default_rng(case.seed)
    values = interpolation(times, scene.step)(seen)
    values = values + NOISE * rng.normal(size=values.shape)
    channels = CHANNELS[case.channels]
    return Dataset(scene, (Run("track", times, channels, values[:, channels], free_origin=True),))


def fitted(case: Case, scene: SceneFile, seen: np.ndarray) -> Fit:
    """The calibration of a case."""
    start = {name: factor * TRUTH[name] for name, factor in zip(NAMES, case.start, strict=True)}
    return calibrate(dataset_of(case, scene, seen), NAMES, start, compare=False)


def row_of(case: Case, fit: Fit, seconds: float) -> dict[str, str]:
    """A row of the table."""
    inside = all(abs(e.value - TRUTH[name]) <= 3.0 * e.std for name, e in fit.estimates.items())
    numbers = {
        f"{name}{tail}": f"{value:.6g}"
        for name, e in fit.estimates.items()
        for tail, value in (("", e.value), ("_std", e.std))
    }
    return {
        "flagella": case.flagella,
        "channels": case.channels,
        "frames_per_s": f"{case.frames_per_s:g}",
        "start_C_t": f"{case.start[0]:g}",
        "start_C_r": f"{case.start[1]:g}",
        "seed": str(case.seed),
        "status": fit.status,
        **numbers,
        "inside": str(inside),
        "warnings": str(len(fit.warnings)),
        "iterations": str(fit.iterations),
        "previews": str(fit.previews),
        "seconds": f"{seconds:.1f}",
    }


def main() -> None:
    """Run the grid, or what of it is missing in the table, and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one start, seed and frame rate")
    parser.add_argument("--only", choices=("one", "two"))
    args = parser.parse_args()
    enable_compilation_cache()
    use_one_blas_thread()
    scenes = {name: scene_of(name) for name in SCENES}
    seen = {}
    rows = []
    for case in cases(args.quick, args.only):
        if case.flagella not in seen:
            seen[case.flagella] = track(scenes[case.flagella], max(FRAMES.values()) + 1.0)
        begun = time.perf_counter()
        fit = fitted(case, scenes[case.flagella], seen[case.flagella])
        rows.append(row_of(case, fit, time.perf_counter() - begun))
        print(" ".join(rows[-1].values()), flush=True)
        for warning in fit.warnings:
            print("    ", warning[:150])


if __name__ == "__main__":
    main()
