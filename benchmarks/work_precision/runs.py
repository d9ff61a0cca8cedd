"""Runs, which are made once, timed in several rounds, and kept in files."""

import json
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import derjax
from derjax.core.pytree import replace
from derjax.core.status import Status
from derjax.integrate.frames import march_frames, new_stats
from derjax.integrate.schemes.euler import euler
from derjax.integrate.schemes.trbdf2 import trbdf2
from derjax.integrate.step import enlarge
from derjax.results.dataset import to_dataset
from derjax.results.summary import summarise
from derjax.rods.kinematics import positions
from derjax.scenes.file import SceneFile

from .settings import Setting

LONG = 8.0
"""Processor time (s) above which a run is timed once."""

COUNTS = (40, 80, 160, 320, 640, 1280)
FINEST_COUNT = 5120
"""Steps in one turn of the motor, for the order of the schemes."""


class Run(NamedTuple):
    """What a run gave.

    Attributes:
        numbers: v_x, head rate, counts of steps, message, seconds of every round.
        moved: (t, f, n, 3) m, displacement of the nodes of every helix in every frame.
        along: (n,) m, where these nodes are on the helix, along the rod.
    """

    numbers: dict[str, Any]
    moved: np.ndarray
    along: np.ndarray


class Runs:
    """Runs that are made once, and kept in a directory."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._robot: tuple[Any, ...] = ()
        self._programs: dict[tuple[Any, ...], tuple[Any, float]] = {}
        directory.mkdir(parents=True, exist_ok=True)

    def _path(self, setting: Setting) -> Path:
        return self.directory / f"{setting.name}.npz"

    def __contains__(self, setting: Setting) -> bool:
        return self._path(setting).exists()

    def __getitem__(self, setting: Setting) -> Run:
        with np.load(self._path(setting)) as file:
            return Run(json.loads(str(file["numbers"])), file["moved"], file["along"])

    def _keep(self, setting: Setting, run: Run) -> None:
        with tempfile.NamedTemporaryFile(dir=self.directory, delete=False) as file:
            np.savez(file, numbers=json.dumps(run.numbers), moved=run.moved, along=run.along)
        Path(file.name).rename(self._path(setting))

    def make(self, setting: Setting) -> None:
        """A run, if there is none yet."""
        if setting in self:
            return
        file = setting.file
        scene = derjax.build(file)
        state = scene.start
        states, report, seconds, compiling = self._run(setting, scene, state)
        frames = jax.tree.map(lambda a, b: np.concatenate([a[None], b]), state, states)
        summary = dict.fromkeys(("v_x_m_per_s", "head_rate_rad_per_s"), np.nan)
        if report.ok:
            summary = summarise(to_dataset(scene, frames))
        nodes = np.asarray(jax.vmap(lambda q: positions(scene.rod.topology, q))(frames.q))
        helices = [path[2:] for path in scene.rod.topology.filaments]  # after the motor's shaft
        moved = np.stack([(nodes - nodes[:1])[:, path] for path in helices], axis=1)
        edge = float(scene.rod.rest_length[0])
        numbers = {
            **asdict(setting),
            "edge": edge,
            "v_x": summary["v_x_m_per_s"],
            "head rate": summary["head_rate_rad_per_s"],
            "steps": int(report.steps),
            "rejected": int(report.rejected),
            "iterations": int(report.iterations),
            "factorings": int(report.factorings),
            "message": "" if report.ok else report.message(),
            "compile_s": compiling,
            "seconds": [seconds],
        }
        self._keep(setting, Run(numbers, moved, edge * np.arange(len(helices[0]))))
        print(f"{setting.name}: {seconds:.3g} s {numbers['message']}", flush=True)

    def again(self, setting: Setting, rounds: int) -> None:
        """Another round of timing, if the run is short and there were fewer than that."""
        run = self[setting]
        seconds = run.numbers["seconds"]
        if run.numbers["message"] or min(seconds) > LONG or len(seconds) >= rounds:
            return
        scene = derjax.build(setting.file)
        seconds.append(self._run(setting, scene, scene.start)[2])
        self._keep(setting, run)

    def _run(self, setting: Setting, scene: derjax.Scene, state: derjax.State) -> tuple:
        """The states, the report, and seconds for the run and for compiling.

        A run whose list of contacts is too short is made again with a longer one, as
        `derjax simulate` does.
        """
        if setting.program[:3] != self._robot:  # a process cannot hold all programs
            self._robot = setting.program[:3]
            self._programs.clear()
            jax.clear_caches()
        scene = replace(scene, source=None)  # settings share programs, and their files differ
        times = setting.file
        steps, start = jnp.asarray(times.steps_per_frame), new_stats()
        for enlarged in range(6):
            program = (*setting.program, enlarged)
            if program not in self._programs:
                began = time.process_time()
                compiled = _march.lower(scene, state, times.n_frames, steps, start).compile()
                self._programs[program] = compiled, time.process_time() - began
            compiled, compiling = self._programs[program]
            began = time.process_time()
            states, report = jax.block_until_ready(compiled(scene, state, steps, start))
            seconds = time.process_time() - began
            if report.status != Status.CAPACITY:
                break
            scene = enlarge(scene)
        return states, report, seconds, compiling


_march = jax.jit(march_frames, static_argnums=2)


def orders(quick: bool) -> pd.DataFrame:
    """Errors of the nodes over one turn of the motor, from a developed state, in fixed steps."""
    rows = []
    for drag in ("rss",) if quick else ("rss", "rft"):
        for inertia in (True,) if quick else (True, False):
            times = {"scheme": "trbdf2", "step": 0.01, "end": 2.0, "inertia": inertia}
            file = SceneFile.model_validate(
                {"fluid": {"hydrodynamics": drag}, "time": times, "solver": {"tolerance": 1e-12}}
            )
            jax.clear_caches()
            scene = derjax.build(file)
            state = scene.start
            start = _end(scene, state, 200)

            def nodes(scheme, count, scene=scene, start=start):
                timed = replace(scene, scheme=scheme, step_length=jnp.asarray(1.0 / count))
                end = _end(timed, start, count)
                return np.asarray(positions(scene.rod.topology, end.q))

            exact = nodes(trbdf2, FINEST_COUNT)
            for scheme in (trbdf2, euler):
                for count in COUNTS:
                    error = np.mean(np.sum((nodes(scheme, count) - exact) ** 2, axis=-1)) ** 0.5
                    rows.append(
                        {
                            "drag": drag,
                            "inertia": inertia,
                            "scheme": scheme.__name__,
                            "step": 1.0 / count,
                            "error nodes": error / SceneFile().robot.helix_radius,
                        }
                    )
                    print(rows[-1], flush=True)
    return pd.DataFrame(rows)


def _end(scene: derjax.Scene, state: derjax.State, count: int) -> derjax.State:
    """The state after so many steps."""
    states, report = _march(scene, state, 1, jnp.asarray(count), new_stats())
    report.raise_if_failed()
    return jax.tree.map(lambda leaf: leaf[-1], states)
