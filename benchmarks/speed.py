"""How long a step takes on one core, and how long the first result, cold and warm.

    python -m benchmarks.speed [-o docs/figures]

Runs `derjax simulate` on the default single-flagellum robot (30 nodes, steps of 10 ms) in new
processes: with an empty compilation cache, then with a filled one, and a longer run for the
time per step, held to one core. Writes speed.csv and speed.md.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pandas as pd

from .command import command_line

LONG, SHORT = 20.0, 0.1


def simulate(directory: Path, end: float, cores: set[int] | None) -> tuple[float, dict]:
    """Wall time (s) of a whole process that simulates `end` seconds, and its summary."""
    scene, output = directory / "scene.toml", directory / f"run-{time.monotonic_ns()}"
    scene.write_text(f"[time]\nend = {end}\n", encoding="utf-8")
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(directory / "cache")}
    command = [sys.executable, "-m", "derjax", "simulate", str(scene), "-o", str(output)]
    began = time.perf_counter()
    subprocess.run(
        [*command, "--quiet", "--no-figures"],
        env=environment,
        check=True,
        preexec_fn=None if cores is None else lambda: os.sched_setaffinity(0, cores),
    )
    elapsed = time.perf_counter() - began
    return elapsed, json.loads((output / "summary.json").read_text(encoding="utf-8"))


def main() -> None:
    arguments = command_line(__doc__).parse_args()
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        cold, _ = simulate(directory, SHORT, None)
        warm, _ = simulate(directory, SHORT, None)
        one_core = {min(os.sched_getaffinity(0))}
        _, summary = simulate(directory, LONG, one_core)
    step = summary["wall_time_s"] / summary["steps"]
    iterations = summary["newton_iterations"] / summary["steps"]
    table = pd.DataFrame(
        [
            ("first result, empty compilation cache", cold, "s"),
            ("first result, filled compilation cache", warm, "s"),
            ("one step on one core", 1e3 * step, "ms"),
            ("Newton iterations in a step", iterations, ""),
            ("wall time of one simulated second on one core", summary["wall_time_s"] / LONG, "s"),
        ],
        columns=["what", "value", "unit"],
    )
    table.to_csv(arguments.output / "speed.csv", index=False)
    rows = [f"| {r.what} | {r.value:.3g} {r.unit} |" for r in table.itertuples()]
    text = "\n".join(["| what | figure |", "|---|---|", *rows]) + "\n"
    (arguments.output / "speed.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
