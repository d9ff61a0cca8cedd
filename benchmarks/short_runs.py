"""What many short runs cost, by how many there are, on one processor and on two.

    python -m benchmarks.short_runs [-o docs/figures] [--sizes 1 4 16 64 256 1024] [--rounds 1]
                                    [--points 1000]

Two robots at their defaults: that with one flagellum, from rest, and that with two (pitch / radius
= 5, antiphase), which touch in every run: it starts from a bundle that 10 s at 60 rpm have made.
Motors of 40 to 80 rpm and other drag prefactors, 0.2 s for each run. The runs of a batch go by
turns (`derjax.batch.march_many`), first in one process that may use one processor, then the same
programs on two, batch by batch. Written are

- runs_per_s: by wall time;
- speedup: of wall times, two processors over one;
- at_once: how many threads computed or waited for a processor, on the average, by the kernel's
  account: as many as processors where none waits for work or for another thread;
- processor_ms: processor time of the whole process for each run;
- expected: the speedup where nothing else computes, by at_once and processor_ms: how many times
  as many threads compute, over how many times as much processor time a run takes. Other work on the
  machine takes part in `speedup`, but hardly in this.

Last, the command: `derjax sweep` of 1,000 such runs of either robot, from rest, as whole processes
with programs compiled before. Linux only. Writes short_runs.csv, .md and .png.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import derjax
from derjax.runs.batch import build_many, march_many, pick, repeat
from derjax.scenes.file import SceneFile

from .command import command_line
from .tables import write

SIZES, ROUNDS, POINTS = (1, 4, 16, 64, 256, 1024), 1, 1000
END, BUNDLED = 0.2, 10.0
ROBOTS = {
    "one flagellum": {"robot": {"pitch": 44.5e-3}},
    "two touching": {"robot": {"kind": "two_flagella", "pitch": 31.8e-3, "phase": [np.pi, 0.0]}},
}
FORMATS = {
    "robot": "",
    "runs": "d",
    "processors": "d",
    "runs_per_s": ".3g",
    "wall_s": ".3g",
    "speedup": ".2f",
    "at_once": ".2f",
    "processor_ms": ".3g",
    "expected": ".2f",
    "load": ".1f",
}
NOTE = f"Runs of {END:g} s; `load` is that of the machine, two processors, before a batch."
PROCESSORS = sorted(os.sched_getaffinity(0))[:2]


def use(count: int) -> None:
    """Lets this process, with all its threads, and those that it starts use so many processors."""
    for thread in os.listdir("/proc/self/task"):
        with suppress(ProcessLookupError):  # it has ended meanwhile
            os.sched_setaffinity(int(thread), PROCESSORS[:count])


def file_of(robot: str, end: float = END) -> SceneFile:
    """The scene of runs of so many seconds."""
    return SceneFile.model_validate({**ROBOTS[robot], "time": {"end": end}})


def start_of(robot: str) -> derjax.State:
    """Where runs start: at rest, or in a bundle."""
    file = file_of(robot, BUNDLED)
    scene = derjax.build(file)
    if file.robot.count == 1:
        return scene.start
    one = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (scene, scene.start))
    states, reports = march_many(*one, file.n_frames, file.steps_per_frame)
    pick(reports, 0).raise_if_failed()
    return pick(states, (0, -1))


def numbers(size: int) -> dict[str, np.ndarray]:
    """What differs between runs: in no order, so that they are not alike in any part of a batch."""
    k = np.random.default_rng(0).permutation(size)
    return {"rpm": np.linspace(40.0, 80.0, size)[k], "C_t": np.linspace(4.0, 6.0, size)}


class Runs:
    """Batches of one robot."""

    def __init__(self, robot: str) -> None:
        self._file, self._start = file_of(robot), jax.device_get(start_of(robot))

    def batch(self, size: int) -> tuple[float, float, float]:
        """Wall and processor time (s) of a batch, and how many threads could compute at a time."""
        file = self._file
        scenes = jax.device_get(build_many(file, numbers(size)))
        states = jax.device_get(repeat(self._start, size))
        began, cpu, demand = time.perf_counter(), time.process_time(), wanted()
        _, reports = march_many(scenes, states, file.n_frames, file.steps_per_frame)
        wall, cpu = time.perf_counter() - began, time.process_time() - cpu
        demand = (wanted() - demand) / wall
        failed = np.flatnonzero(reports.status)
        if failed.size:
            raise RuntimeError(f"{failed.size} of {size} runs failed, the first is {failed[0]}")
        return wall, cpu, demand


def wanted() -> float:
    """Processor time (s) that the threads of this process have had, or have waited for."""
    total = 0
    for task in Path("/proc/self/task").iterdir():
        with suppress(OSError):  # it has ended meanwhile
            total += sum(map(int, (task / "schedstat").read_text().split()[:2]))
    return 1e-9 * total


def measure(robot: str, sizes: Sequence[int], rounds: int) -> list[dict[str, Any]]:
    """A row for each size and number of processors."""
    runs, rows = Runs(robot), []
    runs.batch(1)
    for size in sizes:
        found: dict[int, list[tuple[float, float, float]]] = {1: [], 2: []}
        load = os.getloadavg()[0]
        for _ in range(rounds):
            for processors, samples in found.items():
                use(processors)
                samples.append(runs.batch(size))
        one = np.median(found[1], axis=0)
        speedup = np.median([a[0] / b[0] for a, b in zip(found[1], found[2], strict=True)])
        for processors, samples in found.items():
            wall, cpu, at_once = np.median(samples, axis=0)
            rows.append(
                {
                    "robot": robot,
                    "runs": size,
                    "processors": processors,
                    "runs_per_s": size / wall,
                    "wall_s": wall,
                    "speedup": speedup if processors == 2 else 1.0,
                    "at_once": at_once,
                    "processor_ms": 1e3 * cpu / size,
                    "expected": at_once / one[2] * one[1] / cpu,
                    "load": load,
                }
            )
            print(rows[-1], flush=True)
    return rows


def command(robot: str, processors: int, points: int) -> dict[str, Any]:
    """A row for `derjax sweep` of so many points, as a process with programs compiled before."""
    with tempfile.TemporaryDirectory() as name:
        place, tables = Path(name), {**ROBOTS[robot], "time": {"end": END}}
        lines = [f"[{key}]\n{_toml(table)}" for key, table in tables.items()]
        (place / "scene.toml").write_text("\n".join(lines), encoding="utf-8")

        def sweep(count: int) -> tuple[float, float]:
            varied = "\n".join(f"{k} = {v.tolist()}" for k, v in numbers(count).items())
            text = f'scene = "scene.toml"\nmode = "together"\n[vary]\n{varied}\n'
            (place / "sweep.toml").write_text(text, encoding="utf-8")
            words = ["sweep", str(place / "sweep.toml"), "-o", str(place / "out"), "--overwrite"]
            words += ["--quiet", "--no-figures"]
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            began = time.perf_counter()
            subprocess.run([sys.executable, "-m", "derjax", *words], check=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            return time.perf_counter() - began, cpu

        use(processors)
        sweep(4 * 2)  # compiles
        load = os.getloadavg()[0]
        wall, cpu = sweep(points)
    name = f"derjax sweep, {robot.replace('touching', 'flagella')}"
    row = {"robot": name, "runs": points, "processors": processors, "load": load}
    row |= {"runs_per_s": points / wall, "wall_s": wall}
    row |= {"processor_ms": 1e3 * cpu / points}
    print(row, flush=True)
    return row


def _toml(table: Mapping[str, Any]) -> str:
    return "\n".join(f"{key} = {json.dumps(value)}" for key, value in table.items())


def figure(table: pd.DataFrame) -> plt.Figure:
    """Runs a second against the number of runs in the batch."""
    fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8))
    colours = dict(zip(ROBOTS, ("tab:blue", "tab:red"), strict=True))
    for robot, colour in colours.items():
        rows = table[table["robot"] == robot]
        for processors, style in ((1, "o--"), (2, "o-")):
            some = rows[rows["processors"] == processors]
            label = f"{robot}, {processors} processor{'s' * (processors > 1)}"
            left.plot(some["runs"], some["runs_per_s"], style, color=colour, label=label)
        two = rows[rows["processors"] == 2]
        right.plot(two["runs"], two["speedup"], "o:", color=colour, label=f"{robot}: wall times")
        right.plot(two["runs"], two["expected"], "s-", color=colour, label=f"{robot}: undisturbed")
    left.set(xscale="log", yscale="log", xlabel="runs in the batch", ylabel="runs / s")
    right.set(xscale="log", xlabel="runs in the batch", ylabel="two processors / one", ylim=(0, 3))
    right.axhline(1.9, color="0.4", lw=0.8)
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    fig.suptitle(f"runs of {END:g} s", fontsize=10)
    fig.tight_layout()
    return fig


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="runs in a batch")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="of which the median counts")
    parser.add_argument("--points", type=int, default=POINTS, help="of sweeps by the command")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []

    def keep() -> None:
        """Writes what has been measured so far."""
        write(pd.DataFrame(rows), arguments.output / "short_runs.csv", FORMATS, NOTE)

    for robot in ROBOTS:
        rows += measure(robot, arguments.sizes, arguments.rounds)
        keep()
    figure(pd.DataFrame(rows)).savefig(arguments.output / "short_runs.png", dpi=150)
    for robot in ROBOTS:
        for processors in (1, 2):
            rows.append(command(robot, processors, arguments.points))
            keep()
    print((arguments.output / "short_runs.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
