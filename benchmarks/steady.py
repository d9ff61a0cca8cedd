"""Steady swimming over the rate of the motor, and where it loses its stability.

    python -m benchmarks.steady [-o docs/figures]

Writes steady.md, and steady.png: curves for pitch / radius = 5, with the threshold.
"""

import argparse
import time
from pathlib import Path

import jax
import numpy as np

import derjax as dj
from derjax.results import steady as results
from derjax.steady.solve import steady_near

from .tables import markdown

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


def scene(pitch: float, rpm: float) -> dj.Scene:
    """The default robot without inertia."""
    file = dj.SceneFile.from_dict({"robot": {"pitch": pitch}, "time": {"inertia": False}})
    return dj.build(file, {"rpm": rpm})


def rows(pitch: float, rates: np.ndarray | tuple[float, ...]) -> list[dict]:
    """Numbers of the steady states, and how long each took."""
    found, known = [], None
    for rpm in rates:
        began = time.perf_counter()
        state = jax.block_until_ready(steady_near(scene(pitch, rpm), known))
        took = time.perf_counter() - began
        state.raise_if_failed()
        modes = dj.stability(state)
        numbers = results.row(state, modes.growth_rate, abs(modes.laboratory_frequency))
        found.append({"rpm": float(rpm), **numbers, "solved in (s)": took})
        known = state
    return found


def main() -> None:
    """Make table and figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/figures"))
    arguments = parser.parse_args()
    import pandas as pd

    default = rows(44.5e-3, RATES)
    curve = rows(31.8e-3, CURVE)
    limit = dj.threshold(scene(31.8e-3, 160.0))
    arguments.output.mkdir(parents=True, exist_ok=True)
    figure = results.curves(curve, "rpm", "rpm", [limit.value])
    figure.savefig(arguments.output / "steady.png", dpi=150)
    text = (
        "# Steady swimming\n\n`python -m benchmarks.steady`: the default robot without inertia.\n\n"
        f"{markdown(pd.DataFrame(default), FORMATS)}\n"
        f"Pitch / radius = 5 loses its stability at {limit.value:.4f} rpm.\n"
    )
    (arguments.output / "steady.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
