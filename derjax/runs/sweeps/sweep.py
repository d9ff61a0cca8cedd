"""A sweep as a unit: from a sweep file to a directory with a table and a figure."""

import dataclasses
import json
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ...core.errors import InputError
from ...io.output import Output, output_directory
from ...io.textfile import read_text
from ...scenes.file import SceneFile
from ..progress import Progress, interruptible
from ..turns import at_once, takes_turns
from . import points, threads
from .book import FIGURE, IDENTITY, RESULTS, Book, Row, read_rows
from .file import Sweep, load_sweep
from .points import INVALID, Cancelled, Chunk, Outcome

DONE, INTERRUPTED = 0, 130

ON_A_CPU, ELSEWHERE = 4, 128
"""Points of a chunk, at most, for every device. On a CPU few: they go one after another."""

MOST_OF_A_WORKER = 8
"""Points of a chunk for a worker."""

CHUNKS_OF_EACH = 4
"""For a processor or worker, at least, for all to be done at about the same time."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the user asked for.

    Attributes:
        sweep: sweep file.
        output: directory of the results.
        workers: Dask workers to start on this machine; None: compute here.
        scheduler: address of a Dask scheduler that runs already.
        resume: compute the points that are missing there.
        overwrite: replace what is there.
        figures: draw one.
        quiet: print errors only.
    """

    sweep: Path
    output: Path
    workers: int | None = None
    scheduler: str | None = None
    resume: bool = False
    overwrite: bool = False
    figures: bool = True
    quiet: bool = False

    @property
    def with_dask(self) -> bool:
        """Whether Dask does the work."""
        return self.workers is not None or self.scheduler is not None

    def command(self, *extra: str) -> str:
        """The command line of these options, without those on existing results."""
        words = ["derjax", "sweep", str(self.sweep), "-o", str(self.output), *extra]
        words += ["--workers", str(self.workers)] * (self.workers is not None)
        words += ["--scheduler", str(self.scheduler)] * (self.scheduler is not None)
        words += ["--no-figures"] * (not self.figures) + ["--quiet"] * self.quiet
        return shlex.join(words)


def sweep(options: Options) -> int:
    """Computes the points of a sweep file and writes a table and a figure.

    The table is written anew after every chunk of points. Ctrl-C stops after the current piece
    of work; what has been finished is kept. If the disk is full, the sweep goes on, and tries
    again after the next chunk.

    Returns:
        The exit code: 0 if all points have a row, also those that failed; 130 interrupted.

    Raises:
        InputError: the sweep file is wrong, no point makes a scene, the directory cannot be
            written to, another program writes there, or there are results that must not be
            overwritten; nothing has been written. Or results could not be written at the end.
    """
    plan = load_sweep(options.sweep)
    if options.with_dask:
        from . import dask as farm

        farm.check_installed()
    if jax.process_index() > 0:
        return _sweep(options, plan, None)
    with output_directory(options.output) as output:
        return _sweep(options, plan, output)


def _sweep(options: Options, plan: Sweep, output: Output | None) -> int:
    """`sweep` of a plan. `output`: None in processes that help another one, which writes."""
    writing = output is not None
    identity = _identity(plan)
    if writing:
        _check_output(options, identity)
    rows = read_rows(options.output / RESULTS) if writing and options.resume else {}
    missing = _agreed([k for k in range(len(plan.points)) if k not in rows], len(plan.points))
    if not writing:
        rows = {k: {} for k in set(range(len(plan.points))).difference(missing)}
    if options.resume and not missing:
        raise InputError(f"{options.output}: this sweep has ended: there is nothing to resume")
    files, invalid = _files(plan, missing)
    if invalid and not files and not rows:
        raise InputError(str(invalid[0].row["message"]))
    groups, overlapping = points.programs(files)
    chunks = _chunks(options, plan, files, groups)
    book = Book(output, plan, rows)
    book.open(identity, options.overwrite)
    book.add([*invalid, *overlapping])
    interrupted = _compute(options, plan, chunks, book)
    if interrupted:
        book.close()
        if writing:
            print(
                f"derjax: interrupted: {len(book.rows)} of {len(plan.points)} points are done; "
                f"resume with: {options.command('--resume')}",
                file=sys.stderr,
            )
        return INTERRUPTED
    book.close()
    if output is None:
        return DONE
    if book.lost:
        raise InputError(
            f"{book.problem}. {book.lost} points are not kept; make room and compute them "
            f"with: {options.command('--resume')}"
        )
    if options.figures:
        from .figure import figure  # slow to import

        drawn = figure(plan, book.rows)
        if drawn is not None:
            with output.replacing(FIGURE) as temporary:
                drawn.savefig(temporary)
    if not options.quiet:
        print(_digest(plan, book.rows, options.output))
    return DONE


def _files(plan: Sweep, numbers: Sequence[int]) -> tuple[dict[int, SceneFile], list[Outcome]]:
    """The scenes of points, and those points whose values do not make one."""
    files, invalid = {}, []
    for number in numbers:
        try:
            files[number] = plan.file(number)
        except InputError as error:
            invalid.append(points.failed(number, INVALID, str(error)))
    return files, invalid


def _chunks(
    options: Options,
    plan: Sweep,
    files: Mapping[int, SceneFile],
    groups: Sequence[Sequence[int]],
) -> list[Chunk]:
    """The points of each program, in chunks of about the same size."""
    unit = 1
    if options.workers is not None:
        most = min(MOST_OF_A_WORKER, -(-len(files) // (CHUNKS_OF_EACH * options.workers)))
    elif options.scheduler is not None:
        most = MOST_OF_A_WORKER
    elif takes_turns():
        most = min(ON_A_CPU, -(-len(files) // (CHUNKS_OF_EACH * at_once())))
    else:
        unit = len(jax.devices())
        most = unit * (ON_A_CPU if jax.default_backend() == "cpu" else ELSEWHERE)
    chunks = []
    for group in groups:
        count = -(-len(group) // max(most, 1))
        places = unit * -(-len(group) // (count * unit))
        for start in range(0, len(group), places):
            part = {k: files[k] for k in group[start : start + places]}
            chunks.append(Chunk(part, places, plan.trajectories))
    return chunks


def _compute(options: Options, plan: Sweep, chunks: Sequence[Chunk], book: Book) -> bool:
    """Computes chunks and enters their outcomes; returns whether the user stopped it."""
    total, first = len(plan.points), len(book.rows)
    quiet = options.quiet or not book.writing
    with (
        interruptible("stopping; Ctrl-C again quits at once") as stopping,
        Progress(total, "points", first, quiet) as progress,
    ):
        if options.with_dask:
            from . import dask as farm

            with farm.client(options.workers, options.scheduler) as connected:
                for outcomes in farm.compute_all(connected, chunks, stopping):
                    book.add(outcomes)
                    progress.update(len(book.rows))
        else:

            def tell(done: float) -> None:
                progress.update(len(book.rows) + done)

            found = (
                threads.compute_all(chunks, at_once(), stopping, tell)
                if takes_turns()
                else _together(chunks, stopping, tell)
            )
            for outcomes in found:
                book.add(outcomes)
                progress.update(len(book.rows))
        return len(book.rows) + book.lost < total


def _together(
    chunks: Sequence[Chunk], stopping: Callable[[], bool], tell: Callable[[float], None]
) -> Iterator[list[Outcome]]:
    """The outcomes of chunks, each on all devices of all processes that run the same program."""

    def on_progress(done: float) -> None:
        tell(done)
        if _anyone(stopping()):
            raise Cancelled

    try:
        for chunk in chunks:
            yield points.compute_surely(chunk, on_progress)
    except Cancelled:
        return


def _agreed(missing: list[int], count: int) -> list[int]:
    """The missing ones of `count` points, as the process sees them that writes.

    With several processes none goes on before that one has looked at what there is.
    """
    if jax.process_count() == 1:
        return missing
    from jax.experimental import multihost_utils

    mask = np.isin(np.arange(count), missing)
    return np.flatnonzero(multihost_utils.broadcast_one_to_all(mask)).tolist()


def _anyone(flag: bool) -> bool:
    """Whether it is so in one of the processes that run the same program."""
    if jax.process_count() == 1:
        return flag
    from jax.experimental import multihost_utils

    return bool(multihost_utils.process_allgather(np.array(flag)).any())


def _identity(plan: Sweep) -> dict[str, Any]:
    """What two sweeps must have in common for one to continue the other, as JSON data."""
    tables = {}
    position = plan.keys.index("motor.table") if "motor.table" in plan.keys else None
    given = dict(plan.scene.get("motor", {})).get("table")
    names = [given] if position is None else [point[position] for point in plan.points]
    for name in names:
        path = plan.scene_path.parent / str(name)
        if name is not None and path.is_file():
            tables[str(name)] = read_text(path)
    content = {
        "derjax version": version("derjax"),
        "vary": dict(zip(plan.keys, zip(*plan.points, strict=True), strict=True)),
        "mode": plan.mode,
        "trajectories": plan.trajectories,
        "scene": plan.scene,
        "motor tables": tables,
    }
    return json.loads(json.dumps(content))


def _check_output(options: Options, identity: Mapping[str, Any]) -> None:
    """`InputError` if there are results and the options do not say what to do with them."""
    directory, path = options.output, options.output / IDENTITY
    if not options.resume:
        for existing in (path, directory / RESULTS, directory / FIGURE):
            if existing.exists() and not options.overwrite:
                hint = "--resume computes what is missing, --overwrite starts anew"
                raise InputError(f"{existing}: exists already: {hint}")
        return
    try:
        old = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file: there is no sweep to resume") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    if changes := _changes(old, identity):
        raise InputError(
            f"{path}: these results are of another sweep: {'; '.join(changes)}. "
            "Only the same sweep can be resumed; --overwrite starts anew"
        )


def _changes(old: Any, new: Mapping[str, Any], where: str = "") -> list[str]:
    """Which values differ, in words."""
    if not isinstance(old, Mapping):
        return ["it is not known of which"]
    changes = []
    for key in dict.fromkeys([*old, *new]):
        one, other, here = old.get(key), new.get(key), f"{where} {key}".strip()
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            changes += _changes(one, other, here)
        elif one != other:
            said = f"{here} was {one}, is {other}"
            changes.append(said if len(said) < 100 else f"{here} differs")
    return changes


def _digest(plan: Sweep, rows: Mapping[int, Row], directory: Path) -> str:
    """What a user wants to see at the end of a sweep."""
    good = [row for row in rows.values() if row["status"] == "ok"]
    lines = [f"{len(rows)} points, {len(rows) - len(good)} of them failed"]
    for row in sorted(
        (row for row in rows.values() if row["status"] != "ok"), key=lambda r: int(r["index"])
    )[:3]:
        lines.append(f"point {row['index']} ({_values(plan, row)}): {row['message']}")
    speeds = {float(row["v_x_m_per_s"]): row for row in good if row.get("v_x_m_per_s")}
    if speeds:
        best = max(speeds, key=abs)
        lines.append(
            f"speed {1e3 * min(speeds):.4g} to {1e3 * max(speeds):.4g} mm/s along x, "
            f"fastest at {_values(plan, speeds[best])}"
        )
    return "\n".join([*lines, f"results in {directory}"])


def _values(plan: Sweep, row: Row) -> str:
    return ", ".join(f"{name} = {row[name]}" for name in plan.names)
