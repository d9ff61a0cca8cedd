"""What a search has looked at, kept for one that is interrupted and started again.

The search is a function of what it is told of each design. So one that begins anew and is told the
same by a file comes to where the first one was, and goes on from there.
"""

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from derjax import InputError
from derjax.core.errors import WriteWarning

from .problem import Point

LEDGER = "evaluations.jsonl"
"""One line for each design, after one that says of which problem they are."""

ARRAYS = ("x", "gradient", "limits", "slopes")


class Ledger:
    """The file of all designs that a search has looked at.

    Args:
        path: of the file.
        identity: of the problem, as JSON data.
    """

    def __init__(self, path: Path, identity: Any) -> None:
        self.path, self.identity = path, json.loads(json.dumps(identity))
        self.broken = False

    def begin(self) -> None:
        """An empty file."""
        self.path.write_text(json.dumps(self.identity) + "\n", encoding="utf-8")

    def read(self) -> list[Point]:
        """The designs that are there. A last line that was cut off is left out.

        Raises:
            InputError: there is no such file, or it is of another problem.
        """
        try:
            first, *rest = self.path.read_text(encoding="utf-8").split("\n")
            if json.loads(first) != self.identity:
                raise InputError(
                    f"{self.path}: these designs are of another problem, scene, or version of "
                    "derjax. Only the same search can be resumed; --overwrite starts anew"
                )
        except FileNotFoundError:
            raise InputError(f"{self.path}: there is no unfinished search to resume") from None
        except (OSError, ValueError) as error:
            raise InputError(f"{self.path}: cannot be read: {error}") from None
        whole = [line for line in rest[:-1] if line]
        self.path.write_text("\n".join([first, *whole]) + "\n", encoding="utf-8")
        return [_point(json.loads(line)) for line in whole]

    def add(self, point: Point) -> None:
        """Keep one more."""
        if self.broken:
            return
        content = {name: getattr(point, name).tolist() for name in ARRAYS}
        content |= {"objective": point.objective, "values": point.values, "failure": point.failure}
        try:
            with self.path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(content) + "\n")
        except OSError as error:
            self.broken = True
            told = f"{self.path}: {error.strerror}; the search goes on, but could not be resumed"
            warnings.warn(told, WriteWarning, stacklevel=2)


def _point(content: dict[str, Any]) -> Point:
    n = len(content["x"])
    arrays = {name: np.array(content[name], float) for name in ARRAYS}
    arrays["slopes"] = arrays["slopes"].reshape(-1, n)
    return Point(
        **arrays,
        objective=content["objective"],
        values=content["values"],
        failure=content["failure"],
    )
