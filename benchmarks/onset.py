"""What the buckling of a swimming robot is: steady swimming that loses its stability.

    python -m benchmarks.onset [-o docs/figures] [--workers 1] [--only threshold ramp ladder]

Three looks at the robot with a helix of pitch 5, 7 or 9 times 6.36 mm, over the motor's rate
omega_bar = omega mu l^4 / EI:

* *threshold*: where the leading mode of the steady state begins to grow, for several radii of
  regularization (`derjax.threshold`);
* *ramp*: the motor becomes faster little by little, from 0.85 times that rate, and L' / L'(0), the
  distance from head to tail over that at rest, is watched: where it falls below 0.97 is what an
  experiment or a simulation calls buckling;
* *ladder*: the motor turns for 200 s at each of several rates around the threshold, up and then
  down again. How much shorter the flagellum is than the steady state, on average over the last
  60 s, says whether it goes away from that little by little (supercritical), or jumps and stays
  away on the way down (subcritical).

Without inertia, in steps of 10 ms of second order. Writes onset.csv, .md and .png; with `--only`
the other rows of onset.csv stay. Thresholds of the paper: Lim, Yadunandan & Jawed, Soft Matter 19,
2254, 2023.
"""

import math
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pandas as pd

import derjax as dj
from derjax.core.pytree import replace
from derjax.integrate.motor import Motor

from .buckling import BUCKLED_BELOW, COLOURS, PAPER, omega_bar, robot
from .command import command_line
from .parallel import in_parallel
from .tables import markdown

PITCHES = (5, 7, 9)
REGULARIZATIONS = (0.167e-3, 0.5e-3, 1.0e-3, 1.67e-3, 2.64e-3)
"""m; from the paper's value to 1.65 times the radius of the rod."""
DEFAULT = 1.67e-3
RATES = np.arange(20.0, 521.0, 20.0)
"""rpm, at which growth is looked at until it is positive."""

RAMPS = (2.0, 1.0, 0.5, 0.25, 0.125)
"""rpm/s."""
BEGIN, END = 0.85, 1.5
"""Of a ramp, over the threshold."""

LADDER = {"up": (0.98, 1.02, 1.04, 1.06, 1.1), "down": (1.06, 1.04, 1.02, 1.01, 1.0, 0.98)}
"""Rates, over the threshold, one after the other."""
STAY, WATCHED, FRAME = 200.0, 60.0, 0.1
"""s at each rate, the last part of them that counts, and of a frame."""
STEP = {"inertia": False, "scheme": "trbdf2", "step": 1e-2, "end": STAY}
UNIT = omega_bar(robot(5), 1.0)
"""omega_bar at 1 rpm; it does not depend on the pitch."""


def scene(pitch: int, rpm: float, regularization: float = DEFAULT) -> dj.Scene:
    file = robot(pitch, time=STEP, fluid={"regularization": regularization})
    return dj.build(file, {"rpm": rpm})


def limit(pitch: int, regularization: float = DEFAULT) -> tuple[float, float]:
    """The rate (rpm) at which the leading mode begins to grow, and the last that was looked at.

    The first is not a number if no mode grows up to the second.
    """
    known, tried = None, math.nan
    for rpm in RATES:
        state = dj.steady(scene(pitch, rpm, regularization), known)
        if not state.ok:
            break
        known, tried = state, float(rpm)
        if dj.stability(state).growth_rate > 0.0:
            return dj.threshold(state.scene, "rpm", tried).value, tried
    return math.nan, tried


def threshold(pitch: int, regularization: float) -> list[dict]:
    """A row with the threshold of a robot."""
    rpm, tried = limit(pitch, regularization)
    return [{"regularization_m": regularization, "rpm": rpm, "up_to_rpm": tried}]


def length(x: np.ndarray) -> np.ndarray:
    """m, from head to tail."""
    return np.linalg.norm(x[..., -1, :] - x[..., 0, :], axis=-1)


def ramp(pitch: int, speed: float) -> list[dict]:
    """A row with the rate at which L' / L'(0) falls below the limit as the motor becomes faster."""
    at = limit(pitch)[0]
    low, high = BEGIN * at, END * at
    end = float(math.ceil((high - low) / speed))
    first = scene(pitch, low)
    rates = jnp.array([[low], [low + speed * end]]) * (2 * jnp.pi / 60)
    steady = dj.steady(first)
    steady.raise_if_failed()
    ramped = replace(first, motor=Motor(jnp.array([0.0, end]), rates))
    run = dj.rollout(ramped, end, frame=FRAME, state=_near(steady, pitch, low), reverse_mode=False)
    run.raise_if_failed()
    start = np.asarray(dj.positions(first.rod.topology, first.start.q))
    ratio = length(np.asarray(run.positions)) / length(start)
    below = np.flatnonzero(ratio < BUCKLED_BELOW)
    when = float(run.time[below[0]]) if len(below) else math.nan
    return [{"rpm_per_s": speed, "rpm": low + speed * when, "up_to_rpm": low + speed * end}]


def _near(steady: dj.Steady, pitch: int, rpm: float) -> dj.State:
    """The steady state at a rate that is 1 % slower: a small disturbance of this one."""
    other = dj.steady(scene(pitch, 0.99 * rpm), steady)
    other.raise_if_failed()
    return other.state


def ladder(pitch: int, _: float) -> list[dict]:
    """Rows: the mean L' over that of the steady state at each rate, up and down."""
    at = limit(pitch)[0]
    rows, state, known = [], None, None
    for way, parts in LADDER.items():
        for part in parts:
            known = dj.steady(scene(pitch, part * at), known)
            known.raise_if_failed()
            state = _near(known, pitch, part * at) if state is None else state
            run = dj.rollout(known.scene, STAY, frame=FRAME, state=state, reverse_mode=False)
            run.raise_if_failed()
            late = np.asarray(run.positions)[np.asarray(run.time) > STAY - WATCHED]
            ratio = length(late) / float(known.tail_to_head)
            first, second = np.array_split(ratio, 2)
            change = float(second.mean() - first.mean())
            where = {"way": way, "part": part, "rpm": part * at}
            rows.append(where | {"ratio": float(ratio.mean()), "drift": change})
            state = replace(run.last, time=jnp.zeros(()))
    return rows


STUDIES: dict[str, Callable[[int, float], list[dict]]] = {
    "ladder": ladder,
    "ramp": ramp,
    "threshold": threshold,
}
"""The longest first."""
CASES = {
    "ladder": [(pitch, 0.0) for pitch in PAPER],
    "ramp": [(pitch, speed) for pitch in PAPER for speed in reversed(RAMPS)],
    "threshold": [(pitch, eps) for pitch in PITCHES for eps in REGULARIZATIONS],
}


COLUMNS = (
    *("study", "pitch_over_radius", "regularization_m", "rpm_per_s", "way", "part"),
    *("rpm", "up_to_rpm", "ratio", "drift"),
)


def study(case: tuple[str, int, float]) -> list[dict]:
    """The rows of one case."""
    name, pitch, number = case
    rows = STUDIES[name](pitch, number)
    return [{"study": name, "pitch_over_radius": pitch} | row for row in rows]


def text(table: pd.DataFrame) -> str:
    """What is in the table, to be read."""
    return (
        "# Where steady swimming loses its stability\n\n"
        "`python -m benchmarks.onset`. Rates are omega_bar; the paper reports buckling at 230 "
        "(pitch over radius 5), 363 (7) and none (9).\n\n"
        "Where the leading mode of the steady state begins to grow, over the radius of "
        f"regularization:\n\n{_thresholds(table)}\n"
        f"Where L'/L'(0) falls below {BUCKLED_BELOW} as the motor becomes faster:\n\n"
        f"{_ramps(table)}\n"
        "L' over that of the steady state, after 200 s at each rate (over the threshold), "
        f"with the rate going up and down:\n\n{_ladders(table)}"
    )


def _thresholds(table: pd.DataFrame) -> str:
    rows = []
    for eps, of_one in table[table["study"] == "threshold"].groupby("regularization_m"):
        row: dict[str, object] = {"regularization (mm)": 1e3 * float(str(eps))}
        for each in of_one.to_dict("records"):
            known = not math.isnan(each["rpm"])
            row[f"pitch {each['pitch_over_radius']} r"] = (
                f"{UNIT * each['rpm']:.1f}"
                if known
                else f"none up to {UNIT * each['up_to_rpm']:.0f}"
            )
        rows.append(row)
    formats = {"regularization (mm)": ".3g"} | {f"pitch {p} r": "" for p in PITCHES}
    return markdown(pd.DataFrame(rows), formats)


def _ramps(table: pd.DataFrame) -> str:
    rows = []
    for speed, of_one in table[table["study"] == "ramp"].groupby("rpm_per_s"):
        row: dict[str, object] = {"rpm/s": speed}
        for each in of_one.to_dict("records"):
            row[f"pitch {each['pitch_over_radius']} r"] = UNIT * each["rpm"]
        rows.append(row)
    return markdown(pd.DataFrame(rows), {"rpm/s": "g"} | {f"pitch {p} r": ".1f" for p in PAPER})


def _ladders(table: pd.DataFrame) -> str:
    rows = table[table["study"] == "ladder"]
    wide = rows.pivot_table("ratio", "part", ["pitch_over_radius", "way"], sort=True)
    wide.columns = [f"pitch {pitch:g} r, {way}" for pitch, way in wide.columns]
    return markdown(wide.reset_index(), {"part": "g"} | dict.fromkeys(wide.columns, ".4f"))


def figure(table: pd.DataFrame, path: Path) -> None:
    """Thresholds, ramps and ladders side by side."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    fig, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for (name, pitch), rows in table.groupby(["study", "pitch_over_radius"]):
        style = {"color": COLOURS[int(str(pitch))], "label": f"{pitch}", "marker": "o", "ms": 4}
        if name == "threshold":
            left.plot(1e3 * rows["regularization_m"], UNIT * rows["rpm"], **style)
        elif name == "ramp":
            middle.semilogx(rows["rpm_per_s"], UNIT * rows["rpm"], **style)
        else:
            up, down = (rows[rows["way"] == way] for way in ("up", "down"))
            right.plot(up["part"], up["ratio"], **style)
            right.plot(down["part"], down["ratio"], color=style["color"], ls=":", marker="x")
    for pitch, rate in PAPER.items():
        for axis in (left, middle):
            axis.axhline(rate, color=COLOURS[pitch], ls="--", lw=1)
        rows = table[(table["study"] == "threshold") & (table["pitch_over_radius"] == pitch)]
        known = rows[np.isclose(rows["regularization_m"], DEFAULT)]["rpm"]
        middle.axhline(UNIT * known.iloc[0], color=COLOURS[pitch], ls="-", lw=0.8)
    middle.set_xticks(RAMPS, [f"{speed:g}" for speed in RAMPS])
    middle.minorticks_off()
    left.set(xlabel="regularization, mm", ylabel=r"threshold  $\bar\omega$")
    left.set_title("where the leading mode begins to grow\n(dashed: the paper)", fontsize=9)
    middle.set(
        xlabel="how fast the motor becomes faster, rpm/s", ylabel=r"buckles at  $\bar\omega$"
    )
    middle.set_title("in ramps (lines: thresholds; dashed: the paper)", fontsize=9)
    right.set(xlabel="rate over the threshold", ylabel="L' over that of the steady state")
    right.set_title("200 s at each rate: up (dots) and down (crosses)", fontsize=9)
    for axis in (left, middle, right):
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(frameon=False, title="pitch / radius", fontsize=8, title_fontsize=8)
    fig.savefig(path, dpi=160)
    plt.close(fig)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--only", nargs="+", choices=list(STUDIES), default=list(STUDIES))
    parser.add_argument("--redraw", action="store_true", help="from onset.csv, no simulation")
    options = parser.parse_args()
    path = options.output / "onset.csv"
    only = [] if options.redraw else options.only
    kept = pd.read_csv(path) if path.exists() else pd.DataFrame({"study": []})
    rows = kept[~kept["study"].isin(only)].to_dict("records")
    cases = [(name, *case) for name in only for case in CASES[name]]
    for found in in_parallel(study, cases, options.workers):
        rows += found
        # What has been found so far is kept.
        pd.DataFrame(rows).to_csv(path, index=False, float_format="%.6g")
    table = pd.DataFrame(rows).reindex(columns=COLUMNS)
    table = table.sort_values(["study", "pitch_over_radius", "regularization_m", "rpm_per_s"])
    table.to_csv(path, index=False, float_format="%.6g")
    (options.output / "onset.md").write_text(text(table), encoding="utf-8")
    figure(table, options.output / "onset.png")
    print(text(table))


if __name__ == "__main__":
    main()
