"""`derjax new`: example files to start from."""

import argparse
from importlib import resources
from pathlib import Path

from ..files import atomic_path
from ..scenefile import InputError

HELP = "write a commented example scene, motor table and dataset"

FILES = (
    "scene.toml",
    "two_flagella.toml",
    "sweep.toml",
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
        InputError: one of the files is there already; nothing has been written.
    """
    directory: Path = args.directory
    if directory.exists() and not directory.is_dir():
        raise InputError(f"{directory}: is not a directory")
    if existing := [str(directory / name) for name in FILES if (directory / name).exists()]:
        raise InputError(f"{', '.join(existing)}: exists already; nothing is overwritten")
    directory.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        with atomic_path(directory / name) as temporary:
            temporary.write_text(template(name), encoding="utf-8")
    print(f"wrote {', '.join(str(directory / name) for name in FILES)}")
    print(f"next: derjax simulate {directory / 'scene.toml'} -o {directory / 'out'}")
    return 0


def template(name: str) -> str:
    """The text of one of `FILES`."""
    return (resources.files("derjax") / "templates" / name).read_text(encoding="utf-8")
