"""The runs of points of a sweep that share a program: by turns on a CPU, elsewhere as a batch."""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ...core.pytree import replace
from ...core.status import Status
from ...integrate.frames import RolloutStats, new_stats
from ...integrate.step import Scene, enlarge
from ...rods.rod import State
from ...scenes.file import SceneFile
from ..batch import advance, all_runs, pick, repeat, shard
from ..turns import program, takes_turns

MOST_FRAMES = 10
"""Of a piece: runs are computed in pieces, to see how far they have come and to stop them. Not a
part of the run, as points that have more frames than others would need a program of their own."""


def prepare(scenes: Scene, states: State, file: SceneFile, slots: int) -> None:
    """Has the program of `march` compiled."""
    if takes_turns():
        program(pick(scenes, 0), pick(states, 0), *_piece(file))
        return
    # Points that take no steps.
    over = replace(new_stats(), status=jnp.array(Status.NON_FINITE, jnp.int32))
    batch = shard(scenes, states, repeat(over, len(states.time)), slots=slots)
    jax.block_until_ready(advance(batch, *_piece(file))[1])


def _piece(file: SceneFile) -> tuple[int, int]:
    """Frames of a piece of a run, and steps of a frame."""
    frames = max(k for k in range(1, MOST_FRAMES + 1) if file.n_frames % k == 0)
    return frames, file.steps_per_frame


def march(
    scenes: Scene,
    states: State,
    file: SceneFile,
    slots: int,
    on_progress: Callable[[float], None],
) -> tuple[State, RolloutStats, list[float]]:
    """All frames of all points, how they went, and the wall times of each (s).

    Points whose contacts do not fit into their lists are computed again with longer ones.

    Args:
        scenes: of points that share a program, with a leading axis b, on the host.
        states: where they start, with a leading axis b.
        file: of one of them.
        slots: of the batch that they are computed in, at least, if they go together.
        on_progress: told now and then how many points' worth has been done.
    """
    if takes_turns():
        return _by_turns(scenes, states, file, on_progress)
    return _together(scenes, states, file, slots, on_progress)


def _by_turns(
    scenes: Scene,
    states: State,
    file: SceneFile,
    on_progress: Callable[[float], None],
) -> tuple[State, RolloutStats, list[float]]:
    """`march` of one point after another."""
    found = []
    for k in range(len(states.time)):
        began = time.perf_counter()
        scene, state = pick((scenes, states), k)
        run = _alone(scene, state, file, lambda done, k=k: on_progress(k + done))
        found.append((run, time.perf_counter() - began))
    runs, seconds = zip(*found, strict=True)
    frames, reports = jax.tree.map(lambda *leaves: np.stack(leaves), *runs)
    return frames, reports, list(seconds)


def _alone(
    scene: Scene, state: State, file: SceneFile, on_progress: Callable[[float], None]
) -> tuple[State, RolloutStats]:
    """All frames of one point; once more, with longer lists, if its contacts do not fit in."""
    frames_of_piece, steps_per_frame = _piece(file)
    march = program(scene, state, frames_of_piece, steps_per_frame)
    now, report, parts = state, jax.device_get(new_stats()), []
    for done in range(frames_of_piece, file.n_frames + 1, frames_of_piece):
        part, report = march(scene, now, report)
        now = pick(part, -1)
        parts.append(part)
        on_progress(done / file.n_frames)
    if report.status == Status.CAPACITY:
        longer = jax.device_get(enlarge(scene))
        return _alone(longer, state, file, lambda done: on_progress(1.0))  # for `Cancelled`
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts), report


def _together(
    scenes: Scene,
    states: State,
    file: SceneFile,
    slots: int,
    on_progress: Callable[[float], None],
) -> tuple[State, RolloutStats, list[float]]:
    """`march` of all points in one program; each has an equal share of the time."""
    began = time.perf_counter()
    count, n_frames = len(states.time), file.n_frames
    frames_of_piece, steps_per_frame = _piece(file)
    batch, parts = shard(scenes, states, slots=slots), []
    for done in range(frames_of_piece, n_frames + 1, frames_of_piece):
        batch, part = advance(batch, frames_of_piece, steps_per_frame)
        parts.append(all_runs(batch, part))
        on_progress(count * done / n_frames)
    frames = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *parts)
    reports = all_runs(batch, batch.reports)
    short = np.flatnonzero(reports.status == Status.CAPACITY)
    if short.size:
        again = _together(
            enlarge(pick(scenes, short)),
            pick(states, short),
            file,
            slots,
            lambda done: on_progress(count),  # for `Cancelled`
        )

        def put(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            old = np.array(old)
            old[short] = new
            return old

        frames, reports = jax.tree.map(put, (frames, reports), again[:2])
    return frames, reports, [(time.perf_counter() - began) / count] * count
