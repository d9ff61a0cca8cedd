"""Several flagella on fixed motors with contact and friction: time for a second of motion.

    python -m benchmarks.many_flagella [-o docs/figures] [--flagella 2 3 5 10] [--end 20]

The scene of a published benchmark (D. Tong, A. Choi, J. Joo & M. K. Jawed, A fully implicit
method for robust frictional contact handling in elastic rods, Extreme Mech. Lett. 58, 101924, 2023,
and the template of its code): helices of radius 10 mm, pitch 50 mm and 200 mm length on a rod of
radius 1 mm, 68 nodes each, 30 mm apart, E = 3 MPa, 1 Pa s, 15 revolutions a minute. That code takes
steps of 1 ms, for which it needs 10.2, 21.3, 67.5 and 389 ms with 2, 3, 5 and 10 flagella. Here
steps adapt, with TR-BDF2 at a tolerance with which it is as accurate as implicit Euler in steps of
1 ms, what that code does; the nodes of two flagella over 4 s say so, against TR-BDF2 in steps of
2 ms. Processor time of one core. Writes many_flagella.csv, .md and .png.
"""

import time
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import derjax
from derjax import RolloutStats, Scene, State
from derjax.core.status import Status
from derjax.integrate.frames import new_stats
from derjax.integrate.step import enlarge
from derjax.results.bundling import contact_forces
from derjax.scenes.file import SceneFile
from derjax.terms.contact.repulsion import Contact

from .command import command_line
from .tables import write

PUBLISHED = {2: 10.2, 3: 21.3, 5: 67.5, 10: 389.0}
"""s for a simulated second: ms for a step of 1 ms."""

STIFFNESS = 1e4
"""N/m; 3.3 times the default, for the forces of so many turns on so thin a rod."""

HELIX_RADIUS = 0.01
FRAME = 0.5
ADAPTIVE = {"scheme": "trbdf2", "tolerance": 1e-5}
LIKE_PUBLISHED = {"scheme": "euler", "step": 1e-3}
FINEST = {"scheme": "trbdf2", "step": 2e-3}
COMPARED = 4.0
"""s, over which errors are compared."""

_march = jax.jit(derjax.march_frames, static_argnums=(2, 3))


def scene(n_flagella: int, end: float, times: Mapping[str, Any] = ADAPTIVE) -> SceneFile:
    """The published scene."""
    return SceneFile.model_validate(
        {
            "robot": {
                "kind": "clamped",
                "n_flagella": n_flagella,
                "helix_radius": HELIX_RADIUS,
                "pitch": 0.05,
                "axial_length": 0.2,
                "rod_radius": 1e-3,
                "edge_length": 0.0048,
                "separation": 0.03,
                "handedness": "right",
            },
            "material": {"youngs_modulus": 3e6, "density": 1000.0},
            "fluid": {"regularization": 1.02e-3},
            "motor": {"rpm": -15.0},
            "contact": {"stiffness": STIFFNESS},
            "friction": {"coefficient": 0.3},
            "time": {"end": end, "frame": FRAME, **times},
        }
    )


class Frame(NamedTuple):
    """The state at the end of a frame, the report up to there, the scene, and processor time."""

    state: State
    report: RolloutStats
    scene: Scene
    seconds: float


def frames(file: SceneFile) -> Iterator[Frame]:
    """A run frame by frame, up to its end or to the first step that fails."""
    built = derjax.build(file)
    state = built.start
    report, count = new_stats(), 0
    compiled = _march.lower(built, state, 1, file.steps_per_frame, report).compile()
    while count < file.n_frames and report.ok:
        began = time.process_time()
        states, new = jax.block_until_ready(compiled(built, state, report))
        spent = time.process_time() - began
        if new.status == Status.CAPACITY:
            built = enlarge(built)
            compiled = _march.lower(built, state, 1, file.steps_per_frame, report).compile()
            continue
        state, report, count = jax.tree.map(lambda leaf: leaf[0], states), new, count + 1
        yield Frame(state, report, built, spent)


def measure(n_flagella: int, end: float) -> list[dict[str, object]]:
    """One row for each frame: processor time for a simulated second, and what went on."""
    rows: list[dict[str, object]] = []
    steps = 0
    for state, report, built, spent in frames(scene(n_flagella, end)):
        taken, steps = int(report.steps) - steps, int(report.steps)
        (contact,) = (t for t in built.terms if isinstance(t, Contact))
        nodes = derjax.positions(built.rod.topology, state.q)[None]
        forces = np.asarray(contact_forces(contact, built.rod.topology, nodes))
        rows.append(
            {
                "flagella": n_flagella,
                "solver": "dense" if built.layout is None else "blocks",
                "time_s": float(state.time),
                "s_per_simulated_s": spent / FRAME,
                "steps": taken,
                "iterations": int(report.iterations),
                "contacts": int((forces > 0).sum()),
                "status": "" if report.ok else report.message(),
            }
        )
        print(rows[-1], flush=True)
    return rows


def errors() -> str:
    """How accurate steps that adapt are, and those of the published code, in words."""

    def nodes(times: Mapping[str, Any]) -> np.ndarray:
        run = list(frames(scene(2, COMPARED, times)))
        run[-1].report.raise_if_failed()
        return np.stack([derjax.positions(f.scene.rod.topology, f.state.q) for f in run])

    exact, worst = nodes(FINEST), []
    for times in (ADAPTIVE, LIKE_PUBLISHED):
        apart = np.linalg.norm(nodes(times) - exact, axis=-1)
        worst.append(np.sqrt(np.mean(apart**2, axis=-1)).max() / HELIX_RADIUS)
    return (
        f"Two flagella over {COMPARED:g} s: nodes are off by at most {worst[0]:.2g} helix radii "
        f"(RMS) here, by {worst[1]:.2g} with implicit Euler in steps of 1 ms."
    )


def figure(table: pd.DataFrame) -> plt.Figure:
    """Time for a simulated second, and contacts, against time; the published times as lines."""
    fig, (above, below) = plt.subplots(2, 1, figsize=(7, 6.5), sharex=True)
    for colour, (n, rows) in zip(("C0", "C1", "C2", "C3"), table.groupby("flagella"), strict=False):
        above.plot(rows["time_s"], rows["s_per_simulated_s"], color=colour, label=f"{n} flagella")
        above.axhline(PUBLISHED[int(n)], color=colour, linestyle="--", linewidth=0.8)
        below.plot(rows["time_s"], rows["contacts"], color=colour)
    above.set(yscale="log", ylabel="s for a simulated second")
    above.set_title("dashed: published, steps of 1 ms", fontsize=9)
    above.legend(fontsize=8)
    below.set(xlabel="time, s", ylabel="pairs of edges in contact")
    for axes in (above, below):
        axes.grid(alpha=0.3)
    fig.tight_layout()
    return fig


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--flagella", type=int, nargs="+", default=list(PUBLISHED))
    parser.add_argument("--end", type=float, default=20.0, help="s")
    arguments = parser.parse_args()
    table = pd.DataFrame([row for n in arguments.flagella for row in measure(n, arguments.end)])
    rows = []
    for n, part in table.groupby("flagella"):
        touching = part[part["contacts"] > 0]
        mean = part["s_per_simulated_s"].mean()
        rows.append(
            {
                "flagella": n,
                "solver": part["solver"].iloc[0],
                "simulated_s": part["time_s"].max(),
                "mean": mean,
                "in_contact": touching["s_per_simulated_s"].mean(),
                "worst": part["s_per_simulated_s"].max(),
                "published": PUBLISHED.get(int(n), float("nan")),
                "steps_per_s": part["steps"].mean() / FRAME,
                "status": part["status"].iloc[-1] or "ok",
            }
        )
        rows[-1]["faster"] = rows[-1]["published"] / rows[-1]["mean"]
    table.to_csv(arguments.output / "many_flagella_frames.csv", index=False, float_format="%.6g")
    formats = {
        "flagella": "d",
        "solver": "",
        "simulated_s": "g",
        "mean": ".3g",
        "in_contact": ".3g",
        "worst": ".3g",
        "published": ".3g",
        "faster": ".2g",
        "steps_per_s": ".3g",
        "status": "",
    }
    note = "Seconds of processor time for a simulated second; published: steps of 1 ms. " + errors()
    write(pd.DataFrame(rows), arguments.output / "many_flagella.csv", formats, note)
    figure(table).savefig(arguments.output / "many_flagella.png", dpi=150)


if __name__ == "__main__":
    main()
