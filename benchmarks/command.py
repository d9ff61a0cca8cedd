"""What the commands of all benchmarks begin with."""

import argparse
from pathlib import Path

from derjax.core.runtime import enable_compilation_cache


def command_line(says: str | None, cache: bool = True) -> argparse.ArgumentParser:
    """Reads the options of a benchmark, of which all have `-o`: a directory, which it makes.

    Args:
        says: the docstring of the benchmark, whose first line is its description.
        cache: whether compiled programs are kept on disk: not where compiling is timed.
    """
    if cache:
        enable_compilation_cache()
    parser = argparse.ArgumentParser(description=(says or "").partition("\n")[0])
    parser.add_argument("-o", "--output", type=_directory, default="docs/figures")
    return parser


def _directory(path: str) -> Path:
    """A directory that is there."""
    Path(path).mkdir(parents=True, exist_ok=True)
    return Path(path)
