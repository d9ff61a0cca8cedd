"""What designs cost: two parts of `python -m benchmarks.design`."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import derjax as dj
from derjax.scenes.motortable import RateTable
from fitting.design import Design, Search
from fitting.design.evaluate import ThroughRun, run_slopes
from fitting.design.landscape import landscape
from fitting.design.outcome import problem_of, solved
from fitting.design.problem import KEPT, Designs

from .design_rigid import robot
from .design_softness import SOFT
from .tables import markdown

VARY = {"pitch": (0.02, 0.08), "helix_radius": (4e-3, 9e-3)}
TORQUE = 1.5e-4
"""N m: the most that the motor has."""

STARTS, GRID, RUN_END = 8, 20, 20.0
SAMPLE = ((2, 3), (2, 16), (9, 9), (10, 14), (17, 3), (17, 16))
"""Points of the grid that are simulated, for a mean."""


def timed(program: Callable[[], Any]) -> tuple[Any, float, float]:
    """What a program gives; how long it took, and its processor time (s)."""
    wall, spent = time.perf_counter(), time.process_time()
    found = jax.block_until_ready(program())
    return found, time.perf_counter() - wall, time.process_time() - spent


def cost(output: Path) -> str:
    """A design with two variables against a grid of runs and one of steady states."""
    scene = robot(SOFT)
    problem = problem_of(scene, VARY, "speed", None, {"torque": (None, TORQUE)})
    search = Search(starts=STARTS)
    _, first, _ = timed(lambda: solved(Designs(problem), search))
    found, wall, spent = timed(lambda: solved(Designs(problem), search))
    _, _, alone = timed(lambda: solved(Designs(problem), Search(starts=1)))
    seconds, numbers = _runs(scene), problem.variables.numbers
    grid, grid_wall, _ = timed(lambda: landscape(Designs(problem), found.best, GRID))
    grid["kept"] = grid.pop("margin") >= -KEPT
    grid.to_csv(output / "design_cost.csv", index=False, float_format="%.6g")
    kept = grid.loc[grid["kept"]]
    best = kept.loc[kept["objective"].idxmax()]
    _cost_figure(grid, found).savefig(output / "design_cost.png", dpi=150)
    ends = pd.DataFrame(
        numbers(attempt.start.x)
        | {
            "pitch, end": np.nan if attempt.end is None else numbers(attempt.end.x)["pitch"],
            "radius, end": np.nan
            if attempt.end is None
            else numbers(attempt.end.x)["helix_radius"],
            "speed": np.nan if attempt.end is None else attempt.end.objective,
            "designs": len(attempt.path),
            "status": attempt.status,
        }
        for attempt in found.attempts
    )
    runs, runs_wall = GRID**2 * np.mean(seconds["processor"]), GRID**2 * np.mean(seconds["wall"])
    step = {name: (high - low) / (GRID - 1) for name, (low, high) in VARY.items()}
    return (
        "Pitch and radius of the robot with one flagellum at 60 rpm, without inertia, for speed, "
        f"with a torque of at most {TORQUE:g} N m.\n\n"
        f"From {STARTS} starts, once compiled (the same search a second time in one process; the "
        f"first took {first:.0f} s), it takes {wall:.1f} s, {spent:.1f} s of processor time, and "
        f"looks at {len(found.points)} designs. A run of {RUN_END:g} s with the default scheme "
        f"(implicit Euler, steps that adapt), without derivatives and once compiled, takes a mean "
        f"of {np.mean(seconds['wall']):.2f} s ({np.min(seconds['wall']):.2f} to "
        f"{np.max(seconds['wall']):.2f} s) over {len(SAMPLE)} points spread over a grid of {GRID} "
        f"x {GRID}, {np.mean(seconds['processor']):.2f} s of processor time. All {GRID**2} runs of "
        f"the grid, by that mean, would take {runs_wall:.0f} s: {runs_wall / wall:.0f} times as "
        f"long as the design ({runs / spent:.0f} times by processor time). All starts but the "
        f"first are there to be sure; from that alone, a design takes {alone:.1f} s of "
        f"processor time, and the grid {runs / alone:.0f} times that. The same grid of steady "
        f"states, with derivatives, takes {grid_wall:.0f} s.\n\n"
        f"Found: pitch {found.values['pitch']:.5f} m, radius {found.values['helix_radius']:.6f} m, "
        f"{found.objective:.5e} m/s; binding: {', '.join(found.binding) or 'nothing'}; at a bound: "
        f"{', '.join(found.at_bounds) or 'nothing'}. Best of the grid: pitch {best['pitch']:.5f} "
        f"m, radius {best['helix_radius']:.6f} m, {best['objective']:.5e} m/s, "
        f"{100 * (1 - best['objective'] / found.objective):.2f} % slower; that is "
        f"{abs(best['pitch'] - found.values['pitch']) / step['pitch']:.2f} and "
        f"{abs(best['helix_radius'] - found.values['helix_radius']) / step['helix_radius']:.2f} "
        "steps of the grid away.\n\n"
        + markdown(
            ends,
            {
                "pitch": ".4f",
                "helix_radius": ".5f",
                "pitch, end": ".5f",
                "radius, end": ".6f",
                "speed": ".6e",
                "designs": "d",
                "status": "",
            },
        )
        + "\n![Speed over pitch and radius](design_cost.png)"
    )


def _runs(scene: dj.Scene) -> dict[str, list[float]]:
    """How long runs at some points of the grid take, once compiled (s)."""
    pitches, radii = (np.linspace(*bounds, GRID) for bounds in VARY.values())

    def run(i: int, k: int) -> jax.Array:
        there = scene.replace(pitch=pitches[i], helix_radius=radii[k])
        found = dj.rollout(there, end=RUN_END, reverse_mode=False)
        found.raise_if_failed()
        return found.states.q

    run(*SAMPLE[0])
    every = [timed(lambda i=i, k=k: run(i, k))[1:] for i, k in SAMPLE]
    return {"wall": [wall for wall, _ in every], "processor": [spent for _, spent in every]}


def _cost_figure(grid: pd.DataFrame, found: Design) -> plt.Figure:
    fig, axes = plt.subplots(figsize=(6.5, 4.6), layout="constrained")
    shape = GRID, GRID
    x, y, z = (
        1e3 * grid[name].to_numpy().reshape(shape)
        for name in ("pitch", "helix_radius", "objective")
    )
    filled = axes.contourf(x, y, z, 20, cmap="viridis")
    fig.colorbar(filled, label="speed, mm/s")
    kept = grid["kept"].to_numpy(float).reshape(shape)
    axes.contourf(x, y, kept, [-0.5, 0.5], colors="none", hatches=["////"])
    variables = found.problem.variables
    for number, attempt in enumerate(found.attempts):
        path = np.array([list(variables.numbers(p.x).values()) for p in attempt.path])
        axes.plot(
            *(1e3 * path.T), "o-", color="w", ms=2.5, lw=0.8, label="" if number else "searches"
        )
        axes.plot(*(1e3 * path[0]), "s", color="w", mec="k", ms=5)
    best = 1e3 * np.array(list(found.values.values()))
    axes.plot(*best, "*", color="C3", mec="w", ms=15, label="design", ls="none")
    axes.set(xlabel="pitch, mm", ylabel="radius, mm")
    axes.legend(fontsize=8, loc="lower right", facecolor="0.7")
    axes.set_title(f"hatched: torque above {TORQUE:g} N m; squares: starts", fontsize=9)
    return fig


RATES, PROGRAMME_END, STEP, FINER = 50, 4.0, 0.02, 4
ENERGY = 2e-3
"""J, that the motor may spend."""


def programmed(rates: np.ndarray, step: float) -> dj.Scene:
    """The robot with a programme of its motor, from rest; each step is a frame."""
    times = np.linspace(0.0, PROGRAMME_END, len(rates))
    file = dj.robots.single_flagellum(
        time={"step": step, "end": PROGRAMME_END, "frame": step, "inertia": False}
    )
    table = RateTable(time=tuple(times), rpm=tuple(rates))
    return dj.build(file.model_copy(update={"motor_table": table}))


def programme(output: Path) -> str:
    """Fifty rates of a motor, by derivatives in reverse mode."""
    times = np.linspace(0.0, PROGRAMME_END, RATES)
    start = 60.0 + 30.0 * np.sin(4 * np.pi * times / PROGRAMME_END)
    scene = programmed(start, STEP)
    vary, limits = {"rpm": (0.0, 150.0)}, {"energy": (None, ENERGY)}
    problem = problem_of(scene, vary, "distance", None, limits, through="run")
    costs = _costs(problem.evaluator(), start)
    found, wall, _ = timed(lambda: solved(Designs(problem), Search(starts=1, most=60)))
    even = _even(problem.evaluator())
    rates = pd.DataFrame(
        {"time (s)": times, "start (rpm)": start, "best (rpm)": found.values["rpm"]}
    )
    rates["even (rpm)"] = even["rpm"]
    rates.to_csv(output / "design_programme.csv", index=False, float_format="%.6g")
    _programme_figure(rates, found, even).savefig(output / "design_programme.png", dpi=150)
    went = pd.DataFrame(
        [
            {"programme": "start", **_achieved(found.start.values)},
            {"programme": f"even, {even['rpm']:.2f} rpm", **_achieved(even)},
            {"programme": "best", **_achieved(found.quantities)},
        ]
    )
    finer = problem_of(
        programmed(start, STEP / FINER), vary, "distance", None, limits, through="run"
    ).evaluator()
    of_each = (start, np.full(RATES, even["rpm"]), found.values["rpm"])
    for row, rates_of in enumerate(of_each):
        for name, value in _achieved(finer({"rpm": rates_of}).values).items():
            went.loc[row, f"{name}, finer"] = value
    return (
        f"Rates of the motor of the robot with one flagellum at {RATES} times in "
        f"{PROGRAMME_END:g} s ({round(PROGRAMME_END / STEP)} steps, no inertia), linear in "
        f"between, for the distance on an energy of at most {ENERGY:g} J. Finer: with steps of "
        f"1/{FINER} of the length, of which the energy is a sum as well.\n\n"
        + markdown(went, {"programme": "", **dict.fromkeys(went.columns[1:], ".6e")})
        + f"\nThe search ({found.status}) looks at {len(found.points)} programmes in {wall:.0f} s."
        " Values and derivatives by all rates against the run alone (medians of five, "
        "processor time, once compiled; peak memory of temporaries by XLA's own count):\n\n"
        + markdown(
            costs,
            {
                "program": "",
                "processor time (s)": ".3f",
                "over the run": ".2f",
                "memory (MB)": ".2f",
            },
        )
        + "\n![Rates of the motor](design_programme.png)"
    )


def _achieved(values: dict[str, float]) -> dict[str, float]:
    return {"distance (m)": values["distance"], "energy (J)": values["energy"]}


def _costs(evaluate: ThroughRun, rates: np.ndarray) -> pd.DataFrame:
    """Processor time and memory of a run, and of values with derivatives."""
    scene, numbers = evaluate.scene, {"rpm": jnp.asarray(rates)}
    here = scene.replace(**numbers)
    division = evaluate.first, evaluate.enlargements
    alone = jax.jit(lambda scene: dj.rollout(scene, reverse_mode=False))
    one, both = (tuple(q.function for q in evaluate.quantities[:n]) for n in (1, 2))
    programs = {
        "the run alone": alone.lower(here),
        "distance, and its derivatives": run_slopes.lower(one, *division, scene, numbers),
        "distance and energy, and theirs": run_slopes.lower(both, *division, scene, numbers),
    }
    given = [(here,), (scene, numbers), (scene, numbers)]
    rows = []
    for (name, lowered), arguments in zip(programs.items(), given, strict=True):
        compiled = lowered.compile()
        jax.block_until_ready(compiled(*arguments))
        spent = [timed(lambda c=compiled, a=arguments: c(*a))[2] for _ in range(5)]
        memory = compiled.memory_analysis()
        rows.append(
            {
                "program": name,
                "processor time (s)": float(np.median(spent)),
                "memory (MB)": 1e-6 * memory.temp_size_in_bytes if memory else np.nan,
            }
        )
    table = pd.DataFrame(rows)
    table["over the run"] = table["processor time (s)"] / table["processor time (s)"][0]
    return table


def _even(evaluate: ThroughRun) -> dict[str, float]:
    """The constant rate that spends the energy."""
    low, high = 0.0, 150.0
    for _ in range(25):
        rpm = 0.5 * (low + high)
        values = evaluate({"rpm": np.full(RATES, rpm)}).values
        low, high = (rpm, high) if values["energy"] < ENERGY else (low, rpm)
    return {"rpm": rpm, **values}


def _programme_figure(rates: pd.DataFrame, found: Design, even: dict[str, float]) -> plt.Figure:
    fig, axes = plt.subplots(figsize=(6.5, 3.6), layout="constrained")
    times = rates["time (s)"]
    axes.plot(
        times,
        rates["start (rpm)"],
        color="0.6",
        label=f"start: {1e3 * found.start.objective:.3f} mm, "
        f"{1e3 * found.start.values['energy']:.2f} mJ",
    )
    axes.plot(
        times, rates["even (rpm)"], "k--", lw=1, label=f"even: {1e3 * even['distance']:.3f} mm"
    )
    axes.plot(
        times, rates["best (rpm)"], ".-", color="C0", label=f"best: {1e3 * found.objective:.3f} mm"
    )
    axes.set(xlabel="time, s", ylabel="rate of the motor, rpm")
    axes.legend(fontsize=8, title=f"energy at most {1e3 * ENERGY:g} mJ", title_fontsize=8)
    axes.grid(alpha=0.3)
    return fig
