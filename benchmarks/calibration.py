"""Does a calibration find the truth, whatever was tracked, and does it say so where it cannot?

Tracks of a robot with known prefactors, with noise, are fitted from starts that are off by up to a
factor of five: for five kinds of tracked channels, several frame rates and seeds of the noise, with
one and with two flagella. Counted are fits whose truth lies within three standard errors, fits
that say that something is not determined, and, which must not be, fits that are wrong and
say nothing.

    python -m benchmarks.calibration [--quick] [--only one|two] [--figure]

A run that is stopped goes on where it was: only what the table lacks is computed.
"""

import csv
import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from derjax import SceneFile
from derjax.io.files import atomic_path
from fitting.calibrate import calibrate
from fitting.model import Model
from fitting.observe import interpolation
from fitting.outcome import Fit
from fitting.tracks import Dataset, Run
from fitting.transforms import select_parameters

from .command import command_line

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

# Coarse meshes and local drag: what is tried out here is the search, not the fluid. Flagella so far
# apart that they do not touch: one calibration of touching ones takes as long as
# all others together.
SCENES = {
    "one": {
        "robot": {"edge_length": 0.02},
        "fluid": {"hydrodynamics": "rft"},
        "time": {"step": 0.05, "end": 60.0},
    },
    "two": {
        "robot": {"edge_length": 0.02, "kind": "two_flagella", "separation": 0.1},
        "fluid": {"hydrodynamics": "rft"},
        "time": {"step": 0.05, "end": 60.0, "tolerance": 5e-3},
    },
}
LENGTH_OF_TWO = 20.0
"""s, of the tracks of two flagella."""

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

    def length(self, usual: float) -> float:
        """Length of the track, s."""
        return LENGTH_OF_TWO if self.flagella == "two" else usual

    @property
    def identity(self) -> tuple[str, ...]:
        """The first columns of its row."""
        numbers = (self.frames_per_s, *self.start)
        return self.flagella, self.channels, *(f"{n:g}" for n in numbers), str(self.seed)


def cases(quick: bool, only: str | None) -> Iterator[Case]:
    """The grid; two flagella at one frame rate."""
    rates = (1.0,) if quick else tuple(FRAMES)
    starts, seeds = (STARTS[:2], SEEDS[:1]) if quick else (STARTS, SEEDS)
    if only != "two":
        for seed, start, rate, channels in itertools.product(seeds, starts, rates, CHANNELS):
            yield Case("one", channels, rate, start, seed)
    if only != "one":
        for seed, start, channels in itertools.product(seeds[:2], starts[:2], CHANNELS):
            yield Case("two", channels, 1.0, start, seed)


def scene_of(flagella: str) -> SceneFile:
    """A coarse robot, in steps of 50 ms."""
    return SceneFile.model_validate(SCENES[flagella])


def track(scene: SceneFile, end: float) -> np.ndarray:
    """(t, 4) what a camera with a frame in every step would see of the true robot."""
    times = np.arange(1, round(end / scene.step)) * scene.step
    run = Run("", times, (0,), np.zeros((len(times), 1)))
    model = Model(Dataset(scene, (run,)), select_parameters(NAMES, scene.parameters))
    trial = model.whole(model.parameters.free(TRUTH))
    if trial is None:
        raise SystemExit(model.failure)
    return trial.model[0].observed


def dataset_of(case: Case, scene: SceneFile, seen: np.ndarray) -> Dataset:
    """The tracks of a case, with noise that the fit has to find out."""
    end = case.length(FRAMES[case.frames_per_s])
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
        **dict(zip(COLUMNS[:6], case.identity, strict=True)),
        "status": fit.status,
        **numbers,
        "inside": str(inside),
        "warnings": str(len(fit.warnings)),
        "iterations": str(fit.iterations),
        "previews": str(fit.previews),
        "seconds": f"{seconds:.1f}",
    }


def read(path: Path) -> list[dict[str, str]]:
    """The rows of an earlier run that was stopped; none if there was none."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def write(path: Path, rows: list[dict[str, str]]) -> None:
    """The table, replaced in one go."""
    with (
        atomic_path(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as stream,
    ):
        writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def verdict(row: dict[str, str]) -> str:
    """What is to be thought of a calibration."""
    if row["inside"] == "True":
        open_ = "inf" in (row["C_t_std"], row["C_r_std"])
        return "says that it is not determined" if open_ else "truth inside 3 standard errors"
    return "outside, with a warning" if int(row["warnings"]) else "outside, and silent"


VERDICTS = {
    "truth inside 3 standard errors": "#3b7d4f",
    "says that it is not determined": "#b8bcc4",
    "outside, with a warning": "#e0a030",
    "outside, and silent": "#c8442b",
}


def counted(rows: list[dict[str, str]]) -> dict[tuple[str, str], dict[str, int]]:
    """How many rows have which verdict, by flagella and channels."""
    counts: dict[tuple[str, str], dict[str, int]] = {}
    for row in rows:
        of_kind = counts.setdefault((row["flagella"], row["channels"]), dict.fromkeys(VERDICTS, 0))
        of_kind[verdict(row)] += 1
    return counts


def summary(rows: list[dict[str, str]]) -> str:
    """The page of results."""
    counts = counted(rows)
    total = {name: sum(c[name] for c in counts.values()) for name in VERDICTS}
    good = sum(row["inside"] == "True" for row in rows)
    lines = [
        "# Calibrations against a known truth",
        "",
        f"`python -m benchmarks.calibration`: {len(rows)} fits, of which {good} "
        f"({100 * good / len(rows):.1f} %) have the truth inside three standard errors of every "
        f"parameter or say that a parameter is not determined, and "
        f"{total['outside, and silent']} are wrong without a warning. Starts are off by factors of "
        "five both ways, the noise (0.1 mm, 0.02 rad) is not given.",
        "",
        "| flagella | tracked | " + " | ".join(VERDICTS) + " | s a fit |",
        "|---|---|" + "---|" * (len(VERDICTS) + 1),
    ]
    for (flagella, channels), count in counts.items():
        seconds = [
            float(row["seconds"])
            for row in rows
            if (row["flagella"], row["channels"]) == (flagella, channels)
        ]
        numbers = " | ".join(str(count[name]) for name in VERDICTS)
        lines.append(
            f"| {flagella} | {channels} | {numbers} | {np.median(seconds):.0f} "
            f"({min(seconds):.0f} to {max(seconds):.0f}) |"
        )
    return "\n".join([*lines, "", "![Calibrations](calibration.png)", ""])


def figure(rows: list[dict[str, str]]) -> Figure:
    """Fitted over true prefactors, and how many fits have which verdict."""
    canvas = Figure(figsize=(11.0, 4.2), layout="constrained")
    axes = canvas.subplots(1, 3, width_ratios=(1.0, 1.0, 1.3))
    kinds = list(dict.fromkeys((row["flagella"], row["channels"]) for row in rows))
    rng = np.random.default_rng(0)
    for axis, name in zip(axes[:2], NAMES, strict=True):
        axis.axvline(1.0, color="#444444", lw=0.8)
        for row in rows:
            place = len(kinds) - 1 - kinds.index((row["flagella"], row["channels"]))
            place += rng.uniform(-0.3, 0.3)
            ratio, std = (float(row[f"{name}{t}"]) / TRUTH[name] for t in ("", "_std"))
            color = VERDICTS[verdict(row)]
            if np.isfinite(std):
                low = max(ratio - 2 * std, 1e-3)
                axis.plot([low, ratio + 2 * std], [place] * 2, color=color, lw=0.7, alpha=0.6)
            axis.plot([np.clip(ratio, 1e-2, 1e2)], [place], "o", ms=2.5, color=color)
        axis.set_xscale("log")
        axis.set_xlim(0.01, 100.0)
        axis.set_yticks(range(len(kinds)))
        labels = [f"{channels} ({flagella})" for flagella, channels in reversed(kinds)]
        axis.set_yticklabels(labels if axis is axes[0] else [])
        axis.set_xlabel(f"{name} found / true")
    counts = counted(rows)
    left = np.zeros(len(kinds))
    for name, color in VERDICTS.items():
        values = np.array([counts[kind][name] for kind in reversed(kinds)])
        axes[2].barh(range(len(kinds)), values, left=left, color=color, label=name)
        left += values
    axes[2].set_yticks([])
    axes[2].set_xlabel("fits")
    axes[2].legend(
        fontsize=8, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2
    )
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
    return canvas


def main() -> None:
    """Run what of the grid is missing in the table, and draw the figure."""
    parser = command_line(__doc__)
    parser.add_argument("--quick", action="store_true", help="few starts, one seed and frame rate")
    parser.add_argument("--only", choices=tuple(SCENES), help="robots with so many flagella")
    parser.add_argument("--figure", action="store_true", help="draw what there is, run nothing")
    args = parser.parse_args()
    path = args.output / "calibration.csv"
    rows = read(path)
    if not args.figure:
        _run(list(cases(args.quick, args.only)), rows, path)
    with atomic_path(args.output / "calibration.md") as temporary:
        temporary.write_text(summary(rows), encoding="utf-8")
    with atomic_path(args.output / "calibration.png") as temporary:
        figure(rows).savefig(temporary, dpi=140)


def _run(wanted: list[Case], rows: list[dict[str, str]], path: Path) -> None:
    """Fit the cases that have no row yet; the table is written anew after each."""
    done = {tuple(row[c] for c in COLUMNS[:6]) for row in rows}
    missing = [case for case in wanted if case.identity not in done]
    seen: dict[str, np.ndarray] = {}
    first = time.perf_counter()
    for k, case in enumerate(missing):
        scene = scene_of(case.flagella)
        if case.flagella not in seen:
            seen[case.flagella] = track(scene, case.length(max(FRAMES.values())) + 1.0)
        begun = time.perf_counter()
        fit = fitted(case, scene, seen[case.flagella])
        rows.append(row_of(case, fit, time.perf_counter() - begun))
        write(path, rows)
        left = (time.perf_counter() - first) / (k + 1) * (len(missing) - k - 1)
        shown = " ".join(rows[-1].values())
        print(f"{k + 1} of {len(missing)}, {left:.0f} s left: {shown}", flush=True)


if __name__ == "__main__":
    main()
