"""`derjax simulate`: from a scene file to a trajectory, a summary and figures."""

import argparse
from pathlib import Path

from .options import add_output, add_quiet

HELP = "simulate a scene file; writes trajectory, summary and figures"


def configure(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `derjax simulate`."""
    parser.add_argument("scene", type=Path, metavar="SCENE.toml", help="what to simulate")
    add_output(parser, resume="continue the unfinished run in DIR")
    add_quiet(parser)
    parser.add_argument(
        "--nondimensional",
        action="store_true",
        help="add the numbers without units to the summary: omega_bar and so on",
    )


def run(args: argparse.Namespace) -> int:
    """Runs `derjax simulate`; see `derjax.runs.simulation.simulate`."""
    from ..runs.simulation import Options, simulate  # slow to import

    options = Options(
        scene=args.scene,
        output=args.output,
        resume=args.resume,
        overwrite=args.overwrite,
        figures=not args.no_figures,
        quiet=args.quiet,
        nondimensional=args.nondimensional,
    )
    return simulate(options)
