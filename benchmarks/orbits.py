"""Periodic orbits of two flagella, against waiting for them.

    python -m benchmarks.orbits [-o docs/figures] [--turns 60]

The default robot with two flagella, in antiphase, at 60 rpm, pitch over radius 9, 7 and 5, in steps
of 20 ms of implicit Euler, without inertia: the orbit that four turns from rest lead to, and a
simulation of 60 turns. What changes from one turn to the next, beside a rigid motion, goes as the
largest Floquet multiplier of what is excited says. At 5 one is larger than one: the simulation
leaves that orbit and ends in another one, which is found from its end. Times are processor time,
once compiled.
Writes orbits.csv, .md and .png.
"""

import time
from collections.abc import Callable
from itertools import pairwise
from typing import TypeVar

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import derjax as dj
from derjax.steady.turn import fitted

from .command import command_line
from .tables import write

RADIUS, PITCHES, STEPS = 6.36e-3, (9, 7, 5), 50

LEAVES = 1.1
"""A multiplier with which rounding becomes a motion in 60 turns."""

T = TypeVar("T")


def scene_of(ratio: float, turns: int) -> dj.Scene:
    file = {
        "robot": {
            "kind": "two_flagella",
            "pitch": ratio * RADIUS,
            "helix_radius": RADIUS,
            "phase": [np.pi, 0.0],
        },
        "motor": {"rpm": 60.0},
        "time": {"inertia": False, "scheme": "euler", "step": 0.02, "end": float(turns)},
    }
    return dj.build(dj.SceneFile.from_dict(file))


def timed(program: Callable[[], T]) -> tuple[T, float]:
    """What a program gives the second time, and its processor time (s)."""
    program()
    began = time.process_time()
    return program(), time.process_time() - began


def changes(run: dj.Run) -> np.ndarray:
    """(turns,) m: the largest displacement of a node in each turn that is no rigid motion."""
    x = np.asarray(run.positions)
    found = []
    for before, after in pairwise(x):
        turn, shift = (np.asarray(a) for a in fitted(before, after))
        found.append(np.linalg.norm(before @ turn.T + shift - after, axis=1).max())
    return np.array(found)


def row(ratio: float, name: str, orbit: dj.Orbit, spent: float) -> dict[str, object]:
    force = np.abs(np.asarray(dj.forces(orbit.scene, orbit.state)["Contact"])).max()
    return {
        "pitch_over_radius": ratio,
        "orbit": name,
        "v_mm_per_s": 1e3 * orbit.speed,
        "head_rate_rad_per_s": orbit.head_rate,
        "contact_N": force,
        "multiplier": np.abs(orbit.multipliers(3)).max(),
        "turns": orbit.turns,
        "orbit_s": spent,
    }


def measure(ratio: float, turns: int) -> tuple[list[dict[str, object]], np.ndarray]:
    """Rows for the orbits, and how the simulation settles."""
    scene = scene_of(ratio, turns)
    orbit, spent = timed(lambda: dj.orbit(scene, steps=STEPS))
    rows = [row(ratio, "four turns from rest", orbit, spent)]
    run, waited = timed(lambda: dj.rollout(orbit.scene, frame=1.0, reverse_mode=False))
    if float(str(rows[0]["multiplier"])) > LEAVES:
        orbit, spent = timed(lambda: dj.orbit(orbit.scene, run.last, steps=STEPS))
        rows.append(row(ratio, "end of the simulation", orbit, spent))
    x, angle = np.asarray(run.positions), np.asarray(run.head_angle)
    turn, shift = (np.asarray(a) for a in fitted(x[-2], x[-1]))
    axis = np.linalg.svd(turn - np.eye(3))[2][-1]
    rows[-1] |= {
        "simulated_v_mm_per_s": 1e3 * abs(shift @ axis),
        "simulated_head_rate_rad_per_s": angle[-1] - angle[-2],
        "simulation_s": waited,
    }
    print(*rows, sep="\n", flush=True)
    return rows, changes(run)


def figure(table: pd.DataFrame, settling: dict[float, np.ndarray]) -> plt.Figure:
    """What changes from turn to turn, with the slopes of the multipliers."""
    fig, axes = plt.subplots(figsize=(7, 4.2))
    for number, (ratio, change) in enumerate(settling.items()):
        colour = f"C{number}"
        axes.semilogy(1 + np.arange(len(change)), change, "o-", ms=3, color=colour)
        axes.plot([], [], "o-", ms=3, color=colour, label=f"pitch / radius = {ratio}")
        sizes = table[table["pitch_over_radius"] == ratio]["multiplier"]
        if sizes.iloc[0] < LEAVES:
            continue  # what breaks the symmetry of the start is not excited
        for size, part in zip(sizes, (0.6, 0.92), strict=True):
            at = int(part * len(change))
            span = np.array([-5.0, 4.0])
            axes.plot(at + span, 4.0 * change[at] * size**span, "--", color="k", lw=1.2)
    axes.plot([], [], "k--", lw=1.2, label="slopes of its largest Floquet multipliers")
    axes.set(xlabel="turn of the motors", ylabel="change in a turn, m")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    fig.tight_layout()
    return fig


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--turns", type=int, default=60)
    arguments = parser.parse_args()
    rows, settling = [], {}
    for ratio in PITCHES:
        found, settling[ratio] = measure(ratio, arguments.turns)
        rows += found
    table = pd.DataFrame(rows)
    formats = {
        "pitch_over_radius": "d",
        "orbit": "",
        "v_mm_per_s": ".5f",
        "simulated_v_mm_per_s": ".5f",
        "head_rate_rad_per_s": ".5f",
        "simulated_head_rate_rad_per_s": ".5f",
        "contact_N": ".2g",
        "multiplier": ".3f",
        "turns": "d",
        "orbit_s": ".1f",
        "simulation_s": ".1f",
    }
    write(table, arguments.output / "orbits.csv", formats)
    figure(table, settling).savefig(arguments.output / "orbits.png", dpi=150)
    print((arguments.output / "orbits.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
