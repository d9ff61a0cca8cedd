"""What a step is made of: milliseconds of every part, by the number of nodes.

    python -m benchmarks.step_cost [-o docs/figures] [--turns 6]

Robots of 30 nodes (one flagellum, 60 rpm, default scheme), 59 (two in antiphase, in contact), 138
and 207 (two and three filaments on fixed motors, case A of `benchmarks.many_flagella`) in one dense
matrix, and 690 (ten of them) in blocks, each after so many turns of its motors. A step solves one
system of equations for each of its stages (one for implicit Euler, two for TR-BDF2); before the
first iteration it is told where the rod is expected and makes matrices of drag and lists of
contacts.

- guess: where the rod is expected;
- drag, contact: what their terms make before a step, `Term.prepare`;
- matrix: assembly of the Newton matrix and its factors;
- solve: a direction with these factors;
- residual: potential and forces at a trial point, as the line search asks for;
- frames: frames and history at the end of a step;
- step: a whole one, as it runs, with its numbers of iterations and matrices.

Least of several runs of each part as a program of its own, on one core; a whole step, in which
XLA puts parts together, can be less than the sum. Writes step_cost.csv, .md and .png.
"""

import os
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import derjax
from derjax import Scene, State
from derjax.integrate.frames import new_stats
from derjax.integrate.step import acting_terms, predict, predicted_displacement
from derjax.rods.rod import transport_frames
from derjax.scenes.file import SceneFile
from derjax.solve.contributions import Mobility
from derjax.solve.potential import assemble
from derjax.solve.saddle import SaddlePointSystem
from derjax.terms.contact.repulsion import Contact
from derjax.terms.fluid.block_stokeslets import BlockStokeslets
from derjax.terms.fluid.stokeslets import StokesletSegments
from derjax.terms.term import Stage, contributions

from . import many_flagella
from .command import command_line
from .tables import write

ROUNDS = 9
PARTS = ("guess", "drag", "contact", "matrix", "solve", "residual", "frames")


def scenes() -> dict[str, SceneFile]:
    """The robots, by what they are."""
    two = {"kind": "two_flagella", "pitch": 31.8e-3, "phase": [np.pi, 0.0]}
    found = {
        "one flagellum": SceneFile.from_dict({"time": {"end": 20.0}}),
        "two in contact": SceneFile.from_dict({"robot": two, "time": {"end": 20.0}}),
    }
    for count in (2, 3, 10):
        times = {"end": 10.0, "frame": 0.1, **many_flagella.ADAPTIVE}
        found[f"{count} on fixed motors"] = many_flagella.scene(count, "A", times)
    return found


def seconds(program: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """What a program gives, and its processor time once compiled."""
    compiled = jax.jit(program).lower(*arguments).compile()
    result = jax.block_until_ready(compiled(*arguments))
    spent = []
    for _ in range(ROUNDS):
        began = time.process_time()
        jax.block_until_ready(compiled(*arguments))
        spent.append(time.process_time() - began)
    return result, min(spent)


def developed(scene: Scene, end: float) -> State:
    """The state after some time (s)."""
    run = derjax.rollout(scene, end=end, frame=end, reverse_mode=False)
    run.raise_if_failed()
    return run.last


def row_of(name: str, file: SceneFile, turns: float) -> dict[str, Any]:
    """Times (ms) of the parts of one robot's step."""
    scene = derjax.build(file)
    frame = file.time.end / file.n_frames
    end = max(1, round(turns * 60.0 / file.fastest_rpm / frame)) * frame
    state = developed(scene, end)
    stats = new_stats()
    (_, after), whole = seconds(
        lambda s, x, r: derjax.march_frames(s, x, 1, file.steps_per_frame, r), scene, state, stats
    )
    steps = max(1, int(after.steps) + int(after.rejected))
    length = jnp.asarray(frame / int(after.steps))
    row: dict[str, Any] = {
        "robot": name,
        "nodes": scene.rod.topology.n_nodes,
        "solver": "dense" if scene.layout is None else "blocks",
    }

    def prepared(kind: type) -> Callable[..., Any]:
        def prepare(scene: Scene, state: State) -> Any:
            prediction = predict(scene, state, length, length)
            return [t.prepare(scene.rod, state, prediction) for t in scene.terms if type(t) is kind]

        return prepare

    def move(scene: Scene, state: State) -> Any:
        return predicted_displacement(scene, state, length)

    _, row["guess"] = seconds(move, scene, state)
    drag = StokesletSegments if scene.layout is None else BlockStokeslets
    _, row["drag"] = seconds(prepared(drag), scene, state)
    _, row["contact"] = seconds(prepared(Contact), scene, state)

    def system(scene: Scene, state: State) -> Any:
        prediction = predict(scene, state, length, length)
        stage = Stage(length, state.time + length, state.motor_angle, state.q, state.velocity)
        parts = contributions(acting_terms(scene), scene.rod, state, stage, prediction)
        potential = assemble([c for c in parts if not isinstance(c, Mobility)])
        if scene.layout is None:
            return potential
        (mobility,) = [c for c in parts if isinstance(c, Mobility)]
        free = np.ones(state.q.size)
        free[list(scene.rod.topology.fixed_dofs)] = 0.0
        scale = scene.newton.force_scale
        return SaddlePointSystem(
            potential, mobility, scene.layout, state.q, jnp.asarray(free), scale
        )

    equations = jax.jit(system)(scene, state)
    blocks = isinstance(equations, SaddlePointSystem)
    at = equations.start(state.q) if blocks else state.q
    unit = equations.scales if blocks else jnp.broadcast_to(scene.newton.force_scale, state.q.shape)
    free = None
    if not blocks and scene.rod.topology.fixed_dofs:
        free = tuple(scene.rod.topology.free_dofs.tolist())
    chosen = slice(None) if free is None else np.array(free)
    matrix, row["matrix"] = seconds(
        lambda e, q, u: e.linearise(q, jnp.abs(q), u, free, exact=False)[0], equations, at, unit
    )
    gradient = jax.jit(lambda e, q: e.gradient(q))(equations, at)
    _, row["solve"] = seconds(
        lambda e, m, q, g: e.direction(m, q, g, chosen), equations, matrix, at, gradient
    )
    _, row["residual"] = seconds(lambda e, q: e.value_and_gradient(q), equations, at)
    _, row["frames"] = seconds(transport_frames, scene.rod, state, state.q)
    for part in PARTS:
        row[part] *= 1e3
    row["step"] = 1e3 * whole / steps
    row["iterations"] = int(after.iterations) / steps
    row["matrices"] = int(after.factorings) / steps
    print(row, flush=True)
    return row


def figure(table: pd.DataFrame) -> plt.Figure:
    """Milliseconds of a step by part, once or as often as they occur in a step."""
    fig, ax = plt.subplots(figsize=(7.5, 4.2), layout="constrained")
    stages = np.where(table["robot"].str.contains("fixed"), 2.0, 1.0)
    often = {
        "guess": 3 * stages,
        "drag": stages,
        "contact": stages,
        "matrix": table["matrices"],
        "solve": table["iterations"],
        "residual": table["iterations"] + stages,
        "frames": np.ones(len(table)),
    }
    below = np.zeros(len(table))
    places = np.arange(len(table))
    for part, times in often.items():
        height = (table[part] * times / table["step"]).to_numpy()
        ax.bar(places, height, bottom=below, label=part, width=0.65)
        below += height
    labels = [f"{r.robot}\n{r.nodes} nodes\n{r.step:.3g} ms" for r in table.itertuples()]
    ax.set_xticks(places, labels, fontsize=8)
    ax.axhline(1.0, color="0.4", lw=0.8)
    ax.set_ylabel("part of a step")
    ax.legend(fontsize=8, frameon=False, ncol=4)
    ax.set_ylim(0, 1.35 * max(1.0, below.max()))
    return fig


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--turns", type=float, default=6.0, help="before a step is looked at")
    arguments = parser.parse_args()
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    formats = {"robot": "", "nodes": "d", "solver": "", **dict.fromkeys(PARTS, ".3g")}
    formats |= {"step": ".3g", "iterations": ".1f", "matrices": ".1f"}
    rows = []
    for name, file in scenes().items():
        rows.append(row_of(name, file, arguments.turns))
        note = "Milliseconds, each part once (`python -m benchmarks.step_cost`)."
        write(pd.DataFrame(rows), arguments.output / "step_cost.csv", formats, note)
    figure(pd.DataFrame(rows)).savefig(arguments.output / "step_cost.png", dpi=150)


if __name__ == "__main__":
    main()
