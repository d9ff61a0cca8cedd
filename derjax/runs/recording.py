"""A run while it is made: frame after frame, with what is needed to go on with it later."""

import dataclasses
import json
import time
import zipfile
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..core.errors import InputError
from ..core.programs import stored
from ..core.pytree import replace
from ..core.status import Status
from ..integrate.frames import RolloutStats, march_frames, new_stats
from ..integrate.step import Scene
from ..io.files import atomic_path
from ..rods.rod import History, State
from ..scenes.file import SceneFile

Advance = Callable[[State, RolloutStats], tuple[State, RolloutStats]]

_march = stored(march_frames, static=(2, 3))


@dataclasses.dataclass
class Recording:
    """What has been computed so far, on the host.

    Attributes:
        frames: the states at the start and after every frame.
        report: how the steps went.
        wall_time: s spent on the steps, without compilation.
        compile_time: s spent on compilation.
    """

    frames: list[State]
    report: RolloutStats
    wall_time: float = 0.0
    compile_time: float = 0.0

    @property
    def n_frames(self) -> int:
        """Frames computed, not counting the start."""
        return len(self.frames) - 1

    @property
    def stacked(self) -> State:
        """All frames as one `State` whose leaves have a leading axis of time."""
        return jax.tree.map(lambda *leaves: np.stack(leaves), *self.frames)


def new_recording(state: State) -> Recording:
    """The recording of a run that starts in `state`."""
    return Recording([jax.device_get(state)], jax.device_get(new_stats()))


def compile_frame(scene: Scene, recording: Recording, steps_per_frame: int) -> Advance:
    """The compiled program for one frame; the time that it takes is added to `recording`."""
    began = time.perf_counter()
    state, report = recording.frames[-1], recording.report
    # Without what no step asks for: scenes that differ in that alone share the program.
    bare = replace(scene, parameters={}, check_sums={}, initial=None, source=None)
    compiled = _march.compile(bare, state, 1, steps_per_frame, report)
    recording.compile_time += time.perf_counter() - began
    # From host to host: every operation on a device outside of it would be one more program.
    return lambda state, report: jax.device_get(compiled(bare, state, report))


def record(
    advance: Advance,
    recording: Recording,
    n_frames: int,
    enlarge: Callable[[], Advance] | None = None,
) -> Iterator[None]:
    """Computes frames up to `n_frames`, or to the first failed step; yields after each.

    A frame during which a step fails is kept if it got anywhere: it then is the state in which
    that step began. A run may be stopped after any frame and continued later by calling
    this function again: the frames are the same, bit by bit.

    A frame whose contacts do not fit into their list is computed again, by what `enlarge`
    returns.
    """
    state = recording.frames[-1]
    while recording.n_frames < n_frames and recording.report.ok:
        began = time.perf_counter()
        states, report = advance(state, recording.report)
        while report.status == Status.CAPACITY and enlarge is not None:
            advance = enlarge()
            began = time.perf_counter()
            states, report = advance(state, recording.report)
        state = jax.tree.map(lambda leaf: leaf[0], states)
        recording.wall_time += time.perf_counter() - began
        if state.time > recording.frames[-1].time:
            recording.frames.append(state)
        recording.report = report
        yield


def save_checkpoint(recording: Recording, scene: SceneFile, path: Path) -> None:
    """Writes all that `load_checkpoint` needs to an .npz file, replacing an older one."""
    stacked = vars(recording.stacked).copy()
    arrays = {f"history.{name}": leaf for name, leaf in vars(stacked.pop("history")).items()}
    arrays |= {f"frames.{name}": leaf for name, leaf in stacked.items()}
    arrays |= {f"report.{name}": leaf for name, leaf in vars(recording.report).items()}
    arrays["seconds"] = np.array([recording.wall_time, recording.compile_time])
    with atomic_path(path) as temporary:
        np.savez(temporary, identity=json.dumps(_identity(scene)), **arrays)


def load_checkpoint(scene: SceneFile, path: Path) -> Recording:
    """The recording that `save_checkpoint` has written.

    Raises:
        InputError: there is none, it cannot be read, or it belongs to another scene.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file: there is no unfinished run to resume") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a checkpoint: {error}") from None
    if "identity" not in arrays:
        raise InputError(f"{path}: not a checkpoint of derjax")
    if changes := _changes(json.loads(str(arrays["identity"])), _identity(scene)):
        raise InputError(
            f"{path}: this run is of another scene: {'; '.join(changes)}. "
            "Only the same scene can be resumed; --overwrite starts anew"
        )
    history = History(**_fields(arrays, "history."))
    stacked = State(**_fields(arrays, "frames."), history=history)
    n_frames = len(stacked.time)
    return Recording(
        [jax.tree.map(lambda leaf, k=k: leaf[k], stacked) for k in range(n_frames)],
        RolloutStats(**_fields(arrays, "report.")),
        *arrays["seconds"].tolist(),
    )


def _fields(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, Any]:
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


def _identity(scene: SceneFile) -> dict[str, Any]:
    """What two runs must have in common for one to continue the other, as JSON data."""
    table = scene.motor_table
    content = {
        "derjax version": version("derjax"),
        "motor table": None if table is None else table.model_dump(mode="json"),
        **scene.model_dump(mode="json"),
    }
    return json.loads(json.dumps(content))


def _changes(old: Any, new: Any, where: str = "") -> list[str]:
    """Which values differ, and how, in words."""
    if isinstance(old, dict) and isinstance(new, dict):
        changes = []
        for key in [*old, *(new.keys() - old.keys())]:
            inner = f"{where} {key}" if where else (f"[{key}]" if key in new else key)
            changes += _changes(old.get(key), new.get(key), inner)
        return changes
    if old == new:
        return []
    if isinstance(old, list) or isinstance(new, list):
        return [f"{where} differs"]
    return [f"{where} was {old}, is {new}"]
