"""`derjax new`: example files to start from."""

import argparse
from importlib import resources
from pathlib import Path

from ..core.errors import InputError
from ..io.output import output_directory
from ..scenes import extensions

HELP = "write a commented example scene, motor table and dataset"

FILES = (
    "scene.toml",
    "two_flagella.toml",
    "sweep.toml",
    "design.toml",
    "motor.csv",
    "dataset.toml",
    "track.csv",
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `derjax new`."""
    parser.add_argument(
        "directory",
        type=Path,
        nargs="?",
        default=Path("."),
        metavar="DIR",
        help="where to write them (default: the current directory)",
    )


def run(args: argparse.Namespace) -> int:
    """Runs `derjax new`.

    Raises:
        InputError: one of the files is there already, or files cannot be written there; nothing
            has been written.
        OSError: the disk is full; the message names the file.
    """
    directory: Path = args.directory
    if existing := [str(directory / name) for name in FILES if (directory / name).exists()]:
        raise InputError(f"{', '.join(existing)}: exists already; nothing is overwritten")
    with output_directory(directory, exclusive=False) as output:
        for name in FILES:
            with output.replacing(name) as temporary:
                temporary.write_text(template(name), encoding="utf-8")
    print(f"wrote {', '.join(str(directory / name) for name in FILES)}")
    print(f"next: derjax simulate {directory / 'scene.toml'} -o {directory / 'out'}")
    return 0


def template(name: str) -> str:
    """The text of one of `FILES`."""
    path = resources.files("derjax") / "scenes" / "templates" / name
    text = path.read_text(encoding="utf-8")
    return text + extensions.template() if name == "scene.toml" else text
