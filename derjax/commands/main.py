"""The command `derjax`.

Each subcommand is a module, found through the entry points of the group `derjax.commands` and
imported when it is needed. Such a module has

    HELP: str                    one line for `derjax --help`
    configure(parser) -> None    adds its arguments to an `argparse.ArgumentParser`
    run(args) -> int             does the work; returns the exit code

Exit codes: 0 done, 2 wrong input or a run that could not be completed, 130 interrupted, by Ctrl-C
or by SIGTERM.
"""

import argparse
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib.metadata import EntryPoint, entry_points, version
from typing import Any

from ..core.errors import InputError, InputWarning, WriteWarning
from ..core.runtime import collect_garbage_rarely, use_this_process
from ..core.status import SolverError
from ..runs.progress import terminated_like_interrupted

GROUP = "derjax.commands"
FAILED = 2
INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run `derjax` with the arguments `argv` (default: those of the process).

    Returns:
        The exit code. What a user can put right is told in one message on stderr.

    Raises:
        SystemExit: after `--help` and `--version`, and when the arguments are wrong.
    """
    collect_garbage_rarely()
    argv = sys.argv[1:] if argv is None else list(argv)
    commands = {point.name: point for point in entry_points(group=GROUP)}
    try:
        args = _parser(commands, argv).parse_args(argv)
        use_this_process()
        with terminated_like_interrupted(), warnings.catch_warnings():
            for category in (InputWarning, WriteWarning):
                warnings.simplefilter("always", category)
            warnings.showwarning = _shown_once(warnings.showwarning)
            return args.run(args)
    except (InputError, SolverError, OSError) as error:
        print(f"derjax: error: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("derjax: interrupted", file=sys.stderr)
        return INTERRUPTED


def _shown_once(otherwise: Callable[..., None]) -> Callable[..., None]:
    """What shows warnings: those about input and files as messages on stderr, each once."""
    shown: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if not issubclass(category, (InputWarning, WriteWarning)):
            otherwise(message, category, *place, **more)
        elif str(message) not in shown:
            shown.add(str(message))
            print(f"derjax: warning: {message}", file=sys.stderr)

    return show


def _parser(commands: dict[str, EntryPoint], argv: Sequence[str]) -> argparse.ArgumentParser:
    """The parser for `argv`: complete for the command that it names, or for `--help`."""
    parser = argparse.ArgumentParser(
        prog="derjax",
        description="Simulate soft flagellated robots in viscous fluid, exactly differentiably.",
        epilog="'derjax COMMAND --help' explains a command.",
    )
    parser.add_argument("--version", action="version", version=f"derjax {version('derjax')}")
    children = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    chosen = next((word for word in argv if word in commands), None)
    for name in sorted(commands):
        if chosen not in (None, name):
            children.add_parser(name)
            continue
        try:
            module = commands[name].load()
        except ImportError as error:
            if name == chosen:
                raise InputError(f"the command {name!r} cannot be loaded: {error}") from error
            children.add_parser(name, help=f"not available: {error}")
            continue
        child = children.add_parser(name, help=module.HELP, description=module.HELP)
        module.configure(child)
        child.set_defaults(run=module.run)
    return parser
