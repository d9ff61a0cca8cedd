"""The results of a sweep: a table with a row for every point, and their trajectories."""

import csv
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import InputError
from ...io.output import Output
from ...results import dataset as trajectory
from .file import Sweep
from .points import ERROR, Outcome

RESULTS = "results.csv"
IDENTITY = "sweep.json"
FIGURE = "sweep.png"
TRAJECTORIES = "trajectories"

COSTS = ("time_s", "steps", "rejected_steps", "newton_iterations", "wall_time_s")
Row = dict[str, str]


class Book:
    """The table of results, and what else is written point by point.

    What cannot be written does not end the sweep: the table is tried again with the next points,
    and a point whose trajectory is lost counts as missing.

    Attributes:
        rows: by the numbers of the points, as they stand in the file.
        lost: how many points have come to nothing as their trajectories could not be written.
        problem: the last reason why something could not be written.
    """

    def __init__(self, output: Output | None, plan: Sweep, rows: dict[int, Row]) -> None:
        self._output, self._plan = output, plan
        self.rows, self.lost = rows, 0
        self.problem: Exception | None = None

    @property
    def writing(self) -> bool:
        """Whether this process is the one that writes."""
        return self._output is not None

    def open(self, identity: Mapping[str, Any], anew: bool) -> None:
        """Says what the results in the directory are of."""
        if self._output is None:
            return
        if anew:
            self._output.remove(RESULTS)
            self._output.remove(FIGURE)
            for path in (self._output.path / TRAJECTORIES).glob("point_*.nc"):
                path.unlink()
        self._output.include(TRAJECTORIES)
        with self._output.replacing(IDENTITY) as temporary:
            temporary.write_text(json.dumps(identity, indent=2) + "\n", encoding="utf-8")

    def add(self, outcomes: Sequence[Outcome]) -> None:
        """Enters points, and writes the table anew."""
        for outcome in outcomes:
            if not self._attempt(self._write_trajectory, outcome):
                self.lost += 1
                continue
            varied = self._plan.varied(outcome.number)
            cells = {"index": outcome.number, **varied, **outcome.row}
            self.rows[outcome.number] = {k: _text(v) for k, v in cells.items()}
        if outcomes:
            self._attempt(self._write_table, RESULTS)

    def close(self) -> None:
        """Writes the table once more if that failed; `InputError` if it fails again."""
        if self.problem is None or self._attempt(self._write_table, RESULTS):
            return
        problem = self.problem
        beside = f"{Path(RESULTS).stem}-{os.getpid()}{Path(RESULTS).suffix}"
        kept = self._attempt(self._write_table, beside)
        where = f"The table of this sweep is in {beside}" if kept else "The last points are lost"
        raise InputError(f"{problem}. {where}")

    def _attempt(self, write: Callable[[Any], None], what: Any) -> bool:
        """Writes something if this process does; whether that went well. Warns the first time."""
        if self._output is None:
            return True
        try:
            write(what)
        except (InputError, OSError) as error:
            if self.problem is None:
                print(f"derjax: warning: {error}; the sweep goes on", file=sys.stderr, flush=True)
            self.problem = error
            return False
        return True

    def _write_trajectory(self, outcome: Outcome) -> None:
        assert self._output is not None
        if outcome.trajectory is None:
            return
        (self._output.path / TRAJECTORIES).mkdir(exist_ok=True)
        name = f"{TRAJECTORIES}/point_{outcome.number:05d}.nc"
        with self._output.replacing(name) as temporary:
            trajectory.write(outcome.trajectory, temporary)

    def _write_table(self, name: str) -> None:
        assert self._output is not None
        rows = [self.rows[number] for number in sorted(self.rows)]
        first = ["index", *self._plan.names, "status", "message"]
        numbers = dict.fromkeys(name for row in rows for name in row)
        columns = [*first, *(n for n in numbers if n not in {*first, *COSTS}), *COSTS]
        with (
            self._output.replacing(name) as temporary,
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


def read_rows(path: Path) -> dict[int, Row]:
    """The rows of a table of results, but for those of points that are worth another try."""
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
        return {int(row["index"]): row for row in rows if row["status"] != ERROR}
    except FileNotFoundError:
        return {}  # stopped before the first point was done
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise InputError(f"{path}: not a table of results: {error!r}") from None
