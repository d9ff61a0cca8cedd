"""`derjax plan`: which further runs would narrow the parameters of a fit most."""

import argparse
import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from derjax import InputError
from derjax.commands.options import add_quiet
from derjax.io.output import Output, output_directory

from ..calibrate import beginning
from ..joint.fit import calibrate_jointly
from ..report import table
from ..tracks import Dataset, load_dataset
from .information import CHANNELS, Plan, plan

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HELP = "Say which further runs would narrow the parameters of a fit most."
TABLE, FIGURE = "plan.csv", "plan.png"
COLOURS = ("#c8442b", "#2f6fb0", "#4b9a4b", "#8a56a8", "#777777")
LINES = ("-", "--", ":", "-.")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `derjax plan`."""
    parser.add_argument("dataset", type=Path, metavar="DATASET.toml", help="tracks and scene")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="where the results go"
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace the results that are in DIR"
    )
    parser.add_argument(
        "--parameters",
        nargs="+",
        default=["C_t", "C_r"],
        metavar="NAME",
        help="parameters of the scene (default: C_t C_r)",
    )
    parser.add_argument(
        "--rates",
        nargs="+",
        type=float,
        metavar="RPM",
        help="of the motor (default: six from half the slowest to one and a half of the fastest)",
    )
    parser.add_argument(
        "--durations",
        nargs="+",
        type=float,
        default=[60.0, 240.0],
        metavar="S",
        help="of tracks (default: 60 240)",
    )
    parser.add_argument(
        "--interval",
        type=float,
        metavar="S",
        help="between frames (default: that of the tracks that there are, else 1)",
    )
    add_quiet(parser)


def run(args: argparse.Namespace) -> int:
    """Fit what there is, look at what might come, write and print a table.

    Raises:
        InputError: dataset or arguments are wrong, or there are results already.
        SolverError: there is no fit, or no gait at some rate.
    """
    dataset = load_dataset(args.dataset)
    beginning(dataset, args.parameters, {})
    rates = args.rates or _rates(dataset)
    for name, values in (("--rates", rates), ("--durations", args.durations)):
        if any(not math.isfinite(v) or v == 0 or (name == "--durations" and v < 0) for v in values):
            raise InputError(f"{name}: must be numbers that are not 0")
    interval = args.interval or _interval(dataset)
    if not interval > 0:
        raise InputError(f"--interval {interval:g}: must be positive")
    with output_directory(args.output) as output:
        for name in (TABLE, FIGURE):
            if (output.path / name).exists() and not args.overwrite:
                raise InputError(
                    f"{output.path / name}: exists already; use --overwrite to replace it"
                )
        fit, solved = calibrate_jointly(dataset, args.parameters)
        if not args.quiet:
            print(f"{args.dataset}, with the data that there are ({fit.status}):\n{table(fit)}\n")

        def on_rate(rpm: float) -> None:
            if not args.quiet:
                print(f"{rpm:g} rpm", flush=True)

        found = plan(solved, rates, args.durations, interval, on_rate)
        _write(found, output, figures=not args.no_figures)
        if not args.quiet:
            print(f"\n{words(found)}\n\n{output.path / TABLE}")
            if not args.no_figures:
                print(output.path / FIGURE)
    return 0


def _rates(dataset: Dataset) -> list[float]:
    known = [np.ravel(run.motor_rpm) for run in dataset.runs if run.motor_rpm is not None]
    known += [rates.motor_rpm for rates in dataset.rates]
    if not known:
        known = [np.ravel(dataset.scene.parameters["rpm"])]
    size = np.abs(np.concatenate(known))
    sign = float(np.sign(np.concatenate(known)[0]))
    ends = 0.5 * size.min(), 1.5 * size.max()
    return [sign * float(f"{rpm:.3g}") for rpm in np.linspace(*ends, 6)]


def _interval(dataset: Dataset) -> float:
    gaps = [float(np.median(np.diff(run.time))) for run in dataset.runs]
    return float(np.median(gaps)) if gaps else 1.0


def words(found: Plan) -> str:
    """The best runs as a table, one line for each parameter and kind of track."""
    lines = [
        f"frames {found.interval:g} s apart, noise {1e3 * found.noise[0]:.3g} mm and "
        f"{found.noise[1]:.3g} rad",
        "standard errors of parameters, in per cent, with one more run that begins after the "
        "transient:",
        f"{'channels':<16} {'duration':>9} {'best rpm':>9}  " + "  ".join(found.now),
        f"{'(none)':<16} {'':>9} {'':>9}  "
        + "  ".join(_percent(std, name) for name, std in found.now.items()),
    ]
    for label in CHANNELS:
        for duration in dict.fromkeys(one.duration for one in found.candidates):
            chosen = [c for c in found.candidates if (c.channels, c.duration) == (label, duration)]
            best = min(chosen, key=lambda one: sum(_finite(std) for std in one.std.values()))
            lines.append(
                f"{label:<16} {duration:>7g} s {best.rpm:>9g}  "
                + "  ".join(_percent(std, name) for name, std in best.std.items())
            )
    for name in found.now:
        best = found.best(name)
        lines.append(
            f"{name}: best known after {best.duration:g} s at {best.rpm:g} rpm of {best.channels}"
        )
    return "\n".join(lines)


def _finite(std: float) -> float:
    return min(std, 1e6)


def _percent(std: float, name: str) -> str:
    said = f"{100 * std:.3g}" if std < 10 else "lost"
    return f"{said:>{max(5, len(name))}}"


def _write(found: Plan, output: Output, figures: bool) -> None:
    names = list(found.now)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["motor_rpm", "duration_s", "channels", *(f"relative_std_{n}" for n in names)])
    for one in found.candidates:
        std = [f"{one.std[n]:.6g}" for n in names]
        writer.writerow([f"{one.rpm:g}", f"{one.duration:g}", one.channels, *std])
    with output.replacing(TABLE) as temporary:
        temporary.write_text(text.getvalue(), encoding="utf-8")
    if figures:
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # slow to import

        with output.replacing(FIGURE) as temporary:
            FigureCanvasAgg(figure(found)).print_figure(str(temporary), format="png", dpi=150)


def figure(found: Plan) -> "Figure":
    """Errors after one more run over its rate, by channels (colour) and duration (dashes)."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    names = list(found.now)
    canvas = Figure(figsize=(4.6 * len(names), 3.8), layout="constrained")
    axes = canvas.subplots(1, len(names), squeeze=False)[0]
    durations: Sequence[float] = list(dict.fromkeys(one.duration for one in found.candidates))
    for axis, name in zip(axes, names, strict=True):
        for label, colour in zip(CHANNELS, COLOURS, strict=True):
            for line, duration in enumerate(durations):
                chosen = [
                    (one.rpm, 100 * one.std[name])
                    for one in found.candidates
                    if (one.channels, one.duration) == (label, duration)
                ]
                rpm, std = np.array(sorted(chosen)).T
                axis.plot(
                    rpm,
                    np.where(std < 1e3, std, np.nan),
                    LINES[line % len(LINES)],
                    color=colour,
                    lw=1.3,
                    label=f"{label}, {duration:g} s",
                )
        if math.isfinite(found.now[name]):
            axis.axhline(100 * found.now[name], color="#222222", lw=0.8, label="no further run")
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axis.yaxis.set_minor_formatter(NullFormatter())
        axis.set_xlabel("motor (rpm)")
        axis.set_title(name, fontsize=10)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("standard error with one more run (%)")
    axes[-1].legend(fontsize=6, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return canvas
