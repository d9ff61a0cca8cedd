"""`derjax sweep`: a scene at many values of its keys."""

import argparse
from pathlib import Path

from ..core.errors import InputError
from .options import add_output, add_quiet

HELP = "simulate a scene at many values of its keys; writes a table and a figure"


def configure(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `derjax sweep`."""
    parser.add_argument("sweep", type=Path, metavar="SWEEP.toml", help="what to vary, and how")
    add_output(parser, resume="compute the points that are missing in DIR")
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=int, metavar="N", help="let N processes on this machine do it, by Dask"
    )
    where.add_argument(
        "--scheduler", metavar="ADDRESS", help="let the workers of a Dask scheduler do it"
    )
    where.add_argument(
        "--distributed",
        nargs="*",
        metavar="WORD",
        help="run as one program on several machines, on each of which this command is given: "
        "without words where a cluster's queue says who they are (Slurm, MPI), else with the "
        "ADDRESS:PORT of the first, the number of processes, and which of them this is, from 0",
    )
    add_quiet(parser)


def run(args: argparse.Namespace) -> int:
    """Runs `derjax sweep`; see `derjax.runs.sweeps.sweep.sweep`.

    Raises:
        InputError: an option cannot be right; nothing has been written.
    """
    if args.workers is not None and args.workers < 1:
        raise InputError(f"--workers {args.workers}: must be at least 1")
    from ..runs.batch import use_all_processors
    from ..runs.sweeps.sweep import Options, sweep  # slow to import

    if args.distributed is not None:
        use_all_processors()
        _join(args.distributed)
    options = Options(
        sweep=args.sweep,
        output=args.output,
        workers=args.workers,
        scheduler=args.scheduler,
        resume=args.resume,
        overwrite=args.overwrite,
        figures=not args.no_figures,
        quiet=args.quiet,
    )
    return sweep(options)


def _join(words: list[str]) -> None:
    """Makes this process one of several that run the same program."""
    import jax

    if len(words) not in (0, 3) or not all(word.isdecimal() for word in words[1:]):
        raise InputError(
            f"--distributed {' '.join(words)}: no words, or ADDRESS:PORT, the number of processes "
            "and which of them this is, as in --distributed node0:1234 2 0"
        )
    try:
        if words:
            jax.distributed.initialize(words[0], int(words[1]), int(words[2]))
        else:
            jax.distributed.initialize()
    except (ValueError, RuntimeError) as error:
        raise InputError(f"--distributed {' '.join(words)}: {error}") from None
