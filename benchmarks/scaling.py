"""Time and memory of a step against the number of nodes, and where blocks overtake one matrix.

    python -m benchmarks.scaling [-o docs/figures] [--largest 2000] [--only many|fine]

Two ways to become large: more and more flagella of 30 nodes on fixed motors, with contact, 10 rpm;
and one flagellum whose mesh is refined (a thin rod, so that edges stay longer than the
regularization). Five steps of 20 ms from rest, with one dense matrix and in blocks; processor time
of one core, and the memory that the compiled program asks for besides its arguments and results.
Writes scaling.csv, .md and .png.
"""

import time

import jax
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import derjax
from derjax.integrate.frames import new_stats
from derjax.scenes.file import SceneFile

from .command import command_line
from .tables import write

FLAGELLA = (2, 4, 8, 16, 32, 64)
EDGES = (4.5e-3, 2e-3, 1e-3, 5e-4, 2.4e-4, 1.2e-4, 6.5e-5)
"""m, of the refined flagellum: 31 to 2,000 nodes."""

LARGEST_DENSE = 450
STEPS = 5
LARGE = 200
"""Nodes from which on growth is fitted."""

_march = jax.jit(derjax.march_frames, static_argnums=(2, 3))


def many(n_flagella: int, method: str) -> SceneFile:
    """Flagella on fixed motors."""
    robot = {"kind": "clamped", "n_flagella": n_flagella}
    return _scene(robot, {}, method)


def fine(edge: float, method: str) -> SceneFile:
    """One flagellum on a fixed motor."""
    robot = {"kind": "clamped", "n_flagella": 1, "edge_length": edge, "rod_radius": 4e-5}
    return _scene(robot, {"regularization": 4e-5}, method)


def _scene(robot: dict, fluid: dict, method: str) -> SceneFile:
    return SceneFile.model_validate(
        {
            "robot": robot,
            "fluid": fluid,
            "motor": {"rpm": 10.0},
            "time": {"step": 0.02, "end": STEPS * 0.02, "frame": STEPS * 0.02},
            "solver": {"method": method},
        }
    )


def measure(way: str, file: SceneFile) -> dict[str, object]:
    """One row."""
    scene = derjax.build(file)
    state = scene.start
    began = time.perf_counter()
    compiled = _march.lower(scene, state, 1, STEPS, new_stats()).compile()
    compile_s = time.perf_counter() - began
    best, report = float("inf"), new_stats()
    for _ in range(2 if scene.rod.topology.n_nodes < 700 else 1):
        began = time.process_time()
        _, report = jax.block_until_ready(compiled(scene, state, new_stats()))
        best = min(best, time.process_time() - began)
    row = {
        "way": way,
        "solver": file.solver.method,
        "nodes": scene.rod.topology.n_nodes,
        "ms_per_step": 1e3 * best / max(int(report.steps), 1),
        "iterations_per_step": int(report.iterations) / max(int(report.steps), 1),
        "memory_MB": compiled.memory_analysis().temp_size_in_bytes / 1e6,
        "compile_s": compile_s,
        "status": "ok" if report.ok else report.message(),
    }
    print(row, flush=True)
    return row


def growth(table: pd.DataFrame, column: str) -> float:
    """The exponent with which a column grows with the number of nodes, from `LARGE` on."""
    rows = table[(table["nodes"] >= LARGE) & (table["status"] == "ok")]
    if len(rows) < 2:
        return float("nan")
    return float(np.polyfit(np.log(rows["nodes"]), np.log(rows[column]), 1)[0])


def figure(table: pd.DataFrame) -> plt.Figure:
    """Time and memory of a step against nodes."""
    fig, panels = plt.subplots(1, 2, figsize=(10, 4.2))
    for axes, column, label in zip(
        panels, ("ms_per_step", "memory_MB"), ("ms a step", "MB"), strict=True
    ):
        for (way, solver), rows in table.groupby(["way", "solver"], sort=False):
            rows = rows[rows["status"] == "ok"]
            style = {"dense": "o--", "blocks": "s-"}[solver]
            colour = {"many flagella": "C0", "fine mesh": "C1"}[way]
            axes.plot(rows["nodes"], rows[column], style, color=colour, label=f"{way}, {solver}")
        axes.set(xscale="log", yscale="log", xlabel="nodes", ylabel=label)
        axes.grid(alpha=0.3)
    n = np.array([200.0, 2000.0])
    lowest = panels[0].get_ylim()[0]
    panels[0].plot(n, 40 * lowest * (n / 200) ** 1.5, "k:", label="nodes to the 1.5")
    panels[0].legend(fontsize=8)
    fig.tight_layout()
    return fig


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--largest", type=int, default=2000, help="nodes")
    parser.add_argument("--only", choices=("many", "fine"), help="one of the two ways")
    arguments = parser.parse_args()
    rows = []
    for method, limit in (("blocks", arguments.largest), ("dense", LARGEST_DENSE)):
        for n in FLAGELLA:
            if arguments.only != "fine" and 28 * n <= min(limit, arguments.largest):
                rows.append(measure("many flagella", many(n, method)))
        for edge in EDGES:
            if arguments.only != "many" and 0.129 / edge <= min(limit, arguments.largest):
                rows.append(measure("fine mesh", fine(edge, method)))
    table = pd.DataFrame(rows)
    lines = []
    for (way, solver), part in table.groupby(["way", "solver"], sort=False):
        lines.append(
            f"- {way}, {solver}: time grows like nodes to the {growth(part, 'ms_per_step'):.2f}, "
            f"memory {growth(part, 'memory_MB'):.2f}, from {LARGE} nodes on."
        )
    formats = {"way": "", "solver": "", "nodes": "d", "ms_per_step": ".3g"}
    formats |= {"iterations_per_step": ".3g", "memory_MB": ".3g", "status": ""}
    write(table, arguments.output / "scaling.csv", formats, "\n".join(lines))
    figure(table).savefig(arguments.output / "scaling.png", dpi=150)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
