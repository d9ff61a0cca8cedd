"""How long commands take until their first step, and as whole processes.

    python -m benchmarks.start [-o docs/figures] [--before CHECKOUT] [--quick [COMMAND ...]]

`derjax --help`, `derjax simulate` of the scenes of `derjax new` with one and two flagella, and the
README's `derjax fit`, each in a process of its own: cold, with an empty directory of programs, and
warm, with what the cold one has left there. Times are from the start of the process: to the moment
at which the program of a step is about to run, and to the end; on the wall, and of all processors.
To the first step the quickest of three counts, as other work on the machine only ever adds. With
`--before` the same commands of another checkout of derjax are measured in turn with this one.
`--quick` leaves out what comes after the first step, of all commands or of those that have one of
the words in their names. Writes start.csv and start.md.
"""

import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pandas as pd

from .command import command_line
from .tables import write

ROOT = Path(__file__).parents[1]
ROUNDS = 3

WATCHED = """
import os, sys, time

def first(function):
    def called(*arguments, **options):
        answer = function(*arguments, **options)
        if function.__name__ == "record" or not os.path.exists(os.environ["NOTE"]):
            with open(os.environ["NOTE"], "w") as note:
                note.write(f"{time.time()} {time.process_time()}")
            if os.environ["STOP"]:
                os._exit(0)
        return answer
    called.__name__ = function.__name__
    return called

if sys.argv[1] == "simulate":
    import derjax.runs.simulation as module
    module.record = first(module.record)
elif sys.argv[1] == "fit":
    import fitting.cli
    module = sys.modules["fitting.simulate"]
    module._continue = first(module._continue)
from derjax.commands.main import main
sys.exit(main())
"""
"""Runs a command and notes when its first step begins; of a fit, when it has been started."""

FORMATS = {
    "command": "",
    "programs": "",
    "derjax": "",
    "first step, wall (s)": ".2f",
    "first step, processors (s)": ".2f",
    "whole, wall (s)": ".1f",
    "whole, processors (s)": ".1f",
}


def commands(directory: Path) -> dict[str, list[str]]:
    """What is measured: words after `derjax`, by what they are called."""
    fit = ["fit", str(ROOT / "data" / "camera" / "dataset.toml")]
    return {
        "--help": ["--help"],
        "simulate, one flagellum": ["simulate", str(directory / "scene.toml")],
        "simulate, two flagella": ["simulate", str(directory / "two_flagella.toml")],
        "fit, of the README": fit,
    }


def measured(words: list[str], source: Path, directory: Path, stop: bool) -> dict[str, float]:
    """One process.

    Args:
        words: of the command.
        source: checkout of derjax that is run.
        directory: of its results, and of the programs that it keeps.
        stop: at the first step.
    """
    note = directory / "note"
    note.unlink(missing_ok=True)
    if words[0] != "--help":
        words = [*words, "-o", str(directory / "out"), "--overwrite"]
    environment = os.environ | {
        "PYTHONPATH": str(source),
        "JAX_COMPILATION_CACHE_DIR": str(directory / "programs"),
        "NOTE": str(note),
        "STOP": "yes" if stop else "",
    }
    before, began = os.times(), time.time()
    command = [sys.executable, "-c", WATCHED, *words]
    subprocess.run(command, env=environment, cwd=directory, check=True, capture_output=True)
    after, ended = os.times(), time.time()
    found = {}
    if note.exists():
        at, used = map(float, note.read_text().split())
        found = {"first step, wall (s)": at - began, "first step, processors (s)": used}
    if not stop:
        processors = sum(after[2:4]) - sum(before[2:4])
        found |= {"whole, wall (s)": ended - began, "whole, processors (s)": processors}
    return found


def rows(
    sources: Mapping[str, Path], directory: Path, quick: Sequence[str]
) -> list[dict[str, Any]]:
    """A row for each command, cold and warm, of each checkout."""
    found = []
    begin_only = {n for n in commands(directory) if any(word in n for word in quick)}
    for name, words in commands(directory).items():
        for programs in ("cold", "warm"):
            for label, source in sources.items():
                place = directory / f"{name} {label}".replace(" ", "_").replace(",", "")
                place.mkdir(exist_ok=True)
                step = name != "--help"
                row = measured(words, source, place, step and name in begin_only)
                repeated = [row] if programs == "cold" else []
                if programs == "warm":
                    repeated = [
                        row,
                        *(measured(words, source, place, step) for _ in range(ROUNDS - 1)),
                    ]
                best = {key: min(each[key] for each in repeated if key in each) for key in row}
                found.append({"command": name, "programs": programs, "derjax": label, **best})
                print(found[-1], flush=True)
    return found


def main() -> None:
    parser = command_line(__doc__, cache=False)
    parser.add_argument("--before", type=Path, help="another checkout of derjax, to compare with")
    parser.add_argument(
        "--quick", nargs="*", metavar="WORD", help="end commands with these in their names early"
    )
    args = parser.parse_args()
    sources = {"this": ROOT}
    if args.before is not None:
        sources = {"before": args.before.resolve(), **sources}
    with TemporaryDirectory() as directory:
        new = [sys.executable, "-m", "derjax", "new", directory]
        subprocess.run(new, check=True, capture_output=True, cwd=ROOT)
        table = pd.DataFrame(
            rows(sources, Path(directory), [""] if args.quick == [] else args.quick or [])
        )
    table = table.reindex(columns=list(FORMATS))
    note = (
        "Whole processes, from their start, on this machine: `python -m benchmarks.start`. Cold: "
        "nothing is kept of earlier processes; warm: programs are, as they were traced and "
        "compiled. Where the machine has other work to do, the times of processors are those to "
        "compare."
    )
    write(table, args.output / "start.csv", FORMATS, note)


if __name__ == "__main__":
    main()
