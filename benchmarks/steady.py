"""Steady swimming over the rate of the motor, and where it loses its stability.

    python -m benchmarks.steady [-o docs/figures]

For the default robot some numbers; for pitch / radius = 5, 7 and 9 the growth rate of the leading
mode, where it vanishes, and how that moves with other numbers; and what a curve of 30 rates costs
against simulations of 20 s at each (once compiled, processor time; every sixth rate is simulated),
and a state on finer meshes.
Writes steady.md, steady.png (curves for pitch / radius = 5) and steady_growth.png.
"""

import math
import time
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import derjax as dj
from derjax.results import steady as results

from .buckling import omega_bar, robot
from .command import command_line
from .tables import markdown

T = TypeVar("T")

RATES = (10.0, 60.0, 100.0, 200.0)
FORMATS = {
    "rpm": ".0f",
    "v_m_per_s": ".5e",
    "head_rate_rad_per_s": ".5f",
    "tail_to_head_m": ".6f",
    "torque_N_m": ".5e",
    "efficiency": ".4f",
    "growth_rate_per_s": ".4f",
    "frequency_per_s": ".5f",
    "iterations": ".0f",
    "solved in (s)": ".2f",
}
"""Columns of the table."""

CURVE = np.arange(10.0, 231.0, 20.0)

RADIUS, PITCHES = 6.36e-3, (5, 7, 9)
"""m, of the helix; and its pitch over that."""

RATES_OF_GROWTH = np.arange(10.0, 301.0, 10.0)
PUBLISHED = {5: 230.0, 7: 363.0, 9: math.nan}
"""Dimensionless rates at which flagella buckle (Lim, Yadunandan & Jawed 2023), in slow ramps."""

EDGES = (5e-3, 2.5e-3, 1.2e-3, 0.6e-3)
"""m, of finer and finer meshes."""

SLOPES = ("youngs_modulus", "viscosity", "rod_radius", "pitch", "regularization", "C_t", "C_r")


def scene(pitch: float, rpm: float) -> dj.Scene:
    """The default robot without inertia."""
    file = dj.SceneFile.from_dict({"robot": {"pitch": pitch}, "time": {"inertia": False}})
    return dj.build(file, {"rpm": rpm})


def rows(pitch: float, rates: np.ndarray | tuple[float, ...]) -> list[dict]:
    """Numbers of the steady states, and how long each took."""
    found, known = [], None
    for rpm in rates:
        began = time.perf_counter()
        state = jax.block_until_ready(dj.steady(scene(pitch, rpm), known))
        took = time.perf_counter() - began
        state.raise_if_failed()
        modes = dj.stability(state)
        numbers = results.row(state, modes.growth_rate, abs(modes.laboratory_frequency))
        found.append({"rpm": float(rpm), **numbers, "solved in (s)": took})
        known = state
    return found


def growth(pitch: float) -> pd.DataFrame:
    """The growth rate of the leading mode over the rate of the motor."""
    found, known = [], None
    for rpm in RATES_OF_GROWTH:
        state = dj.steady(scene(pitch, rpm), known)
        state.raise_if_failed()
        modes = dj.stability(state)
        found.append({"rpm": rpm, "growth": modes.growth_rate, "frequency": modes.frequency})
        known = state
    return pd.DataFrame(found)


def threshold(pitch: float, curve: pd.DataFrame) -> dict[str, float]:
    """Where the growth rate vanishes; by how many per cent one per cent of a number moves it."""
    unstable = curve["rpm"][curve["growth"] > 0.0]
    if not len(unstable):
        return {"rpm": math.nan}
    limit = dj.threshold(scene(pitch, float(unstable.iloc[0])))
    numbers = limit.stability.state.scene.parameters
    slopes = limit.derivatives(SLOPES)
    return {"rpm": limit.value} | {
        name: slope * float(numbers[name]) / limit.value for name, slope in slopes.items()
    }


def growth_figure(curves: dict[int, pd.DataFrame], unit: float) -> plt.Figure:
    """Growth rates over the dimensionless rate of the motor."""
    fig, axes = plt.subplots(figsize=(7, 4))
    for number, (ratio, curve) in enumerate(curves.items()):
        axes.plot(unit * curve["rpm"], curve["growth"], color=f"C{number}", label=f"{ratio}")
        if not math.isnan(PUBLISHED[ratio]):
            axes.axvline(PUBLISHED[ratio], color=f"C{number}", ls=":", lw=1)
    axes.axhline(0.0, color="0.3", lw=0.8)
    axes.set(xlabel=r"$\bar\omega$", ylabel="growth rate of the leading mode, 1/s")
    axes.legend(title="pitch / radius", fontsize=8, title_fontsize=8)
    axes.set_title("dotted: where flagella buckle in slow ramps, published", fontsize=9)
    axes.grid(alpha=0.3)
    fig.tight_layout()
    return fig


def cost() -> str:
    """What a curve of 30 rates costs, against simulations; and a point with its gradient."""
    rates = np.linspace(10.0, 300.0, 30)

    def curve() -> None:
        for state in dj.steady_curve(first, "rpm", rates):
            state.raise_if_failed()

    def simulations() -> None:
        for rpm in rates[::6]:
            run = dj.rollout(dj.build(long, {"rpm": rpm}), end=20.0, reverse_mode=False)
            run.raise_if_failed()

    first = scene(44.5e-3, 10.0)
    long = dj.SceneFile.from_dict({"robot": {"pitch": 44.5e-3}, "time": {"inertia": False}})
    (_, spent), (_, waited) = timed(curve), timed(simulations)
    waited *= 6.0
    known = dj.steady(first.replace(rpm=60.0))
    _, gradient = timed(lambda: jax.block_until_ready(slopes(first.replace(rpm=61.0), known)))
    return (
        f"A curve of 30 rates from 10 to 300 rpm (30 nodes) takes {spent:.2f} s; simulations of "
        f"20 s at each would take {waited:.0f} s, {waited / spent:.0f} times as long. One state "
        f"with its derivatives by four numbers takes {1e3 * gradient:.0f} ms."
    )


def timed(program: Callable[[], T]) -> tuple[T, float]:
    """What a program gives the second time, and its processor time (s)."""
    program()
    began = time.process_time()
    return program(), time.process_time() - began


BY = ("C_t", "C_r", "pitch", "youngs_modulus")


@jax.jit
def slopes(of: dj.Scene, known: dj.Steady) -> dict[str, jax.Array]:
    """Derivatives of speed and head rate."""

    def speeds(numbers: dict[str, jax.Array]) -> jax.Array:
        state = dj.steady(of.replace(**numbers), known)
        return jnp.stack([state.speed, state.head_rate])

    return jax.jacfwd(speeds)({name: of.parameters[name] for name in BY})


def sizes() -> pd.DataFrame:
    """What one state near a known one, and its modes, cost on finer and finer meshes."""
    found = []
    for edge in EDGES:
        tables = {"robot": {"edge_length": edge}, "time": {"inertia": False}}
        file = dj.SceneFile.from_dict(tables | {"solver": {"method": "dense"}})
        near = dj.steady(dj.build(file, {"rpm": 60.0}))
        state, spent = timed(lambda f=file, n=near: dj.steady(dj.build(f, {"rpm": 61.0}), n))
        state.raise_if_failed()
        _, modes = timed(lambda s=state: dj.stability(s))
        nodes = state.scene.rod.topology.n_nodes
        found.append({"nodes": nodes, "state (s)": spent, "modes (s)": modes})
    return pd.DataFrame(found)


def main() -> None:
    """Make table and figure."""
    arguments = command_line(__doc__).parse_args()
    default = rows(44.5e-3, RATES)
    curve = rows(31.8e-3, CURVE)
    limit = dj.threshold(scene(31.8e-3, 160.0))
    figure = results.curves(curve, "rpm", "rpm", [limit.value])
    figure.savefig(arguments.output / "steady.png", dpi=150)
    curves = {ratio: growth(ratio * RADIUS) for ratio in PITCHES}
    unit = omega_bar(robot(PITCHES[0]), 1.0)
    growth_figure(curves, unit).savefig(arguments.output / "steady_growth.png", dpi=150)
    limits = [
        {"pitch / radius": ratio, **threshold(ratio * RADIUS, curve), "published": PUBLISHED[ratio]}
        for ratio, curve in curves.items()
    ]
    table = pd.DataFrame(limits)
    table.insert(2, "omega bar", unit * table["rpm"])
    columns = {"pitch / radius": "d", "rpm": ".3f", "omega bar": ".2f", "published": ".0f"}
    columns |= dict.fromkeys(SLOPES, ".3f")
    text = (
        "# Steady swimming\n\n`python -m benchmarks.steady`: the default robot without inertia.\n\n"
        f"{markdown(pd.DataFrame(default), FORMATS)}\n"
        f"With a pitch of 31.8 mm it loses its stability at {limit.value:.4f} rpm.\n\n"
        f"{cost()} On finer meshes, matrices are dense:\n\n"
        f"{markdown(sizes(), {'nodes': 'd', 'state (s)': '.2f', 'modes (s)': '.2f'})}\n"
        "Where the leading mode begins to grow, and by how many per cent one per cent of a number "
        f"moves that:\n\n{markdown(table, columns)}"
    )
    (arguments.output / "steady.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
