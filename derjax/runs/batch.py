"""Many runs of scenes of one structure, as one compiled program on all devices.

    scenes = build_many(file, {"rpm": rates, "C_t": prefactors})
    frames, reports = march_many(scenes, scenes.start, n_frames, steps_per_frame)

Scenes, states and reports of a batch are those of one run with a leading axis b, that of the
runs, on every leaf. So parameters, motor rates and initial states may all differ, while the
choices of a scene, which are its structure, are the same. Runs do not know of each other: one
that fails stays where it is, and the others are what they would be alone.

A computer without a GPU takes them one after another on each processor (`turns`), whichever is free
the next. Else the runs are laid out over a mesh of devices (`shard`) and go on together
(`advance`); each device takes its own runs at its own pace, and devices wait for each other only at
the end. With `jax.distributed` the mesh goes over all processes: each calls the same functions with
the same numbers and gets back either its own runs (`local_runs`) or, by communication, those of all
(`all_runs`).

How a device takes its runs depends on what it is. A GPU takes them all at once, as lanes of one
`jax.vmap`. A CPU takes them one after another there too. Lanes would share what starting an
operation costs, but with 30 nodes most of the time goes into linear algebra, which has nothing to
share: eight lanes that do exactly the same take 0.8 to 0.9 of the time for each. And lanes that
differ wait for each other, in every frame for the one with the most steps, in every step for the
one with the most iterations: eight motor rates from 20 to 100 rpm, in steps that adapt, take 4
times as long for each run as one after another, in steps of one length 2 times.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Int

from ..core.pytree import replace
from ..core.status import Status
from ..integrate.frames import RolloutStats, march_frames, new_stats
from ..integrate.step import Scene
from ..rods.rod import State
from ..scenes.build import build
from ..scenes.file import SceneFile
from .turns import march_by_turns, processors, takes_turns

T = TypeVar("T")

AXIS = "runs"
POOL = "NPROC"
"""Variable of the environment that holds the size of XLA's pool of threads."""

ALL = 0
"""As a number of lanes: all runs of a device at once."""


@dataclass(frozen=True)
class Batch:
    """Runs that are laid out over devices.

    Attributes:
        scenes: what is simulated, with a leading axis of slots.
        states: where the runs are.
        reports: how they went.
        slots: (p,) number of the run in each slot; -1 at slots that are there only to have
            as many on every device.
        mesh: the devices, in one row.
    """

    scenes: Scene
    states: State
    reports: RolloutStats
    slots: Int[np.ndarray, " p"]
    mesh: Mesh


def use_all_processors() -> None:
    """Let every processor be a device of its own.

    To be called before JAX computes anything, else it changes nothing; nor does it if a number
    of devices has been chosen already, as with `JAX_NUM_CPU_DEVICES`.

    XLA has one pool of threads for all devices, by default as many as processors. Programs on that
    many devices take all of them, and if their operations are large enough to be divided among
    threads, as with lanes, they wait for each other for ever. So the pool is made larger; its
    size is what the variable `NPROC` of the environment says.
    """
    os.environ.setdefault(POOL, str(2 * processors() + 2))
    if jax.config.jax_num_cpu_devices > 0:  # pyright: ignore[reportAttributeAccessIssue]
        return
    try:
        jax.config.update("jax_num_cpu_devices", processors())
    except RuntimeError:  # JAX has started: the devices are what they are
        return


def build_many(scene: SceneFile, parameters: Mapping[str, Any]) -> Scene:
    """The scenes of `build`, with a leading axis b, for many values of parameters.

    They do not know their file, so that scenes of files that differ in numbers alone are alike.

    Choices, and with them the number of nodes and the pairs of edges that may touch, are those of
    `scene` itself.

    Args:
        scene: the checked file.
        parameters: of each that varies b values, by the keys of `scene.parameters`.
    """
    values = {name: jnp.asarray(value, float) for name, value in parameters.items()}
    return jax.vmap(lambda p: replace(build(scene, p), source=None))(values)


def stack(trees: Sequence[T]) -> T:
    """One tree with a leading axis on every leaf, from trees of one structure."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def repeat(tree: T, count: int) -> T:
    """`stack` of so many times the same."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), tree)


def pick(tree: T, chosen: Any) -> T:
    """Of a tree with a leading axis of runs one run, or those that a slice or an array chooses."""
    return jax.tree.map(lambda leaf: leaf[chosen], tree)


def shard(
    scenes: Scene,
    states: State,
    reports: RolloutStats | None = None,
    devices: Sequence[Any] | None = None,
    slots: int | None = None,
) -> Batch:
    """Lays out b runs over devices.

    Args:
        scenes: with a leading axis b.
        states: where the runs start, with a leading axis b.
        reports: of the runs that these continue, with a leading axis b.
        devices: all of all processes if None.
        slots: at least so many: batches with equally many share a compiled program. Places
            that are left over do nothing.
    """
    devices = jax.devices() if devices is None else list(devices)
    mesh = Mesh(np.array(devices), (AXIS,))
    count = len(states.time)
    reports = repeat(new_stats(), count) if reports is None else reports
    rows = -(-max(count, slots or 0) // len(devices))
    # Neighbours go to different devices, as those in a sweep take about equally long.
    run = np.arange(rows * len(devices)).reshape(rows, -1).T.ravel()
    spare = run >= count
    run[spare] = 0
    # A run that has failed takes no steps.
    status = np.where(spare, Status.NON_FINITE, np.asarray(reports.status)[run])

    def lay_out(leaf: Any) -> jax.Array:
        host = np.asarray(leaf)
        sharding = NamedSharding(mesh, PartitionSpec(AXIS))
        return jax.make_array_from_callback(host.shape, sharding, lambda index: host[index])

    def placed(tree: T) -> T:
        return jax.tree.map(lambda leaf: np.asarray(leaf)[run], tree)

    laid: tuple[Scene, State, RolloutStats] = jax.tree.map(
        lay_out,
        (
            placed(scenes),
            placed(states),
            replace(placed(reports), status=status.astype(np.int32)),
        ),
    )
    return Batch(*laid, slots=np.where(spare, -1, run), mesh=mesh)


def advance(
    batch: Batch, n_frames: int, steps_per_frame: int, lanes: int | None = None
) -> tuple[Batch, State]:
    """`march_frames` for every run of a batch, in one program.

    Args:
        batch: the runs, as `shard` or this function returns them.
        n_frames: number of frames, f.
        steps_per_frame: length of a frame, in steps of the scenes' lengths.
        lanes: how many runs a device takes at once, `ALL` for all of them. None: one on a CPU, all
            elsewhere; the docstring of the module says why.

    Returns:
        The batch at the end, and the states at the ends of the frames, with leading axes of
        slots and frames: `local_runs` and `all_runs` sort them by the runs' numbers.
    """
    if lanes is None:
        lanes = 1 if batch.mesh.devices.flat[0].platform == "cpu" else ALL
    states, reports, frames = _advance(
        batch.mesh, n_frames, steps_per_frame, lanes, batch.scenes, batch.states, batch.reports
    )
    return replace(batch, states=states, reports=reports), frames


@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def _advance(
    mesh: Mesh,
    n_frames: int,
    steps_per_frame: int,
    lanes: int,
    scenes: Scene,
    states: State,
    reports: RolloutStats,
) -> tuple[State, RolloutStats, State]:
    def one(run: tuple[Scene, State, RolloutStats]) -> tuple[State, RolloutStats, State]:
        scene, state, report = run
        frames, report = march_frames(scene, state, n_frames, steps_per_frame, report)
        return pick(frames, -1), report, frames

    def of_device(*runs: Any) -> tuple[State, RolloutStats, State]:
        if lanes == ALL:
            return jax.vmap(one)(runs)
        return lax.map(one, runs, batch_size=None if lanes == 1 else lanes)

    here = PartitionSpec(AXIS)
    whole = jax.shard_map(of_device, mesh=mesh, in_specs=here, out_specs=here, check_vma=False)
    return whole(scenes, states, reports)


def local_runs(batch: Batch, tree: T) -> tuple[Int[np.ndarray, " k"], T]:
    """The runs of this process: their numbers, and what belongs to them, on the host.

    Args:
        batch: what `tree` belongs to.
        tree: arrays with a leading axis of slots, such as the reports of the batch.
    """

    def rows(leaf: jax.Array) -> np.ndarray:
        shards = {shard.index[0].start or 0: shard.data for shard in leaf.addressable_shards}
        return np.concatenate([np.asarray(shards[start]) for start in sorted(shards)])

    whole = NamedSharding(batch.mesh, PartitionSpec(AXIS))
    indices = whole.addressable_devices_indices_map(batch.slots.shape).values()
    slices = sorted((i[0] for i in indices if i), key=lambda part: part.start or 0)
    slots = np.concatenate([batch.slots[part] for part in slices])
    return _sorted(slots, jax.tree.map(rows, tree))


def all_runs(batch: Batch, tree: T) -> T:
    """What belongs to all runs, on the host of every process, with a leading axis b."""
    if jax.process_count() == 1:
        return local_runs(batch, tree)[1]
    return _sorted(batch.slots, multihost_utils.process_allgather(tree, tiled=True))[1]


def _sorted(slots: np.ndarray, tree: T) -> tuple[np.ndarray, T]:
    """By the numbers of the runs, without the slots that do nothing."""
    order = np.argsort(slots, kind="stable")[np.count_nonzero(slots < 0) :]
    return slots[order], jax.tree.map(lambda leaf: np.asarray(leaf)[order], tree)


def march_many(
    scenes: Scene,
    states: State,
    n_frames: int,
    steps_per_frame: int,
    reports: RolloutStats | None = None,
    devices: Sequence[Any] | None = None,
    lanes: int | None = None,
) -> tuple[State, RolloutStats]:
    """`march_frames` for b runs: the states at the ends of frames (b, f, ...) and b reports.

    On a CPU every processor takes the next run as soon as it is free, unless devices or lanes are
    given, which are as those of `shard` and `advance`. The results are on the host, those of all
    runs in every process.
    """
    if devices is None and lanes is None and takes_turns():
        return march_by_turns(scenes, states, n_frames, steps_per_frame, reports)
    batch = shard(scenes, states, reports, devices)
    batch, frames = advance(batch, n_frames, steps_per_frame, lanes)
    return all_runs(batch, (frames, batch.reports))
