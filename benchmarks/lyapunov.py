"""How long derivatives of a bundling robot are of use.

    python -m benchmarks.lyapunov [-o docs/figures] [--end 24]

Two flagella (pitch / radius = 5, 60 rpm, contact, steps of 5 ms), one turned by half a radian at
the start so that nothing is symmetric. Follows, from frame to frame,

- the exact derivative of the state with respect to the pitch (forward mode), and
- the distance of two runs whose pitches differ by 1e-9 of it,

of which the growth in time gives the Lyapunov exponent; and compares the derivative of the head's
position with central differences of the same run, whose steps are 1e-7 and 1e-5 of the pitch.
Writes lyapunov.csv, lyapunov.md and lyapunov.png.
"""

from functools import partial

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import derjax
from derjax.runs.progress import Progress
from derjax.scenes.file import SceneFile

from .command import command_line

PITCH, STEP, STEPS = 31.8e-3, 5e-3, 20
DIFFERENCES = (1e-9, 1e-7, 1e-5)
"""Of the pitch, relative."""


def scene(end: float) -> SceneFile:
    """The robot, not symmetric."""
    robot = {"kind": "two_flagella", "pitch": PITCH, "phase": [np.pi, 0.5]}
    time = {"step": STEP, "end": end, "frame": STEP * STEPS}
    return SceneFile.model_validate({"robot": robot, "time": time, "contact": {"capacity": 200}})


@partial(jax.jit, static_argnums=0)
def start(file: SceneFile, relative: jax.Array):
    """Scene and state at a pitch relative to that of the file."""
    scene = derjax.build(file, {"pitch": PITCH * relative})
    return scene, scene.start


@jax.jit
def frame(built: derjax.Scene, state: derjax.State) -> tuple[derjax.State, jax.Array]:
    """The state after one more frame."""
    states, report = derjax.roll_frames(built, state, 1, STEPS)
    return jax.tree.map(lambda leaf: leaf[-1], states), report.status


@jax.jit
def frame_with_tangent(primal, tangent):
    """A frame, and how the state at its end changes."""
    (state, status), (change, _) = jax.jvp(frame, primal, tangent)
    return state, status, change


def position(topology: derjax.Topology, q: jax.Array) -> np.ndarray:
    """All nodes, m."""
    return np.asarray(derjax.positions(topology, q))


def follow(end: float) -> pd.DataFrame:
    """Derivatives and differences at every frame."""
    file = scene(end)
    one = jnp.ones(())
    primal, tangent = jax.jvp(lambda r: start(file, r), (one,), (one,))
    topology = primal[0].rod.topology
    head = topology.head.node
    near = {s * d: start(file, one + s * d) for d in DIFFERENCES for s in (1, -1)}
    rows = []
    with Progress(round(end / STEP), "steps") as progress:
        for k in range(file.n_frames):
            state, status, change = frame_with_tangent(primal, tangent)
            primal, tangent = (primal[0], state), (tangent[0], change)
            near = {d: (built, frame(built, s)[0]) for d, (built, s) in near.items()}
            x, dx = position(topology, state.q), position(topology, change.q)
            ends = {d: position(topology, s.q) for d, (_, s) in near.items()}
            row = {"time": float(state.time), "status": int(status)}
            row["tangent"] = float(np.sqrt(np.mean(dx**2)) / PITCH)
            smallest = DIFFERENCES[0]
            row["separation"] = float(
                np.sqrt(np.mean((ends[smallest] - x) ** 2)) / (smallest * PITCH)
            )
            for d in DIFFERENCES[1:]:
                slope = (ends[d][head] - ends[-d][head]) / (2 * d)
                error = np.linalg.norm(slope - dx[head]) / np.linalg.norm(dx[head])
                row[f"error {d:g}"] = float(error)
            rows.append(row)
            progress.update((k + 1) * STEPS)
            if row["status"]:
                break
    return pd.DataFrame(rows)


def exponent(table: pd.DataFrame) -> float:
    """Growth of the derivative (1/s): slope of its logarithm over the second half."""
    late = table[table["time"] > 0.5 * table["time"].max()]
    return float(np.polyfit(late["time"], np.log(late["tangent"]), 1)[0])


def horizon(table: pd.DataFrame, column: str, limit: float) -> float:
    """Time (s) up to which an error stays below a limit."""
    beyond = table.loc[table[column] > limit, "time"]
    return float(beyond.min()) if len(beyond) else float(table["time"].max())


def draw(table: pd.DataFrame) -> plt.Figure:
    """Growth of derivative and separation; errors of derivatives."""
    figure, (above, below) = plt.subplots(2, 1, figsize=(7.2, 6), sharex=True, layout="constrained")
    above.semilogy(table["time"], table["tangent"], color="#1f5a82", label="exact derivative")
    above.semilogy(
        table["time"], table["separation"], "--", color="#c1503a", label="two runs, 1e-9 apart"
    )
    above.set_ylabel("change of positions / change of pitch")
    for d, colour in zip(DIFFERENCES[1:], ("#1f5a82", "#c1503a"), strict=True):
        below.semilogy(
            table["time"], table[f"error {d:g}"], color=colour, label=f"differences of {d:g}"
        )
    below.axhline(0.01, color="black", lw=0.8, ls="--")
    below.set(ylabel="relative difference", xlabel="time (s)")
    below.set_title("Derivative of the head's position against central differences", loc="left")
    for ax in (above, below):
        ax.grid(alpha=0.25)
        ax.legend(frameon=False)
    return figure


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--end", type=float, default=24.0)
    arguments = parser.parse_args()
    table = follow(arguments.end)
    table.to_csv(arguments.output / "lyapunov.csv", index=False, float_format="%.5g")
    growth = exponent(table)
    lines = ["| what | figure |", "|---|---|"]
    lines += [f"| growth of the derivative in the second half | {growth:.3f} 1/s |"]
    lines += [f"| Lyapunov time | {f'{1 / growth:.2f} s' if growth > 0 else 'none: it decays'} |"]
    for d in DIFFERENCES[1:]:
        lines += [
            f"| derivative within {100 * limit:g} % of central differences of {d:g} until "
            f"| {horizon(table, f'error {d:g}', limit):.1f} s |"
            for limit in (0.01, 0.1)
        ]
    text = "\n".join(lines) + "\n"
    (arguments.output / "lyapunov.md").write_text(text, encoding="utf-8")
    draw(table).savefig(arguments.output / "lyapunov.png", dpi=160)
    print(text)


if __name__ == "__main__":
    main()
