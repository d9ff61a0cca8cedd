"""What every ingredient of a scene costs: time, iterations, and the size of the program.

    python -m benchmarks.ingredients [-o docs/figures] [--steps 100]

Scenes to which one term after another is added, from a rod that is only elastic, held and turned at
its base, to a robot with everything. Each is taken to 2 s (two turns of the motor, in steps of
20 ms), and the same number of steps from there on is timed in all scenes in turn: the least
processor time of several rounds. One step is also compiled on its own, for the number of equations
that JAX traces, of instructions that are left in the optimised program, and for what it takes to
compile it and of memory. Writes ingredients.csv, .md and .png.
"""

import re
import time
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import pandas as pd

import derjax
from derjax.integrate.frames import march_frames, new_stats
from derjax.scenes.file import SceneFile

from .command import command_line
from .tables import write

STEP, START = 0.02, 2.0
ROUNDS = 7

BARE = {"fluid": {"hydrodynamics": "none"}, "time": {"inertia": False}}
HELD = {"robot": {"kind": "clamped", "n_flagella": 1}}
LOCAL = {"fluid": {"hydrodynamics": "rft"}, "time": {"inertia": False}}
SLOW = {"time": {"inertia": False}}
TOUCHING = {"contact": {"method": "smooth"}}
DEFAULT = "robot: RSS + head + inertia (default)"
SCENES: dict[str, dict[str, Any]] = {
    "rod, held and turned: elastic only": HELD | BARE,
    "rod + inertia": HELD | {"fluid": {"hydrodynamics": "none"}},
    "rod + local drag (RFT)": HELD | LOCAL,
    "rod + Stokeslet segments (RSS)": HELD | SLOW,
    "robot: RFT + head": LOCAL,
    "robot: RSS + head": SLOW,
    DEFAULT: {},
    "... + contact": TOUCHING,
    "... + contact + friction": TOUCHING | {"friction": {"coefficient": 0.3}},
}


def scene(name: str) -> SceneFile:
    """One of `SCENES`, in steps of one length."""
    tables = SCENES[name]
    times = {"step": STEP, "end": START, **tables.get("time", {})}
    return SceneFile.model_validate({**tables, "time": times})


def count_equations(jaxpr: Any) -> int:
    """Equations of a jaxpr, those inside of loops and branches included."""
    total = 0
    for equation in jaxpr.eqns:
        total += 1
        for value in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")
        ):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                total += count_equations(inner)
    return total


INSTRUCTION = re.compile(r"^\s+(ROOT )?%?[\w.-]+ = ", re.MULTILINE)


def step_program(built: derjax.Scene, state: derjax.State) -> dict[str, float]:
    """The size of the program of one step, and what it takes to make it."""

    def step(scene: derjax.Scene, state: derjax.State) -> Any:
        return scene.scheme(scene, state, scene.step_length)

    equations = count_equations(jax.make_jaxpr(step)(built, state).jaxpr)
    jax.clear_caches()
    began = time.process_time()
    lowered = jax.jit(step).lower(built, state)
    traced = time.process_time() - began
    compiled = lowered.compile()
    memory = compiled.memory_analysis()
    return {
        "equations": equations,
        "HLO instructions": len(INSTRUCTION.findall(compiled.as_text())),
        "trace_s": traced,
        "compile_s": time.process_time() - began - traced,
        "memory_kB": memory.temp_size_in_bytes / 1e3,
    }


_march = jax.jit(march_frames, static_argnums=2)


def measure(steps: int) -> pd.DataFrame:
    """One row for each scene."""
    rows, runs = {}, {}
    for name in SCENES:
        built = derjax.build(scene(name))
        state = built.start
        rows[name] = {
            "scene": name,
            "terms": len(built.terms),
            "degrees of freedom": built.rod.topology.n_dofs,
            **step_program(built, state),
        }
        to_start = jnp.asarray(round(START / STEP))
        states, report = _march(built, state, 1, to_start, new_stats())
        report.raise_if_failed()
        runs[name] = built, jax.tree.map(lambda leaf: leaf[-1], states)
        print(rows[name], flush=True)
    best = dict.fromkeys(SCENES, float("inf"))
    for _ in range(ROUNDS):
        for name, (built, state) in runs.items():
            began = time.process_time()
            _, report = jax.block_until_ready(
                _march(built, state, 1, jnp.asarray(steps), new_stats())
            )
            best[name] = min(best[name], time.process_time() - began)
            report.raise_if_failed()
            rows[name] |= {
                "iterations": int(report.iterations) / steps,
                "factorings": int(report.factorings) / steps,
            }
    base = best[DEFAULT]
    for name, row in rows.items():
        row |= {"ms_per_step": 1e3 * best[name] / steps, "relative": best[name] / base}
        row["ms_per_iteration"] = row["ms_per_step"] / row["iterations"]
    return pd.DataFrame(rows.values())


PANELS = {
    "ms_per_step": "ms per step",
    "iterations": "Newton iterations per step",
    "HLO instructions": "HLO instructions, optimised",
    "compile_s": "s to compile a step",
}


def figure(table: pd.DataFrame) -> plt.Figure:
    """A bar for each scene, a panel for each measure."""
    fig, axes = plt.subplots(1, len(PANELS), figsize=(13, 4.4), sharey=True, layout="constrained")
    colours = ["#9cc9e8" if name.startswith("rod") else "#0b3c5d" for name in table.scene]
    for panel, (column, label) in zip(axes, PANELS.items(), strict=True):
        bars = panel.barh(table.scene, table[column], color=colours)
        panel.bar_label(bars, fmt=lambda v: f"{v:.3g}" if v < 100 else f"{v:.0f}", padding=3)
        panel.set_xlabel(label)
        panel.margins(x=0.22)
        panel.spines[["top", "right"]].set_visible(False)
    axes[0].invert_yaxis()
    return fig


def main() -> None:
    parser = command_line(__doc__, cache=False)
    parser.add_argument("--steps", type=int, default=100, help="that are timed")
    arguments = parser.parse_args()
    table = measure(arguments.steps)
    formats = {
        "scene": "",
        "degrees of freedom": "d",
        "ms_per_step": ".3g",
        "relative": ".2f",
        "iterations": ".2f",
        "factorings": ".2f",
        "ms_per_iteration": ".3g",
        "equations": "d",
        "HLO instructions": "d",
        "compile_s": ".2f",
        "memory_kB": ".0f",
    }
    note = (
        f"Steps of {1e3 * STEP:g} ms of the default scheme at 60 rpm, on one core; `relative` is "
        "to the default robot. A rod without drag follows its motor at once: it moves farther in "
        "a step, and takes more iterations and matrices."
    )
    write(table, arguments.output / "ingredients.csv", formats, note)
    figure(table).savefig(arguments.output / "ingredients.png", dpi=150)
    print((arguments.output / "ingredients.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
