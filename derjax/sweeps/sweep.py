"""A sweep as a unit: from a sweep file to a directory with a table and a figure."""

import csv
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

from .. import trajectory
from ..files import atomic_path
from ..progress import Progress, interruptible
from ..scenefile import InputError, SceneFile
from . import points
from .file import Sweep, load_sweep
from .points import ERROR, INVALID, Cancelled, Chunk, Outcome

RESULTS = "results.csv"
IDENTITY = "sweep.json"
FIGURE = "sweep.png"
TRAJECTORIES = "trajectories"

DONE, INTERRUPTED = 0, 130

ON_A_CPU, ELSEWHERE = 4, 128
"""Points of a chunk for every device. On a CPU few, as they are computed one after another."""

MOST_OF_A_WORKER = 8
"""Points of a chunk for a worker."""

COSTS = ("time_s", "steps", "rejected_steps", "newton_iterations", "wall_time_s")
Row = dict[str, str]


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
    of work; what has been finished is kept.

    Returns:
        The exit code: 0 if all points have a row, also those that failed; 130 interrupted.

    Raises:
        InputError: the sweep file is wrong, no point makes a scene, or there are results that must
            not be overwritten; nothing has been written.
    """
    plan = load_sweep(options.sweep)
    if options.with_dask:
        from . import farm

        farm.check_installed()
    writing = jax.process_index() == 0
    identity = _identity(plan)
    if writing:
        _check_output(options, identity)
    rows = _read(options.output / RESULTS) if writing and options.resume else {}
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
    book = _Book(options.output, plan, rows, writing)
    book.open(identity, options.overwrite)
    book.add([*invalid, *overlapping])
    interrupted = _compute(options, plan, chunks, book)
    if interrupted:
        if writing:
            print(
                f"derjax: interrupted: {len(book.rows)} of {len(plan.points)} points are done; "
                f"resume with: {options.command('--resume')}",
                file=sys.stderr,
            )
        return INTERRUPTED
    if not writing:
        return DONE
    if options.figures:
        from .figure import figure  # slow to import

        drawn = figure(plan, book.rows)
        if drawn is not None:
            with atomic_path(options.output / FIGURE) as temporary:
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
    if options.workers is not None:
        most, unit = min(MOST_OF_A_WORKER, -(-len(files) // (4 * options.workers))), 1
    elif options.scheduler is not None:
        most, unit = MOST_OF_A_WORKER, 1
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


def _compute(options: Options, plan: Sweep, chunks: Sequence[Chunk], book: "_Book") -> bool:
    """Computes chunks and enters their outcomes; returns whether the user stopped it."""
    total, first = len(plan.points), len(book.rows)
    quiet = options.quiet or not book.writing
    with (
        interruptible("stopping; Ctrl-C again quits at once") as stopping,
        Progress(total, "points", first, quiet) as progress,
    ):
        if options.with_dask:
            from . import farm

            with farm.client(options.workers, options.scheduler) as connected:
                for outcomes in farm.compute_all(connected, chunks, stopping):
                    book.add(outcomes)
                    progress.update(len(book.rows))
        else:
            for outcomes in _here(chunks, stopping, lambda d: progress.update(len(book.rows) + d)):
                book.add(outcomes)
                progress.update(len(book.rows))
        return len(book.rows) < total


def _here(
    chunks: Sequence[Chunk], stopping: Callable[[], bool], tell: Callable[[float], None]
) -> Iterator[list[Outcome]]:
    """The outcomes of chunks computed by this process, or by all that run the same program."""

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


class _Book:
    """The table of results, and what else is written point by point.

    Attributes:
        rows: by the numbers of the points, as they stand in the file.
        writing: whether this process is the one that writes.
    """

    def __init__(self, directory: Path, plan: Sweep, rows: dict[int, Row], writing: bool) -> None:
        self._directory, self._plan = directory, plan
        self.rows, self.writing = rows, writing

    def open(self, identity: Mapping[str, Any], anew: bool) -> None:
        """Makes the directory and says what the results in it are of."""
        if not self.writing:
            return
        self._directory.mkdir(parents=True, exist_ok=True)
        if anew:
            (self._directory / RESULTS).unlink(missing_ok=True)
            (self._directory / FIGURE).unlink(missing_ok=True)
            for path in (self._directory / TRAJECTORIES).glob("point_*.nc"):
                path.unlink()
        with atomic_path(self._directory / IDENTITY) as temporary:
            temporary.write_text(json.dumps(identity, indent=2) + "\n", encoding="utf-8")

    def add(self, outcomes: Sequence[Outcome]) -> None:
        """Enters points, and writes the table anew."""
        for outcome in outcomes:
            varied = self._plan.varied(outcome.number)
            cells = {"index": outcome.number, **varied, **outcome.row}
            self.rows[outcome.number] = {k: _text(v) for k, v in cells.items()}
            if outcome.trajectory is not None and self.writing:
                path = self._directory / TRAJECTORIES / f"point_{outcome.number:05d}.nc"
                path.parent.mkdir(exist_ok=True)
                trajectory.write(outcome.trajectory, path)
        if outcomes and self.writing:
            self._write()

    def _write(self) -> None:
        rows = [self.rows[number] for number in sorted(self.rows)]
        first = ["index", *self._plan.names, "status", "message"]
        numbers = dict.fromkeys(name for row in rows for name in row)
        columns = [*first, *(n for n in numbers if n not in {*first, *COSTS}), *COSTS]
        with (
            atomic_path(self._directory / RESULTS) as temporary,
            temporary.open("w", newline="", encoding="utf-8") as stream,
        ):
            writer = csv.DictWriter(stream, columns, restval="", lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def _text(value: Any) -> str:
    """A cell of the table."""
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return ""
    return json.dumps(value) if isinstance(value, list | bool) else str(value)


def _read(path: Path) -> dict[int, Row]:
    """The rows of a table of results, but for those of points that are worth another try."""
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
        return {int(row["index"]): row for row in rows if row["status"] != ERROR}
    except FileNotFoundError:
        return {}  # stopped before the first point was done
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise InputError(f"{path}: not a table of results: {error!r}") from None


def _identity(plan: Sweep) -> dict[str, Any]:
    """What two sweeps must have in common for one to continue the other, as JSON data."""
    tables = {}
    position = plan.keys.index("motor.table") if "motor.table" in plan.keys else None
    given = dict(plan.scene.get("motor", {})).get("table")
    names = [given] if position is None else [point[position] for point in plan.points]
    for name in names:
        path = plan.scene_path.parent / str(name)
        if name is not None and path.is_file():
            tables[str(name)] = path.read_text(encoding="utf-8")
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
    if directory.exists() and not directory.is_dir():
        raise InputError(f"{directory}: is not a directory (--output)")
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
