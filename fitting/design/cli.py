"""`derjax design`: find the dimensions of a robot that make it as good as can be."""

import argparse
import math
import shlex
import sys
import time
from importlib.metadata import version
from pathlib import Path

from derjax import InputError, SolverError
from derjax.commands.options import add_output, add_quiet
from derjax.io.output import Output, output_directory
from derjax.runs.progress import interruptible

from .file import DesignFile, load_design
from .ledger import LEDGER, Ledger
from .outcome import Design, on_a_finer_mesh, solved
from .problem import Designs, Point
from .report import REPORT, sentences, write
from .search import Attempt, Stop

HELP = "Design a robot by exact gradients: dimensions, or a programme of its motors."
DONE, UNFINISHED, INTERRUPTED = 0, 2, 130

SECONDS_BETWEEN_LINES = 0.5

COARSE = 0.02
"""Part of the objective that half the length of edges may change without a warning."""

FINER = (
    "the mesh is coarse: what is best may depend on it. Search again with a shorter [robot] "
    "edge_length"
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `derjax design`."""
    parser.add_argument(
        "design", type=Path, metavar="DESIGN.toml", help="what may change, and what is to be good"
    )
    add_output(parser, resume="continue the unfinished search in DIR")
    add_quiet(parser)


def run(args: argparse.Namespace) -> int:
    """Search, write the best design with figures and a film, and print it.

    Returns:
        0 if the search converged, 2 if it did not, 130 if it was interrupted. In all three cases
        design.json holds the best design met, if one keeps to all limits. Designs that have been
        looked at are kept until the search has ended, and `--resume` goes on from there.

    Raises:
        InputError: the design file, its scene or the arguments are wrong, or there are results
            that must not be overwritten.
        SolverError: no start can be simulated.
    """
    file = load_design(args.design)
    with output_directory(args.output) as output:
        _check_output(args, output)
        ledger = Ledger(output.path / LEDGER, {"version": version("derjax"), **file.content})
        known = ledger.read() if args.resume else []
        if not args.resume:
            ledger.begin()
        code = _run(args, file, output, ledger, known)
        if code != INTERRUPTED:
            ledger.path.unlink(missing_ok=True)
        return code


def _check_output(args: argparse.Namespace, output: Output) -> None:
    """`InputError` if there are results and the options do not say what to do with them."""
    if args.resume or args.overwrite:
        return
    for name in (REPORT, LEDGER):
        if (output.path / name).exists():
            how = "--resume goes on, " if name == LEDGER else ""
            raise InputError(f"{output.path / name}: exists already; {how}--overwrite starts anew")


def _run(
    args: argparse.Namespace, file: DesignFile, output: Output, ledger: Ledger, known: list[Point]
) -> int:
    printer = _Printer(file, args.quiet)
    again = f"derjax: interrupted; resume with: {_command(args)} --resume"
    with interruptible("stopping after this design; Ctrl-C again quits at once") as stopping:

        def looked_at(point: Point) -> None:
            ledger.add(point)
            printer.point(point)
            if stopping():
                raise Stop

        designs = Designs(file.problem, known, looked_at)
        try:
            design = solved(designs, file.search, printer.attempt)
        except (InputError, SolverError):
            ledger.path.unlink(missing_ok=True)  # it would end like this again
            raise
        except KeyboardInterrupt:
            print(f"{again} (no design was found yet)", file=sys.stderr)
            return INTERRUPTED
        printer.clear()
        finer = math.nan
        if design.status != "interrupted":
            finer = on_a_finer_mesh(design)
        paths = write(design, output, finer)
        if not args.no_figures and design.status != "interrupted":
            paths += _draw(file, designs, design, output, printer, stopping)
    if not args.quiet:
        print(f"\n{design.status} after {len(design.points)} designs, {printer.seconds:.0f} s\n")
        print("\n".join(sentences(design, finer)))
    coarse = abs(finer / design.objective - 1) > COARSE
    told = [*design.warnings, *([FINER] if coarse else [])]
    for warning in told:
        print(f"\nwarning: {warning}", file=sys.stderr)
    if not args.quiet:
        print("\n" + "\n".join(map(str, paths)))
    if design.status == "interrupted" or stopping():
        print(again, file=sys.stderr)
        return INTERRUPTED
    return DONE if design.status == "converged" else UNFINISHED


def _draw(
    file: DesignFile,
    designs: Designs,
    design: Design,
    output: Output,
    printer: "_Printer",
    stopping,
) -> list[Path]:
    """The figures and the film that a design has."""
    from . import figures  # slow to import
    from .landscape import landscape, landscape_figure

    drawn = {}
    if file.landscape > 1 and file.problem.variables.size <= MOST_DRAWN:
        printer.say("looking around the best design ...")
        try:
            around = landscape(designs, design.best, file.landscape)
        except Stop:
            return []
        with output.replacing("landscape.csv") as temporary:
            around.to_csv(temporary, index=False)
        drawn["landscape.png"] = landscape_figure(design, around)
    drawn["shapes.png"] = figures.shapes_figure(design)
    if design.sensitivities:
        drawn["tolerances.png"] = figures.tolerances_figure(design)
    if design.spread.size:
        drawn["spread.png"] = figures.spread_figure(design)
    if "rpm" in design.values and file.problem.scene.source.file.motor_table is not None:
        drawn["programme.png"] = figures.programme_figure(design)
    for name, figure in drawn.items():
        with output.replacing(name) as temporary:
            figure.savefig(temporary, format="png")
    paths = [output.path / name for name in drawn]
    if file.film and file.problem.through != "rest" and not stopping():
        printer.say("filming ...")
        with output.replacing(FILM) as temporary:
            figures.film(design).film(temporary)
        paths.append(output.path / FILM)
    return paths


FILM, MOST_DRAWN = "best.gif", 12


def _command(args: argparse.Namespace) -> str:
    """The command line of these arguments, without those on existing results."""
    words = ["derjax", "design", str(args.design), "-o", str(args.output)]
    words += ["--no-figures"] * args.no_figures + ["--quiet"] * args.quiet
    return shlex.join(words)


class _Printer:
    """Tells how the search goes: a line for every start and, on a terminal, for every design."""

    def __init__(self, file: DesignFile, quiet: bool) -> None:
        self.problem, self.search = file.problem, file.search
        self.quiet, self.live = quiet, sys.stdout.isatty() and not quiet
        self.began = self.shown = time.monotonic()
        self.count, self.attempts = 0, 0
        self.best: float | None = None
        self.say(f"{file.path}: compiling ...")

    @property
    def seconds(self) -> float:
        """s, since the start."""
        return time.monotonic() - self.began

    def say(self, text: str) -> None:
        self.clear()
        if not self.quiet:
            print(text, flush=True)

    def point(self, point: Point) -> None:
        """A design has been looked at."""
        self.count += 1
        now = time.monotonic()
        if self.live and now - self.shown > SECONDS_BETWEEN_LINES:
            self.shown = now
            pace = self.count / self.seconds
            value = f"{point.objective:.6g}" if point.ok else "failed"
            text = f"start {self.attempts + 1}, {pace:.2g} designs/s{self._left()}: {value}"
            print(f"\r{text:<76}", end="", flush=True)

    def _left(self) -> str:
        """How long the other starts will take, if they are like those that have ended."""
        if not self.attempts:
            return ""
        left = self.seconds / self.attempts * (self.search.starts - self.attempts)
        return f", about {left:.0f} s left"

    def attempt(self, number: int, attempt: Attempt) -> None:
        """A start has led to its end."""
        self.attempts = number + 1
        name = self.problem.objective.name
        if attempt.end is not None:
            said = f"{name} = {attempt.end.objective:.6g}"
        else:
            said = attempt.message if attempt.status == "failed" else "no design keeps all limits"
        self.say(
            f"start {number + 1} of {self.search.starts}: {attempt.status}, "
            f"{len(attempt.path)} designs, {said}{self._left()}"
        )

    def clear(self) -> None:
        """Wipe the line of the last design."""
        if self.live:
            print(f"\r{'':<76}\r", end="", flush=True)
