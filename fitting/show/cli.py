"""`derjax tracks`: what is understood of the files that a tracking program wrote."""

import argparse
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg

from derjax import InputError
from derjax.commands.options import add_quiet
from derjax.io.output import Output, output_directory
from derjax.scenes.load import read_toml
from derjax.scenes.messages import check

from ..datasetfile import DatasetFile, RunFile
from .draft import draft
from .figure import figure
from .understood import Understood, table, understand

HELP = "show what is understood of tracks, and write a dataset file to start from"
DATASET = "dataset.toml"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `derjax tracks`."""
    parser.add_argument(
        "files",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="tables as trackers write them, or a dataset file that names some",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="DIR",
        help=f"where {DATASET} and a picture of each track go (default: nothing is written)",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="a key of [[runs]], as in a dataset file: fps=25, length_unit='mm', track_id=3",
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace the results that are in DIR"
    )
    add_quiet(parser)


def run(args: argparse.Namespace) -> int:
    """Read the tracks, print what was understood, and write it if that is asked for.

    Returns:
        0, also if something has to be said yet before the tracks can be fitted.

    Raises:
        InputError: a file cannot be read, or there are results that must not be overwritten.
    """
    keys = _keys(args.set)
    tracks = [understand(path, run) for path, run in _described(args.files, keys)]
    if not args.quiet:
        print("\n\n".join(map(table, tracks)))
    if args.output is not None:
        with output_directory(args.output) as output:
            paths = _write(tracks, output, args.overwrite, not args.no_figures)
        if not args.quiet:
            print("\n" + "\n".join(map(str, paths)))
    asked = sorted({key for one in tracks for key in one.asked})
    if asked and not args.quiet:
        print(f"derjax: to be said yet, in [[runs]]: {', '.join(asked)}", file=sys.stderr)
    return 0


def _keys(words: Sequence[str]) -> dict[str, Any]:
    """The keys of `--set`.

    Raises:
        InputError: one is no line of TOML.
    """
    keys: dict[str, Any] = {}
    for word in words:
        try:
            keys |= tomllib.loads(word)
        except tomllib.TOMLDecodeError:
            name, equals, value = word.partition("=")
            if not equals or not name.strip() or any(c in value for c in "\"'[]{}\n"):
                raise InputError(
                    f"--set {word}: should be KEY=VALUE as in a dataset file, like fps=25 or "
                    "length_unit='mm'"
                ) from None
            keys[name.strip()] = value.strip()  # a word without its quotation marks
    return keys


def _described(files: Sequence[Path], keys: dict[str, Any]) -> Iterator[tuple[Path, RunFile]]:
    """All tracks, each with its keys."""
    for path in files:
        if path.suffix == ".toml":
            for run in check(DatasetFile, read_toml(path), path).runs:
                yield (
                    path.parent / run.track,
                    _checked({**run.model_dump(exclude_unset=True), **keys}),
                )
        else:
            yield path, _checked({"track": str(path), **keys})


def _checked(keys: dict[str, Any]) -> RunFile:
    (run,) = check(DatasetFile, {"scene": "scene.toml", "runs": [keys]}, Path("--set")).runs
    return run


def _write(
    tracks: Sequence[Understood], output: Output, overwrite: bool, figures: bool
) -> list[Path]:
    """Write the dataset file and a picture of each track; returns their paths.

    Raises:
        InputError: one of them is there already.
    """
    pictures = {f"{one.path.name}.png": one for one in tracks} if figures else {}
    if not overwrite:
        for name in (DATASET, *pictures):
            if (output.path / name).exists():
                raise InputError(
                    f"{output.path / name}: exists already; use --overwrite to replace it"
                )
    for name, one in pictures.items():
        with output.replacing(name) as temporary:
            FigureCanvasAgg(figure(one)).print_figure(str(temporary), format="png", dpi=150)
    with output.replacing(DATASET) as temporary:
        temporary.write_text(draft(tracks, output.path, DATASET), encoding="utf-8")
    return [output.path / name for name in (DATASET, *pictures)]
