"""Several flagella on fixed motors with contact and friction: time for a second of motion.

    python -m benchmarks.many_flagella [-o docs/figures] [--flagella 2 3 5 10] [--end 10 8 5 10]
                                       [--friction 0.3 0]

The robots of a published study (D. Tong, A. Choi, J. Joo & M. K. Jawed, A fully implicit method
for robust frictional contact handling in elastic rods, Extreme Mech. Lett. 58, 101924, 2023, and
the template of its code): helices of radius R = 10 mm, pitch 50 mm and 200 mm length on a rod of
radius 1 mm, 68 nodes each, 30 mm apart, E = 3 MPa, 1000 kg/m^3. Two cases of them:

- A, 15 rad/s in 0.1 Pa s, is where that code can take the steps of 1 ms that it is used with. The
  times beside those of derjax were measured with that code, built from source, on one core of a
  machine of this kind (drag explicit, contact implicit, sequential linear algebra).
- B, 15 revolutions a minute in 1 Pa s, is A but for inertia, which hardly matters, in another unit
  of time: both turn by as much in 0.1 s of A as in 0.96 s of B, and viscous over elastic forces are
  1.05 times as large. Steps that follow an error take as many of them for a turn; steps of a given
  length take 9.5 times as many. A ratio of times per simulated second in B therefore says how long
  the steps of the other code happen to be, and not what it costs to know the motion: 1 ms is
  9.5 times shorter there, on the scale of the motion, than A needs. It is here for that reason.

Here steps adapt, TR-BDF2 at a tolerance with which two flagella are as accurate after 1 s of A as
the other code with its steps of 1 ms (0.003 to 0.005 R); the benchmark measures that too, against a
tolerance 100 times smaller, beside implicit Euler in steps of 1 ms. Processor time of one core, and
none of it for compilation. Writes many_flagella.csv, .md, .png and many_flagella_frames.csv.
"""

import os
import time
from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path
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
from derjax.results.bundling import closeness, contact_forces
from derjax.scenes.file import SceneFile
from derjax.terms.contact.repulsion import Contact

from .command import command_line
from .tables import write

OTHER_BEFORE = {2: 10.5, 3: 23.9, 5: 72.9, 10: 452.0}
OTHER_IN_CONTACT = {(2, 0.0): 17.8, (2, 0.3): 16.4, (3, 0.0): 33.6, (3, 0.3): 38.8}
"""s for a simulated second of case A, by the other code in steps of 1 ms: by flagella, friction."""

CASES = {
    "A": {"fluid": {"viscosity": 0.1}, "motor": {"rpm": -15.0 * 30.0 / np.pi}},
    "B": {"fluid": {"viscosity": 1.0}, "motor": {"rpm": -15.0}},
}
TURN = {"A": 2.0 * np.pi / 15.0, "B": 4.0}
"""s."""

ENDS = {2: 10.0, 3: 8.0, 5: 5.0, 10: 10.0}
"""s of case A."""

STIFFNESS = 1e4
"""N/m; 3.3 times the default, for the forces of so many turns on so thin a rod."""

HELIX_RADIUS, ROD_RADIUS = 0.01, 1e-3
FRAMES_A_TURN = 4
STARTED = 0.5
"""Turns after which times count: motors jump from rest to their rate, which is followed closely."""

ADAPTIVE = {"scheme": "trbdf2", "tolerance": 1.5e-4}
LIKE_OTHER = {"scheme": "euler", "step": 1e-3}
FINEST = {"scheme": "trbdf2", "tolerance": 2e-6}
COMPARED = 1.0
"""s, over which errors are compared; nothing touches yet."""

_march = jax.jit(derjax.march_frames, static_argnums=(2, 3))


def scene(n_flagella: int, case: str, times: Mapping[str, Any], friction: float = 0.3) -> SceneFile:
    """The published robot."""
    tables: dict[str, dict[str, Any]] = {
        "robot": {
            "kind": "clamped",
            "n_flagella": n_flagella,
            "helix_radius": HELIX_RADIUS,
            "pitch": 0.05,
            "axial_length": 0.2,
            "rod_radius": ROD_RADIUS,
            "edge_length": 0.0048,
            "separation": 0.03,
            "handedness": "right",
        },
        "material": {"youngs_modulus": 3e6, "density": 1000.0},
        "fluid": {"regularization": 1.02e-3, **CASES[case]["fluid"]},
        "motor": CASES[case]["motor"],
        "contact": {"stiffness": STIFFNESS},
        "time": times,
    }
    if friction:
        tables["friction"] = {"coefficient": friction}
    return SceneFile.model_validate(tables)


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


def measure(n_flagella: int, case: str, end: float, friction: float) -> list[dict[str, object]]:
    """One row for each frame: processor time for a simulated second, and what went on."""
    rows: list[dict[str, object]] = []
    count, frame = round(end / TURN["A"] * FRAMES_A_TURN), TURN[case] / FRAMES_A_TURN
    times = {"end": count * frame, "frame": frame, **ADAPTIVE}
    file = scene(n_flagella, case, times, friction)
    taken = {"steps": 0, "rejected": 0, "iterations": 0, "factorings": 0}
    for state, report, built, spent in frames(file):
        before, taken = taken, {name: int(getattr(report, name)) for name in taken}
        (contact,) = (t for t in built.terms if isinstance(t, Contact))
        nodes = derjax.positions(built.rod.topology, state.q)[None]
        forces = np.asarray(contact_forces(contact, built.rod.topology, nodes))
        near = closeness(built.rod.topology, nodes, np.asarray(2 * ROD_RADIUS))
        rows.append(
            {
                "case": case,
                "flagella": n_flagella,
                "friction": friction,
                "solver": "dense" if built.layout is None else "blocks",
                "time_s": float(state.time),
                "turns": float(state.time) / TURN[case],
                "s_per_simulated_s": spent / frame,
                **{name: taken[name] - before[name] for name in taken},
                "contacts": int((forces > 0).sum()),
                "overlap": max(0.0, 1.0 - float(near.minimum_distance[0]) / (2 * ROD_RADIUS)),
                "bundled": float(near.bundle_fraction[0]),
                "status": "" if report.ok else report.message(),
            }
        )
        print(rows[-1], flush=True)
    return rows


def errors() -> str:
    """How accurate steps that adapt are, and those of 1 ms by implicit Euler, in words."""

    def nodes(steps: Mapping[str, Any]) -> np.ndarray:
        run = list(frames(scene(2, "A", {"end": COMPARED, "frame": 0.1, **steps})))
        run[-1].report.raise_if_failed()
        return np.asarray(derjax.positions(run[-1].scene.rod.topology, run[-1].state.q))

    exact = nodes(FINEST)
    off = [
        np.sqrt(np.mean(np.sum((nodes(steps) - exact) ** 2, axis=-1))) / HELIX_RADIUS
        for steps in (ADAPTIVE, LIKE_OTHER)
    ]
    return (
        f"Two flagella after {COMPARED:g} s of case A: nodes are off by {off[0]:.2g} R (root mean "
        f"square) here, by {off[1]:.2g} R with implicit Euler in steps of 1 ms."
    )


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """A row for each run: before the first contact, and from it on."""
    rows = []
    for (case, n, friction), part in table.groupby(["case", "flagella", "friction"], sort=False):
        started = part["turns"] > STARTED
        met = (part["contacts"] > 0).cummax()
        free, touching = part[started & ~met], part[met]
        other = (OTHER_BEFORE.get(n), OTHER_IN_CONTACT.get((n, friction)))
        seconds = free["s_per_simulated_s"].mean(), touching["s_per_simulated_s"].mean()
        row = {
            "case": case,
            "flagella": n,
            "friction": friction,
            "solver": part["solver"].iloc[0],
            "simulated_s": part["time_s"].max(),
            "first_contact_s": part["time_s"][met].min(),
            "before_contact": seconds[0],
            "in_contact": seconds[1],
            "before_per_turn": seconds[0] * TURN[case],
            "in_contact_per_turn": seconds[1] * TURN[case],
            "steps_a_turn": part[started]["steps"].mean() * FRAMES_A_TURN,
            "iterations_a_step": part["iterations"].sum()
            / (part["steps"] + part["rejected"]).sum(),
            "largest_overlap": part["overlap"].max(),
            "total_s": (part["s_per_simulated_s"] * TURN[case] / FRAMES_A_TURN).sum(),
            "status": part["status"].iloc[-1] or "ok",
        }
        if case == "A":
            row |= {"other_before": other[0], "other_in_contact": other[1]}
            row |= {
                f"faster_{when}": their / ours if their else float("nan")
                for when, their, ours in zip(("before", "in_contact"), other, seconds, strict=True)
            }
        rows.append(row)
    return pd.DataFrame(rows)


FORMATS = {
    "case": "",
    "flagella": "d",
    "friction": "g",
    "solver": "",
    "simulated_s": ".3g",
    "first_contact_s": ".2f",
    "before_contact": ".3g",
    "other_before": ".3g",
    "faster_before": ".2g",
    "in_contact": ".3g",
    "other_in_contact": ".3g",
    "faster_in_contact": ".2g",
    "before_per_turn": ".3g",
    "in_contact_per_turn": ".3g",
    "steps_a_turn": ".0f",
    "iterations_a_step": ".1f",
    "largest_overlap": ".2%",
    "total_s": ".0f",
    "status": "",
}
NOTE = (
    "Seconds of processor time of one core for a simulated second, and for a turn of the motors. "
    "Cases A and B are one problem in different units of time; only A is one that the other code "
    "is used for (`python -m benchmarks.many_flagella`). Nothing is counted of the first half "
    "turn, in which the motors start."
)


def figure(table: pd.DataFrame) -> plt.Figure:
    """Time for a simulated second of case A, and contacts; the other code's times as lines."""
    fig, (above, below) = plt.subplots(2, 1, figsize=(7, 6.5), sharex=True)
    part = table[table["case"] == "A"]
    colours = dict(zip(sorted(set(part["flagella"])), ("C0", "C1", "C2", "C3"), strict=False))
    for (n, friction), rows in part.groupby(["flagella", "friction"]):
        look = {"color": colours[n], "linestyle": "-" if friction else ":"}
        label = (
            f"{n} flagella, {'friction ' + format(friction, 'g') if friction else 'no friction'}"
        )
        above.plot(rows["time_s"], rows["s_per_simulated_s"], label=label, **look)
        below.plot(rows["time_s"], rows["contacts"], **look)
    for n, colour in colours.items():
        touching = [t for (m, _), t in OTHER_IN_CONTACT.items() if m == n]
        for their in [OTHER_BEFORE[n]] + ([max(touching)] if touching else []):
            above.axhline(their, color=colour, linestyle="--", linewidth=0.8)
    above.set(yscale="log", ylabel="s for a simulated second")
    above.set_title(
        "dashed: another code in steps of 1 ms, before contact and, above it, in contact",
        fontsize=9,
    )
    above.legend(fontsize=7)
    below.set(xlabel="time, s", ylabel="pairs of edges in contact")
    for axes in (above, below):
        axes.grid(alpha=0.3)
    fig.tight_layout()
    return fig


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--flagella", type=int, nargs="+", default=list(ENDS))
    parser.add_argument("--end", type=float, nargs="+", help="s of case A, for each number")
    parser.add_argument("--friction", type=float, nargs="+", default=[0.3, 0.0])
    arguments = parser.parse_args()
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    ends = dict(zip(arguments.flagella, arguments.end, strict=True)) if arguments.end else ENDS
    path: Path = arguments.output / "many_flagella.csv"
    rows: list[dict[str, object]] = []
    note = f"{NOTE} {errors()}"
    print(note, flush=True)
    runs = [
        ("A", n, friction)
        for n, friction in product(arguments.flagella, arguments.friction)
        if n in (2, 3) or friction == arguments.friction[0]
    ]
    runs += [("B", n, arguments.friction[0]) for n in arguments.flagella if n in (2, 3)]
    for case, n, friction in runs:
        rows += measure(n, case, ends[n], friction)
        table = pd.DataFrame(rows)
        table.to_csv(path.with_stem(path.stem + "_frames"), index=False, float_format="%.6g")
        write(summary(table), path, FORMATS, note)
        figure(table).savefig(path.with_suffix(".png"), dpi=150)
        plt.close("all")


if __name__ == "__main__":
    main()
