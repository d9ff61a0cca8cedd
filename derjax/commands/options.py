"""Options that several commands have in common."""

import argparse
from pathlib import Path


def add_output(parser: argparse.ArgumentParser, resume: str) -> None:
    """Where results go, and what is to be done with those that are there already.

    Args:
        parser: gets the options.
        resume: help for `--resume`.
    """
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="where the results go"
    )
    existing = parser.add_mutually_exclusive_group()
    existing.add_argument("--resume", action="store_true", help=resume)
    existing.add_argument(
        "--overwrite", action="store_true", help="replace the results that are in DIR"
    )


def add_quiet(parser: argparse.ArgumentParser) -> None:
    """What is to be left out."""
    parser.add_argument("--no-figures", action="store_true", help="draw no figures")
    parser.add_argument("--quiet", action="store_true", help="print errors only")
