"""`derjax simulate`: from a scene file to a trajectory, a summary and figures."""

import argparse
from pathlib import Path

HELP = "simulate a scene file; writes trajectory, summary and figures"


def configure(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `derjax simulate`."""
    parser.add_argument("scene", type=Path, metavar="SCENE.toml", help="what to simulate")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="where the results go"
    )
    existing = parser.add_mutually_exclusive_group()
    existing.add_argument(
        "--resume", action="store_true", help="continue the unfinished run in DIR"
    )
    existing.add_argument(
        "--overwrite", action="store_true", help="replace the results that are in DIR"
    )
    parser.add_argument("--no-figures", action="store_true", help="draw no figures")
    parser.add_argument("--quiet", action="store_true", help="print errors only")


def run(args: argparse.Namespace) -> int:
    """Runs `derjax simulate`; see `derjax.simulation.simulate`."""
    from ..simulation import Options, simulate  # slow to import

    options = Options(
        scene=args.scene,
        output=args.output,
        resume=args.resume,
        overwrite=args.overwrite,
        figures=not args.no_figures,
        quiet=args.quiet,
    )
    return simulate(options)
