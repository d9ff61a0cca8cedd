"""`derjax fit`: calibrate the parameters of a scene against tracks."""

import argparse
import sys
import threading
import time
from pathlib import Path

from derjax import InputError

from .calibrate import Fit, Progress, calibrate
from .report import table, write
from .tracks import load_dataset

HELP = "Fit drag prefactors, or other parameters, to tracked motions."
INTERRUPTED = 130
UNFINISHED = 2


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `derjax fit`."""
    parser.add_argument("dataset", type=Path, metavar="DATASET.toml", help="tracks and scene")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="DIR",
        help="directory for fit.json and fit.png; made if it does not exist",
    )
    parser.add_argument(
        "--parameters",
        nargs="+",
        default=["C_t", "C_r"],
        metavar="NAME",
        help="parameters of the scene to fit (default: C_t C_r)",
    )
    parser.add_argument(
        "--start",
        nargs="+",
        default=[],
        metavar="NAME=VALUE",
        help="where to start (default: the values of the scene)",
    )
    parser.add_argument("--max-iterations", type=int, default=30, metavar="N", help="(default: 30)")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier fit")


def run(args: argparse.Namespace) -> int:
    """Fit, write the outcome and print it.

    Returns:
        0 if the fit converged, 2 if it did not, 130 if it was interrupted; in all three cases
        fit.json holds the best parameters found.

    Raises:
        InputError: dataset, scene, tracks or arguments are wrong.
        SolverError: the simulation fails with the parameters of the start.
    """
    initial = _start(args.start)
    if args.max_iterations < 1:
        raise InputError(f"--max-iterations {args.max_iterations}: must be at least 1")
    output: Path = args.output
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: is not a directory")
    if (output / "fit.json").exists() and not args.overwrite:
        raise InputError(f"{output / 'fit.json'}: exists already; use --overwrite to replace it")
    dataset = load_dataset(args.dataset)
    output.mkdir(parents=True, exist_ok=True)
    frames = sum(run.time.size for run in dataset.runs)
    print(f"{args.dataset}: {len(dataset.runs)} runs, {frames} frames")
    printer = _Printer()
    fit = calibrate(
        dataset, args.parameters, initial, progress=printer, max_iterations=args.max_iterations
    )
    printer.clear()
    json_path, figure_path = write(fit, output)
    _print_outcome(fit)
    print(f"\n{json_path}\n{figure_path}")
    if fit.status == "interrupted":
        return INTERRUPTED
    return 0 if fit.status == "converged" else UNFINISHED


def _start(words: list[str]) -> dict[str, float]:
    start = {}
    for word in words:
        name, equals, value = word.partition("=")
        try:
            start[name.strip()] = float(value)
        except ValueError:
            equals = ""
        if not equals:
            raise InputError(f"--start {word}: should be NAME=VALUE with a number, like C_t=4.8")
    return start


def _print_outcome(fit: Fit) -> None:
    print(f"\n{fit.status} after {fit.iterations} iterations, {fit.wall_time:.0f} s\n")
    print(table(fit))
    names = list(fit.estimates)
    if len(names) > 1:
        print("\ncorrelation " + " ".join(f"{name:>8}" for name in names))
        for name, row in zip(names, fit.correlation, strict=True):
            print(f"{name:<11} " + " ".join(f"{value:8.3f}" for value in row))
    print("\nresiduals (rms)")
    for one in fit.runs:
        print(f"{one.run.name}: {_rms(one.rms)}")
    for warning in fit.warnings:
        print(f"\nwarning: {warning}", file=sys.stderr)


def _rms(rms: dict[str, float]) -> str:
    parts = []
    if "position" in rms:
        parts.append(f"{1e3 * rms['position']:.4g} mm")
    if "head_angle" in rms:
        parts.append(f"{rms['head_angle']:.4g} rad")
    return ", ".join(parts)


class _Printer:
    """Prints a line for every iteration and, on a terminal, how far the current one is."""

    def __init__(self) -> None:
        self.live = sys.stdout.isatty()
        self.shown = 0.0
        self.lock = threading.Lock()

    def __call__(self, progress: Progress) -> None:
        with self.lock:
            if progress.latest is not None:
                self.clear()
                print(_line(progress), flush=True)
            elif progress.stage == "compile":
                print("compiling ...", flush=True)
            elif self.live and time.monotonic() - self.shown > 0.2:
                self.shown = time.monotonic()
                what = "start" if progress.stage == "compare" else progress.stage
                text = f"{what}: {100 * progress.done:3.0f} %, {_left(progress)}"
                print(f"\r{text:<60}", end="", flush=True)

    def clear(self) -> None:
        """Wipe the line that says how far the current iteration is."""
        if self.live:
            print(f"\r{'':<60}\r", end="", flush=True)


def _line(progress: Progress) -> str:
    latest = progress.latest
    assert latest is not None
    values = "  ".join(f"{name} = {value:<9.6g}" for name, value in progress.values.items())
    rejected = "" if latest.accepted else "  (step rejected)"
    return (
        f"{progress.stage:>6} {progress.iteration:2d}: loss {latest.loss:<10.6g} {values} "
        f"rms {_rms(latest.rms)}  {_left(progress)}{rejected}"
    )


def _left(progress: Progress) -> str:
    return f"{progress.rate:.0f} steps/s, about {max(0.0, progress.seconds_left):.0f} s left"
