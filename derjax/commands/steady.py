"""`derjax steady`: steady swimming over a parameter, without waiting for it."""

import argparse
from pathlib import Path

from .options import add_output, add_quiet

HELP = "solve for steady swimming over a parameter; writes a table, shapes and figures"


def configure(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `derjax steady`."""
    parser.add_argument("scene", type=Path, metavar="SCENE.toml", help="what swims")
    add_output(parser, resume="compute the values that are missing in DIR")
    parser.add_argument(
        "--vary",
        metavar="NAME=FIRST:LAST:STEP",
        help="a parameter and its values, as rpm=10:300:30 or pitch=0.03,0.04; left out: the scene "
        "as it is",
    )
    parser.add_argument(
        "--stability", action="store_true", help="find growth rates, modes and thresholds as well"
    )
    add_quiet(parser)


def run(args: argparse.Namespace) -> int:
    """Runs `derjax steady`; see `derjax.runs.steady_curve.steady_curve`."""
    from ..runs.steady_curve import Options, steady_curve  # slow to import

    return steady_curve(
        Options(
            scene=args.scene,
            output=args.output,
            vary=args.vary,
            stability=args.stability,
            resume=args.resume,
            overwrite=args.overwrite,
            figures=not args.no_figures,
            quiet=args.quiet,
        )
    )
