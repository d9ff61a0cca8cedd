"""How closely derjax follows an independent code, and what each choice of method changes.

    python -m benchmarks.cross_code [-o docs/figures] [--only NAME ...]

Runs the single-flagellum robot at the parameters of the reference trajectories in
data/reference and compares speed and head rate over the last 20 s, the distance from head to
tail, and (at 70 rpm) the positions of all nodes at 10 s. Writes cross_code.csv, .md and .png.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import derjax
from derjax.scenes.file import SceneFile

from .command import command_line

DATA = Path(__file__).parent.parent / "data" / "reference"
RATES = (30, 70, 100)
HELIX_RADIUS = 6.4e-3

REFERENCE_FLUID = {
    "regularization": 1.67e-4,
    "end_nodes": "full",
    "drag_matrix": "collocation",
}
VARIANTS: dict[str, dict] = {
    "implicit, collocation": {},
    "implicit, lower triangle": {"fluid": {"drag_matrix": "lower_triangle"}},
    "implicit, symmetric": {"fluid": {"drag_matrix": "symmetric", "head_nodes": "dropped"}},
    "implicit, head excluded": {"fluid": {"head_nodes": "excluded"}},
    "implicit, half end nodes": {"fluid": {"end_nodes": "half"}},
    "implicit, drag on tilting head": {"head": {"rotation": "full"}},
    "implicit, rigid hinge": {"motor": {"hinge": "rigid"}},
    "implicit, no inertia": {"time": {"inertia": False}},
    "implicit, step 2.5 ms": {"time": {"step": 2.5e-3}},
    "implicit, default fluid choices": {
        "fluid": {"end_nodes": "half", "drag_matrix": "symmetric"},
    },
    "explicit 1 ms, collocation": {"time": {"scheme": "explicit", "step": 1e-3}},
    "explicit 1 ms, lower triangle": {
        "time": {"scheme": "explicit", "step": 1e-3},
        "fluid": {"drag_matrix": "lower_triangle"},
    },
}


class Track(NamedTuple):
    """A run at the frames of the reference: every 0.2 s up to 40 s."""

    time: np.ndarray
    x: np.ndarray
    head_angle: np.ndarray
    length: np.ndarray
    nodes: np.ndarray | None


def reference(rpm: int) -> Track:
    """The stored trajectory."""
    table = pd.read_csv(DATA / f"single_lambda7_rpm{rpm}.csv")
    nodes = None
    if rpm == 70:
        rows = np.loadtxt(DATA / "single_lambda7_rpm70_nodes.csv", delimiter=",")
        nodes = rows[np.isclose(rows[:, 0], 10.0), 1:].reshape(-1, 3)
    values = (table[name].to_numpy() for name in ("t", "hx", "th0", "Lp"))
    return Track(*values, nodes)


def scene(rpm: int, end: float = 40.0, **tables: dict) -> SceneFile:
    """The scene of the reference, with some keys changed."""
    fluid = REFERENCE_FLUID | tables.get("fluid", {})
    time = {"step": 1e-2, "end": end, "frame": 0.2} | tables.get("time", {})
    head = tables.get("head", {})
    motor = {"rpm": float(rpm), "hinge": "published"} | tables.get("motor", {})
    return SceneFile.model_validate({"fluid": fluid, "time": time, "head": head, "motor": motor})


_rollout = jax.jit(derjax.roll_frames, static_argnums=(2, 3))


def simulate(file: SceneFile) -> Track:
    """Run a scene; raises `SolverError` if a step fails."""
    built = derjax.build(file)
    start = built.start
    states, report = _rollout(built, start, file.n_frames, file.steps_per_frame)
    report.raise_if_failed()
    topology = built.rod.topology
    nodes = np.asarray(derjax.positions(topology, states.q))
    angle = np.asarray(derjax.angles(topology, states.q) + 2 * np.pi * states.turns)[:, 0]
    length = np.linalg.norm(nodes[:, -1] - nodes[:, 0], axis=1)
    at_ten = int(np.argmin(np.abs(np.asarray(states.time) - 10.0)))
    return Track(np.asarray(states.time), nodes[:, 0, 0], angle, length, nodes[at_ten])


def late(track: Track, since: float) -> np.ndarray:
    """Which frames are not earlier than `since` (s)."""
    return track.time >= since - 1e-9


def rate(track: Track, values: np.ndarray, since: float) -> float:
    """Slope of a straight line through the frames from `since` (s) on."""
    chosen = late(track, since)
    return float(np.polyfit(track.time[chosen], values[chosen], 1)[0])


def node_error(ours: np.ndarray, theirs: np.ndarray) -> float:
    """RMS distance of nodes in helix radii, from the head node, best rotated about x."""
    a, b = ours - ours[0], theirs - theirs[0]
    plane_a, plane_b = a[:, 1] + 1j * a[:, 2], b[:, 1] + 1j * b[:, 2]
    turn = np.sum(plane_b * plane_a.conj())
    difference = plane_a * turn / abs(turn) - plane_b
    squared = (a[:, 0] - b[:, 0]) ** 2 + abs(difference) ** 2
    return float(np.sqrt(squared.mean()) / HELIX_RADIUS)


def compare(rpm: int, ours: Track, since: float = 20.0) -> dict[str, float]:
    """Relative differences from the reference, from `since` (s) to the end of our track."""
    whole = reference(rpm)
    theirs = Track(*(part[: len(ours.time)] for part in whole[:4]), whole.nodes)
    ours_late, theirs_late = late(ours, since), late(theirs, since)
    row = {
        "rpm": rpm,
        "v_x": rate(ours, ours.x, since) / rate(theirs, theirs.x, since) - 1,
        "head_rate": rate(ours, ours.head_angle, since) / rate(theirs, theirs.head_angle, since)
        - 1,
        "head_to_tail": ours.length[ours_late].mean() / theirs.length[theirs_late].mean() - 1,
        "nodes": np.nan,
    }
    if theirs.nodes is not None and ours.nodes is not None:
        row["nodes"] = node_error(ours.nodes, theirs.nodes)
    return row


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    arguments = parser.parse_args()
    rows = []
    for name in arguments.only:
        for rpm in RATES:
            try:
                row = compare(rpm, simulate(scene(rpm, **VARIANTS[name])))
            except derjax.SolverError as error:
                print(f"{name}, {rpm} rpm: {error}")
                row = {"rpm": rpm}
            rows.append({"variant": name, **row})
            print({k: f"{v:+.4%}" if isinstance(v, float) else v for k, v in rows[-1].items()})
    table = pd.DataFrame(rows)
    table.to_csv(arguments.output / "cross_code.csv", index=False)
    (arguments.output / "cross_code.md").write_text(markdown(table), encoding="utf-8")
    figure(table).savefig(arguments.output / "cross_code.png", dpi=150)


def markdown(table: pd.DataFrame) -> str:
    """The differences in per cent, one row for each variant and motor rate."""
    columns = ["v_x", "head_rate", "head_to_tail", "nodes"]
    lines = ["| variant | rpm | v_x % | head rate % | head to tail % | nodes at 10 s, % of r |"]
    lines.append("|---|---|---|---|---|---|")
    for row in table.to_dict("records"):
        cells = ["" if pd.isna(row[c]) else f"{100 * row[c]:+.3f}" for c in columns]
        lines.append(f"| {row['variant']} | {row['rpm']} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def figure(table: pd.DataFrame) -> plt.Figure:
    """Differences in speed and head rate, by variant and motor rate."""
    names = list(dict.fromkeys(table["variant"]))
    fig, axes = plt.subplots(1, 2, figsize=(10, 0.45 * len(names) + 1.5), sharey=True)
    titles = {"v_x": "swimming speed", "head_rate": "head rate"}
    for axis, (column, title) in zip(axes, titles.items(), strict=True):
        axis.axvspan(-0.5, 0.5, color="0.93")
        axis.axvline(0, color="0.6", lw=0.8)
        for k, rpm in enumerate(RATES):
            rows = table[table["rpm"] == rpm]
            y = [names.index(n) + 0.2 * (k - 1) for n in rows["variant"]]
            axis.plot(100 * rows[column], y, "o", ms=5, label=f"{rpm} rpm")
        axis.set_xlabel(f"{title}: difference from the reference (%)")
    axes[0].set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    axes[1].legend(frameon=False)
    fig.tight_layout()
    return fig


if __name__ == "__main__":
    main()
