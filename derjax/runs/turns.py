"""Runs one after another, as a CPU takes them, on all of its processors at once.

    frames, reports = march_by_turns(scenes, scenes.start, n_frames, steps_per_frame)

A thread for every processor takes the next run as soon as it has done one. So no processor waits
for another before the last runs, however much longer some take: robots that touch take several
times as many iterations in one moment as in another, and as each other. All threads call the same
compiled program, that of a single run, which is kept on disk (`stored`); it is compiled for one
device of JAX, on which it may run many times at once. Devices of their own (`batch.shard`) would
have shares that are fixed beforehand, of one program for all, and wait for the slowest of them.
"""

import os
import threading
from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from ..core.programs import stored
from ..core.pytree import replace
from ..integrate.frames import RolloutStats, march_frames, new_stats
from ..integrate.step import Scene
from ..rods.rod import State

March = Callable[[Scene, State, RolloutStats], tuple[State, RolloutStats]]

stored_march = stored(march_frames, static=(2, 3))
_programs: dict[Hashable, March] = {}
_compiling = threading.Lock()


def processors() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def takes_turns() -> bool:
    """Whether runs go one after another here: on a CPU, if this process computes alone."""
    return jax.default_backend() == "cpu" and jax.process_count() == 1


def at_once() -> int:
    """How many runs go side by side: as many as processors, or what `JAX_NUM_CPU_DEVICES` says."""
    chosen = jax.config.jax_num_cpu_devices  # pyright: ignore[reportAttributeAccessIssue]
    return chosen if chosen > 0 else processors()


def bare(scene: Scene) -> Scene:
    """Without what no step asks for: scenes that differ in that alone share their program."""
    return replace(scene, parameters={}, check_sums={}, initial=None, source=None)


def program(scene: Scene, state: State, n_frames: int, steps_per_frame: int) -> March:
    """`march_frames`, compiled for scenes and states like these, from host to host.

    It may be called by many threads at a time, also this function: a program is compiled once.
    """
    arguments = bare(scene), state, new_stats()
    leaves, structure = jax.tree.flatten(arguments)
    kinds = tuple(jax.typeof(leaf) for leaf in leaves)
    key = n_frames, steps_per_frame, structure, kinds
    with _compiling:
        if key not in _programs:
            example = jax.tree.map(np.asarray, arguments)
            compiled = stored_march.compile(*example[:2], n_frames, steps_per_frame, example[2])
            _programs[key] = _from_host_to_host(compiled)
        return _programs[key]


def _from_host_to_host(compiled: Callable[..., Any]) -> March:
    def march(scene: Scene, state: State, report: RolloutStats) -> tuple[State, RolloutStats]:
        return jax.device_get(compiled(bare(scene), state, report))

    return march


def march_by_turns(
    scenes: Scene,
    states: State,
    n_frames: int,
    steps_per_frame: int,
    reports: RolloutStats | None = None,
) -> tuple[State, RolloutStats]:
    """`march_frames` for b runs: the states at the ends of frames (b, f, ...) and b reports.

    Args:
        scenes: what is simulated, with a leading axis b.
        states: where the runs start, with a leading axis b.
        n_frames: number of frames, f.
        steps_per_frame: length of a frame, in steps of the scenes' lengths.
        reports: of the runs that these continue, with a leading axis b.
    """
    count = len(states.time)
    scenes, states, reports = jax.device_get((scenes, states, reports))

    def run(k: int) -> tuple[State, RolloutStats]:
        scene, state, report = _one((scenes, states, reports), k)
        report = jax.device_get(new_stats()) if report is None else report
        return program(scene, state, n_frames, steps_per_frame)(scene, state, report)

    with ThreadPoolExecutor(at_once()) as pool:
        done = list(pool.map(run, range(count)))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *done)


def _one(trees: Any, k: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[k], trees)
