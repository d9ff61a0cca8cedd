"""`derjax fit`: calibrate the parameters of a scene against tracks."""

import argparse
import math
import shlex
import sys
import threading
import time
from pathlib import Path

from derjax import InputError, SolverError
from derjax.commands.options import add_output, add_quiet
from derjax.io.output import Output, output_directory

from .calibrate import beginning, calibrate
from .joint.fit import Solved, calibrate_jointly
from .joint.posterior import Posterior, posterior
from .joint.profile import Profile, profiles
from .outcome import Fit, Progress
from .report import FIGURE, NETCDF, PAGE, REPORT, as_json, rms, table, write
from .tracks import Dataset, load_dataset
from .unfinished import EVALUATIONS, begin, finish, resume

HELP = "Fit drag prefactors, or other parameters, to tracked motions."
INTERRUPTED = 130
UNFINISHED = 2


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `derjax fit`."""
    parser.add_argument("dataset", type=Path, metavar="DATASET.toml", help="tracks and scene")
    add_output(parser, resume="continue the unfinished fit in DIR")
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
    parser.add_argument(
        "--profile",
        action="store_true",
        help="also profile likelihoods: intervals that hold where the model is not linear",
    )
    parser.add_argument(
        "--posterior",
        action="store_true",
        help="also draw from the posterior by NUTS (needs pip install 'derjax[bayes]')",
    )
    add_quiet(parser)


def run(args: argparse.Namespace) -> int:
    """Fit, write the outcome and print it.

    Returns:
        0 if the fit converged, 2 if it did not, 130 if it was interrupted; in all three cases
        fit.json holds the best parameters found. What was simulated by a fit that was interrupted
        or ran out of iterations is kept, and `--resume` goes on from there.

    Raises:
        InputError: dataset, scene, tracks or arguments are wrong, or there are results that must
            not be overwritten.
        SolverError: the simulation fails with the parameters of the start.
    """
    initial = _start(args.start)
    if args.max_iterations < 1:
        raise InputError(f"--max-iterations {args.max_iterations}: must be at least 1")
    dataset = load_dataset(args.dataset)
    beginning(dataset, args.parameters, initial)  # before anything of another fit is replaced
    with output_directory(args.output) as output:
        _check_output(args, output)
        identity = begin if not args.resume else resume
        store = identity(output, dataset, args.parameters, initial)
        return _fit(args, dataset, initial, output, store)


def _fit(
    args: argparse.Namespace,
    dataset: Dataset,
    initial: dict[str, float],
    output: Output,
    store: Path,
) -> int:
    """`run`, with files and arguments checked, in a directory that can be written to."""
    if not args.quiet:
        print(f"{args.dataset}: {_contents(dataset)}")
        for run in dataset.runs:
            print("\n".join(f"{run.name}: {one}" for one in run.said))
    printer = _Printer(args.quiet)
    again = f"resume with: {_command(args)} --resume"
    try:
        fit, solved = _calibrated(args, dataset, initial, store, printer)
    except KeyboardInterrupt:
        printer.clear()
        print(f"derjax: interrupted before there was a result; {again}", file=sys.stderr)
        return INTERRUPTED
    except SolverError:
        finish(output)  # it would fail again
        raise
    printer.clear()
    if not args.quiet:
        _print_outcome(fit)
    for warning in fit.warnings:
        print(f"\nwarning: {warning}", file=sys.stderr)
    try:
        more = _uncertain(args, solved, fit)
        paths = [*write(fit, output, figures=not args.no_figures, more=as_json(*more))]
        from .netcdf import write_netcdf  # slow to import

        write_netcdf(fit, output)
        paths.append(output.path / NETCDF)
        if not args.no_figures:
            from .page import write_page

            robot = solved.robot if solved is not None else None
            write_page(fit, output, robot, *more)
            paths.append(output.path / PAGE)
    except KeyboardInterrupt:
        print(f"derjax: interrupted; {again}", file=sys.stderr)
        return INTERRUPTED
    except (InputError, OSError):
        print(f"derjax: what was simulated is in {store}; {again}", file=sys.stderr)
        raise
    if not args.quiet:
        print("\n" + "\n".join(str(path) for path in paths))
    if fit.status == "interrupted":
        print(f"derjax: interrupted; {again}", file=sys.stderr)
        return INTERRUPTED
    if fit.status == "max_iterations":
        print(f"derjax: the fit has not converged; go on with: {_longer(args)}", file=sys.stderr)
        return UNFINISHED
    finish(output)
    return 0 if fit.status == "converged" else UNFINISHED


def _uncertain(
    args: argparse.Namespace, solved: Solved | None, fit: Fit
) -> tuple[list[Profile], Posterior | None]:
    """Profiles and posterior, if they are wanted, and printed."""
    if solved is None or fit.status == "interrupted":
        return [], None
    found, drawn = [], None
    if args.profile:
        found = profiles(solved)
        if not args.quiet:
            print("\nprofile likelihood, 95 %")
            for one in found:
                print(f"{one.name}: {one.ci95[0]:.6g} to {one.ci95[1]:.6g}")
    if args.posterior:
        try:
            drawn = posterior(solved)
        except SolverError as error:
            print(f"\nwarning: no posterior: {error}", file=sys.stderr)
            return found, None
        if not args.quiet:
            print(f"\nposterior, 95 % ({drawn.draws[..., 0].size} draws)")
            for name, (low, high) in drawn.ci95().items():
                print(f"{name}: {low:.6g} to {high:.6g}")
        if not drawn.ok:
            print(
                f"\nwarning: the posterior has not converged (R hat {drawn.r_hat.max():.3f}, "
                f"{drawn.divergences} divergences): do not use it",
                file=sys.stderr,
            )
    return found, drawn


def _calibrated(
    args: argparse.Namespace,
    dataset: Dataset,
    initial: dict[str, float],
    store: Path,
    printer: "_Printer",
) -> tuple[Fit, Solved | None]:
    """The fit, by tracks from rest alone, or by all that there is at once."""
    if dataset.is_plain and not (args.profile or args.posterior):
        fit = calibrate(
            dataset,
            args.parameters,
            initial,
            progress=printer,
            compare=not args.no_figures,
            max_iterations=args.max_iterations,
            store=store,
        )
        return fit, None
    return calibrate_jointly(
        dataset,
        args.parameters,
        initial,
        progress=printer,
        max_iterations=args.max_iterations,
        store=store,
    )


def _contents(dataset: Dataset) -> str:
    frames = sum(run.time.size for run in dataset.runs)
    words = [f"{len(dataset.runs)} runs, {frames} frames"] if dataset.runs else []
    rates = sum(rates.motor_rpm.size for rates in dataset.rates)
    return ", ".join([*words, *([f"speeds at {rates} rates"] if rates else [])])


def _command(args: argparse.Namespace) -> str:
    """The command line of these arguments, without those on existing results."""
    words = ["derjax", "fit", str(args.dataset), "-o", str(args.output)]
    words += ["--parameters", *args.parameters]
    words += ["--start", *args.start] * bool(args.start)
    words += ["--max-iterations", str(args.max_iterations)] * (args.max_iterations != 30)
    words += ["--profile"] * args.profile + ["--posterior"] * args.posterior
    words += ["--no-figures"] * args.no_figures + ["--quiet"] * args.quiet
    return shlex.join(words)


def _longer(args: argparse.Namespace) -> str:
    """The command line that resumes a fit with twice the iterations."""
    twice = {**vars(args), "max_iterations": 2 * args.max_iterations}
    return f"{_command(argparse.Namespace(**twice))} --resume"


def _check_output(args: argparse.Namespace, output: Output) -> None:
    """`InputError` if there are results and the options do not say what to do with them."""
    if args.resume or args.overwrite:
        return
    unfinished = output.path / EVALUATIONS
    if unfinished.exists():
        raise InputError(
            f"{unfinished}: here is an unfinished fit: --resume continues it, "
            "--overwrite starts anew"
        )
    for name in (REPORT, FIGURE, NETCDF, PAGE):
        if (output.path / name).exists():
            raise InputError(f"{output.path / name}: exists already; use --overwrite to replace it")


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
    simulated = f"{fit.previews} previews and {fit.simulations} whole simulations"
    print(f"\n{fit.status} after {simulated}, {fit.wall_time:.0f} s\n")
    print(table(fit))
    names = list(fit.estimates)
    if len(names) > 1:
        print("\ncorrelation " + " ".join(f"{name:>8}" for name in names))
        for name, row in zip(names, fit.correlation, strict=True):
            print(f"{name:<11} " + " ".join(f"{value:8.3f}" for value in row))
    if fit.nuisances:
        print("\nalso estimated")
        for name, e in fit.nuisances.items():
            unit = fit.units.get(name, "1")
            print(f"{name} = {e.value:.6g} +- {e.std:.2g}{'' if unit == '1' else f' {unit}'}")
    for kind, rho in fit.memory.items():
        print(f"correlation of the noise from frame to frame, {kind}: {rho:.3f}")
    print("\nresiduals (rms)")
    for rates in fit.rates:
        print(f"{rates.name}: {rms(rates.rms)}")
    for one in fit.runs:
        drift = "".join(f", drift along {a} {1e3 * v:.3g} mm/s" for a, v in one.drift.items())
        print(f"{one.run.name}: {rms(one.rms)}{drift}")
    if fit.goodness.good and (said := fit.goodness.sentence()):
        print(f"\n{said}")


class _Printer:
    """Prints a line for every iteration and, on a terminal, how far the current one is."""

    def __init__(self, quiet: bool) -> None:
        self.quiet, self.live = quiet, sys.stdout.isatty() and not quiet
        self.shown = 0.0
        self.lock = threading.Lock()

    def __call__(self, progress: Progress) -> None:
        if self.quiet:
            return
        with self.lock:
            if progress.latest is not None:
                self.clear()
                print(_line(progress), flush=True)
            elif progress.stage == "compile":
                for sentence in progress.said:
                    print(sentence)
                print("compiling ...", flush=True)
            elif self.live and time.monotonic() - self.shown > 0.2:
                self.shown = time.monotonic()
                text = f"{progress.stage}: {100 * progress.done:3.0f} %, {_left(progress)}"
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
        f"{progress.stage:>7} {progress.iteration:2d}: loss {latest.loss:<10.6g} {values} "
        f"rms {rms(latest.rms)}  {_left(progress)}{rejected}"
    )


def _left(progress: Progress) -> str:
    if math.isnan(progress.rate):
        return ""
    return f"{progress.rate:.0f} steps/s, about {max(0.0, progress.seconds_left):.0f} s left"
