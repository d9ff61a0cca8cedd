"""What derivatives of a run cost, in time and in memory.

    python -m benchmarks.gradient_cost [-o docs/figures] [--longest 20000]

The default robot (30 nodes) in steps of 20 ms: the run alone, with derivatives in forward mode with
respect to two and to eight parameters, and in reverse mode with respect to eight. Times are
processor time in one process, of all modes in turn; memory is what the compiled program asks for
besides its arguments and results. The longest runs are timed once, and only in reverse mode.
Writes gradient_cost.csv, .md and .png.
"""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import pandas as pd

import derjax
from derjax.scenes.file import SceneFile

from .command import command_line
from .tables import write

STEP = 0.02
ROUNDS = 5
LENGTHS = (100, 400, 1600, 20_000)
PARAMETERS = (
    "C_t",
    "C_r",
    "viscosity",
    "youngs_modulus",
    "pitch",
    "rod_radius",
    "helix_radius",
    "head_radius",
)
SCENE = SceneFile.model_validate({"time": {"step": STEP, "end": 1.0}})

Program = Callable[[jax.Array], object]


def programs(n_steps: int) -> dict[str, Program]:
    """A run of so many steps, and its derivatives, as functions of the parameters."""

    def total(values: jax.Array) -> jax.Array:
        names = PARAMETERS[: len(values)]
        scene = derjax.build(SCENE, dict(zip(names, values, strict=True)))
        state = scene.start
        states, _ = derjax.roll_frames(scene, state, 1, n_steps)
        return jnp.sum(states.q**2)

    def forward(count: int) -> Program:
        def push(values: jax.Array) -> object:
            along = jnp.eye(count)
            derivative = jax.vmap(
                lambda d: jax.jvp(total, (values[:count],), (d,)), out_axes=(None, 0)
            )
            return derivative(along)

        return push

    return {
        "run": total,
        "forward, 2 parameters": forward(2),
        "forward, 8 parameters": forward(8),
        "reverse, 8 parameters": jax.value_and_grad(total),
    }


def measure(n_steps: int) -> list[dict[str, object]]:
    """One row for each mode."""
    values = jnp.array([SCENE.parameters[name] for name in PARAMETERS], float)
    compiled, rows = {}, []
    for mode, program in programs(n_steps).items():
        began = time.perf_counter()
        compiled[mode] = jax.jit(program).lower(values).compile()
        memory = compiled[mode].memory_analysis().temp_size_in_bytes
        rows.append(
            {
                "steps": n_steps,
                "mode": mode,
                "memory_MB": memory / 1e6,
                "compile_s": time.perf_counter() - began,
            }
        )
    long = n_steps == max(LENGTHS)
    best = dict.fromkeys(compiled, float("inf"))
    for _ in range(1 if long else ROUNDS):
        for mode, program in compiled.items():
            if long and mode.startswith("forward"):
                continue
            began = time.process_time()
            jax.block_until_ready(program(values))
            best[mode] = min(best[mode], time.process_time() - began)
    for row in rows:
        spent = best[str(row["mode"])]
        if spent < float("inf"):
            row |= {"ms_per_step": 1e3 * spent / n_steps, "relative": spent / best["run"]}
        print(row, flush=True)
    return rows


def figure(table: pd.DataFrame) -> plt.Figure:
    """Time over that of the run, and memory, against the number of steps."""
    fig, (above, below) = plt.subplots(2, 1, figsize=(7, 6.5), sharex=True)
    for mode, rows in table.groupby("mode", sort=False):
        timed = rows.dropna(subset="relative") if "relative" in rows else rows
        above.plot(timed["steps"], timed["relative"], "o-", label=mode)
        below.plot(rows["steps"], rows["memory_MB"], "o-", label=mode)
    above.set_ylabel("time / time of the run")
    above.set_ylim(bottom=0)
    above.legend(fontsize=8)
    below.set(xscale="log", yscale="log", xlabel="steps", ylabel="memory, MB")
    for axes in (above, below):
        axes.grid(alpha=0.3)
    fig.tight_layout()
    return fig


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--longest", type=int, default=max(LENGTHS), help="steps")
    arguments = parser.parse_args()
    rows = [row for n in LENGTHS if n <= arguments.longest for row in measure(n)]
    table = pd.DataFrame(rows)
    formats = {"steps": "d", "mode": "", "ms_per_step": ".3g", "relative": ".2f"}
    write(table, arguments.output / "gradient_cost.csv", formats | {"memory_MB": ".3g"})
    figure(table).savefig(arguments.output / "gradient_cost.png", dpi=150)


if __name__ == "__main__":
    main()
