"""The points of a sweep: which of them share a program, and what comes out of them."""

import threading
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

import jax
import numpy as np
import xarray as xr

from ...core.errors import InputError
from ...core.pytree import Indices, replace
from ...core.status import Status
from ...integrate.frames import RolloutStats
from ...integrate.step import Scene
from ...results import dataset as trajectory
from ...results import summary as summaries
from ...rods.rod import State
from ...scenes.build import build, build_unchecked
from ...scenes.file import SceneFile
from ...scenes.ingredients import (
    ContactTable,
    FluidTable,
    HeadTable,
    MaterialTable,
    MotorTable,
    TimeTable,
)
from ...scenes.parameters import place_of
from ...scenes.shape import touching_pairs
from ..batch import build_many, pick
from ..turns import takes_turns
from . import marching

T = TypeVar("T")

ERROR = "error"
"""Status of a point whose computation broke down for a reason of its own, as without memory."""

INVALID = "invalid"
"""Status of a point whose values do not make a scene."""

_preparing = threading.Lock()
"""What one thread has compiled for its points, others need not."""

_examples: dict[Hashable, SceneFile] = {}
"""A file of each form."""


@dataclass(frozen=True)
class Chunk:
    """Points that are computed in one go.

    Attributes:
        files: the scenes of the points, by their numbers.
        slots: of the batch that they are computed in, at least.
        trajectories: whether to keep them.
    """

    files: Mapping[int, SceneFile]
    slots: int
    trajectories: bool = False


@dataclass(frozen=True)
class Outcome:
    """What came out of a point.

    Attributes:
        number: of the point.
        row: status, message, the numbers of `summary.summarise` and what they have cost.
        trajectory: if it is to be kept.
    """

    number: int
    row: Mapping[str, Any]
    trajectory: xr.Dataset | None = None


class Cancelled(Exception):
    """The computation was asked to stop."""


def failed(number: int, status: str, message: str) -> Outcome:
    """The outcome of a point that could not be computed at all."""
    return Outcome(number, {"status": status, "message": message})


def programs(files: Mapping[int, SceneFile]) -> tuple[list[list[int]], list[Outcome]]:
    """The numbers of the points by the compiled program that they share, and those without one.

    Raises:
        InputError: by no means; a robot that overlaps itself is a point without a program.
    """
    found: dict[Hashable, Any] = {}
    groups: dict[Any, list[int]] = {}
    invalid = []
    for number, file in files.items():
        try:
            form = _form(file)
        except InputError as error:
            invalid.append(failed(number, INVALID, str(error)))
            continue
        if form not in found:
            found[form] = _program(file)
        groups.setdefault(found[form], []).append(number)
    return list(groups.values()), invalid


def _program(file: SceneFile) -> Hashable:
    """What compiled programs depend on."""
    shapes = jax.eval_shape(lambda: replace(build(file), source=None))
    leaves, structure = jax.tree.flatten(shapes)
    kinds = tuple((leaf.shape, str(leaf.dtype)) for leaf in leaves)
    return structure, kinds, file.n_frames, file.steps_per_frame


def _form(file: SceneFile) -> Hashable:
    """What scenes have in common that `build` makes of one another by their parameters alone.

    That takes in steps and frames, which by default depend on the motors.

    Raises:
        InputError: parts of the robot overlap.
    """
    content = file.model_dump(mode="json")
    for name in file.parameters:
        table, key = place_of(name)
        content[table].pop(key)
    shapes = tuple((name, np.shape(value)) for name, value in file.parameters.items())
    times = file.motor_table and file.motor_table.time
    return str(content), shapes, times, file.grid, *_size(file)


def _size(file: SceneFile) -> tuple[int, Indices | None]:
    """Degrees of freedom of a robot, and the pairs of its edges that can touch."""
    plain = {
        "material": MaterialTable(),
        "fluid": FluidTable(hydrodynamics="none"),
        "head": HeadTable(),
        "motor": MotorTable(),
        "time": TimeTable.model_validate({}),
        "contact": ContactTable(method="none"),
        "friction": None,
        "gravity": None,
        "motor_table": None,
    }
    # Scenes are hashable, which type checkers do not see.
    robot: Any = file.model_copy(update=plain)
    return _size_of_robot(robot, file.touching)


@lru_cache(maxsize=10_000)
def _size_of_robot(file: Any, touching: bool) -> tuple[int, Indices | None]:
    state = jax.eval_shape(lambda: build(file)).start
    return state.q.size, touching_pairs(file) if touching else None


def compute(
    chunk: Chunk, on_progress: Callable[[float], None] = lambda done: None
) -> list[Outcome]:
    """What comes out of points that share a program.

    A point's wall time is without compilation; of points that go together, its share.

    Args:
        chunk: the points.
        on_progress: told now and then how many points' worth has been done; may raise
            `Cancelled`.
    """
    numbers, files = list(chunk.files), list(chunk.files.values())
    with _preparing:
        scenes = _build_all(files, chunk.slots)
        states = scenes.start
        marching.prepare(scenes, states, files[0], chunk.slots)
    frames, reports, seconds = marching.march(scenes, states, files[0], chunk.slots, on_progress)
    whole = jax.tree.map(lambda a, b: np.concatenate([a[:, None], b], axis=1), states, frames)
    return [
        _outcome(
            number,
            file,
            pick(scenes, k),
            pick(whole, k),
            pick(reports, k),
            seconds[k],
            chunk.trajectories,
        )
        for k, (number, file) in enumerate(zip(numbers, files, strict=True))
    ]


def compute_surely(
    chunk: Chunk, on_progress: Callable[[float], None] = lambda done: None
) -> list[Outcome]:
    """`compute`, where whatever goes wrong with a point is its outcome, and no other's."""
    try:
        return compute(chunk, on_progress)
    except Cancelled:
        raise
    except Exception as error:
        if len(chunk.files) == 1:
            (number,) = chunk.files
            return [failed(number, ERROR, f"{type(error).__name__}: {error}")]
    outcomes = []
    for number, file in chunk.files.items():
        done = len(outcomes)
        one = Chunk({number: file}, 1, chunk.trajectories)
        outcomes += compute_surely(one, lambda part, done=done: on_progress(done + part))
    return outcomes


def _build_all(files: Sequence[SceneFile], slots: int) -> Scene:
    """The scenes of points, with a leading axis of points, on the host.

    Those of one form are built of the file of the first of them that this process has had: a
    program that builds scenes is one of a file.
    """
    kept = [_examples.setdefault(_form(file), file) for file in files]
    if takes_turns():
        built = [
            build_unchecked(example, file.parameters)
            for example, file in zip(kept, files, strict=True)
        ]
        singly = [replace(scene, source=None) for scene in jax.device_get(built)]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *singly)
    forms: dict[SceneFile, list[int]] = {}
    for k, example in enumerate(kept):
        forms.setdefault(example, []).append(k)
    parts = []
    for example, alike in forms.items():
        # Always for at least so many slots, for chunks of fewer points to share a program.
        spare = max(slots - len(alike), 0)
        values = [files[k].parameters for k in [*alike, *alike[:1] * spare]]
        columns = {name: np.array([v[name] for v in values], float) for name in values[0]}
        built = jax.tree.map(np.asarray, build_many(example, columns))
        parts.append(pick(built, slice(len(alike))))
    order = np.argsort(np.concatenate(list(forms.values())))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[order], *parts)


def _outcome(
    number: int,
    file: SceneFile,
    scene: Scene,
    states: State,
    report: RolloutStats,
    wall_time: float,
    keep: bool,
) -> Outcome:
    """What a run has come to. Without numbers if it failed: they would be of another time."""
    # A run that has failed stays where it is.
    moved = np.concatenate([[True], np.diff(states.time) > 0])
    status = {"status": Status(int(report.status)).name.lower(), "message": report.message()}
    dataset = None
    numbers: dict[str, Any] = {}
    if report.ok or keep:
        dataset = trajectory.to_dataset(
            scene,
            pick(states, moved),
            {"title": "A point of a sweep, by derjax", **status},
            file,
        )
    if report.ok and dataset is not None:
        numbers = summaries.summarise(dataset)
        del numbers["window_s"]
    costs = {
        "time_s": float(trajectory.rounded(states.time)[-1]),
        "steps": int(report.steps),
        "rejected_steps": int(report.rejected),
        "newton_iterations": int(report.iterations),
        "wall_time_s": round(wall_time, 4),
    }
    return Outcome(number, status | numbers | costs, dataset if keep else None)
