"""How many runs a second a batch makes, on one device and on two.

    python -m benchmarks.batch [-o docs/figures] [--end 4] [--rounds 3]

The default robot (30 nodes) in steps that adapt, with motors of 20 to 100 rpm and other drag
prefactors: 32 single runs one after another with one compiled program, and the same runs, or some
of them, in batches. A device is a processor. Ratios are of wall times, of the same runs, measured
in turn in one process; the best of some rounds. Runs go by turns, each processor taking the next
when it is free; batches of 8 also as lanes of one `vmap`, on a mesh of devices.

Last, what a user sees who has 32 scene files: one command `derjax simulate` for each, and one
`derjax sweep` for all of them, both with programs that were compiled before. Here a process starts
for every single run. Writes batch.csv, .md and .png.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import derjax
from derjax.runs.batch import ALL, advance, build_many, march_many, shard, use_all_processors
from derjax.runs.turns import processors
from derjax.scenes.file import SceneFile

from .command import command_line
from .tables import write

RUNS = 32
RATES = np.linspace(20.0, 100.0, RUNS)
PREFACTORS = np.linspace(4.0, 6.0, RUNS)[::-1]
BATCHES = ((1, 1), (4, 1), (8, 1), (32, 1), (8, 4), (8, ALL))
"""Numbers of runs, and of lanes: how many a device takes at once."""
DEVICES = (1, 2)


def seconds(program: Callable[[], object]) -> float:
    """Wall time of a program."""
    began = time.perf_counter()
    jax.block_until_ready(program())
    return time.perf_counter() - began


def measure(end: float, rounds: int) -> list[dict[str, object]]:
    """A row for each batch, on the devices of this process."""
    file = SceneFile.model_validate({"time": {"end": end}})
    n_frames, steps = file.n_frames, file.steps_per_frame
    march_frames = jax.jit(derjax.march_frames, static_argnums=(2, 3))

    def single(k: int) -> Callable[[], object]:
        numbers = {"rpm": RATES[k], "C_t": PREFACTORS[k]}

        def run() -> object:
            scene = derjax.build(file, numbers)
            return march_frames(scene, scene.start, n_frames, steps)

        return run

    def together(runs: np.ndarray, lanes: int) -> Callable[[], object]:
        numbers = {"rpm": RATES[runs], "C_t": PREFACTORS[runs]}

        def run() -> object:
            scenes = build_many(file, numbers)
            if lanes == 1:  # by turns
                return march_many(scenes, scenes.start, n_frames, steps)
            return advance(shard(scenes, scenes.start), n_frames, steps, lanes)[1]

        return run

    chosen = {size: np.linspace(0, RUNS - 1, size).round().astype(int) for size, _ in BATCHES}
    chosen[1] = np.array([RUNS // 2])
    programs = {key: together(chosen[key[0]], key[1]) for key in BATCHES}
    for program in [single(0), *programs.values()]:
        seconds(program)  # compiles
    alone = np.full(RUNS, np.inf)
    best = dict.fromkeys(programs, np.inf)
    for _ in range(rounds):
        alone = np.minimum(alone, [seconds(single(k)) for k in range(RUNS)])
        for key, program in programs.items():
            best[key] = min(best[key], seconds(program))
    rows: list[dict[str, object]] = []
    for (size, lanes), spent in best.items():
        rows.append(
            {
                "against": "runs in one process",
                "devices": jax.device_count(),
                "runs": size,
                "lanes": "all" if lanes == ALL else str(lanes),
                "runs_per_s": size / spent,
                "single_runs_per_s": size / alone[chosen[size]].sum(),
                "ratio": alone[chosen[size]].sum() / spent,
            }
        )
    return rows


def measure_with(devices: int, end: float, rounds: int) -> list[dict[str, object]]:
    """`measure` in a process with so many devices."""
    command = [sys.executable, "-m", "benchmarks.batch", "--rows"]
    done = subprocess.run(
        [*command, "--end", str(end), "--rounds", str(rounds)],
        env={**os.environ, "JAX_NUM_CPU_DEVICES": str(devices)},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def commands(end: float) -> dict[str, object]:
    """A row for `derjax sweep`, against `derjax simulate` for each of its points."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        for k, (rate, prefactor) in enumerate(zip(RATES, PREFACTORS, strict=True)):
            text = f"[time]\nend = {end}\n[motor]\nrpm = {rate}\n[head]\nC_t = {prefactor}\n"
            (place / f"{k}.toml").write_text(text, encoding="utf-8")
        varied = {"rpm": RATES.tolist(), "C_t": PREFACTORS.tolist()}
        lines = ['scene = "0.toml"', 'mode = "together"', "[vary]"]
        lines += [f"{key} = {values}" for key, values in varied.items()]
        (place / "sweep.toml").write_text("\n".join(lines), encoding="utf-8")

        def derjax_(command: str, file: str, output: str) -> float:
            words = [command, str(place / file), "-o", str(place / output)]
            quietly = ["--quiet", "--no-figures"]
            return seconds(
                lambda: (
                    subprocess.run(
                        [sys.executable, "-m", "derjax", *words, *quietly], check=True
                    ).returncode
                )
            )

        derjax_("simulate", "0.toml", "first")  # compiles
        derjax_("sweep", "sweep.toml", "first_sweep")
        alone = sum(derjax_("simulate", f"{k}.toml", f"run{k}") for k in range(RUNS))
        together = derjax_("sweep", "sweep.toml", "sweep")
    return {
        "against": "commands",
        "devices": processors(),
        "runs": RUNS,
        "lanes": "1",
        "runs_per_s": RUNS / together,
        "single_runs_per_s": RUNS / alone,
        "ratio": alone / together,
    }


def figure(table: pd.DataFrame) -> plt.Figure:
    """Throughput over that of single runs, against the size of the batch."""
    fig, axes = plt.subplots(figsize=(7, 4))
    measured = table[table["against"] != "commands"]
    for (devices, lanes), rows in measured.groupby(["devices", "lanes"], sort=False):
        label = f"{devices} device{'s' * (devices > 1)}, lanes: {lanes}"
        axes.plot(rows["runs"], rows["ratio"], "o-", label=label)
    axes.axhline(1.0, color="0.3", lw=0.8)
    axes.set(xscale="log", xlabel="runs in the batch", ylabel="throughput / that of single runs")
    axes.set_xticks([1, 4, 8, 32], ["1", "4", "8", "32"])
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    fig.tight_layout()
    return fig


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--end", type=float, default=4.0, help="simulated seconds of a run")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--rows", action="store_true", help="only print rows, for this process")
    arguments = parser.parse_args()
    use_all_processors()
    if arguments.rows:
        print(json.dumps(measure(arguments.end, arguments.rounds)))
        return
    rows = []
    for devices in DEVICES:
        rows += measure_with(devices, arguments.end, arguments.rounds)
    rows.append(commands(arguments.end))
    table = pd.DataFrame(rows)
    formats = {
        "against": "",
        "devices": "d",
        "runs": "d",
        "lanes": "",
        "runs_per_s": ".3g",
        "ratio": ".2f",
    }
    write(table, arguments.output / "batch.csv", formats)
    figure(table).savefig(arguments.output / "batch.png", dpi=150)
    print((arguments.output / "batch.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
