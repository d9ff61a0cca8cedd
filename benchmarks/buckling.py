"""How fast a motor may turn before the flagellum of the robot buckles.

    python -m benchmarks.buckling [-o docs/figures] [--only VARIANT ...] [--workers 1] [--redraw]

The single-flagellum robot, its helix of radius r = 6.4 mm and pitch 5, 7 or 9 times 6.36 mm, is
turned from rest at a constant rate for 60 s. Over the last 20 s it measures L' / L'(0): the
distance from the head node to the tail node, relative to that at rest. Rates are given as
omega_bar = omega mu l^4 / EI, with l the axial length of the helix; 60 rpm is 80.6.

A run counts as *buckled* if the mean of L' / L'(0) over the last 20 s is below 0.97
(`BUCKLED_BELOW`): thrust stretches an unbuckled helix, so that its L' / L'(0) is above 1.
Above the threshold the length falls steeply, but without a jump, and close to it needs half a
minute to settle. A failed run counts neither as buckled nor as unbuckled.

Rates are 25 rpm apart; the interval between the slowest rate that buckles and the next slower
one that does not is then halved twice. Variants start from the brackets of an independent code
and halve them three times.

Thresholds of the paper: Lim, Yadunandan & Jawed, Soft Matter 19, 2254, 2023. Writes
buckling.csv (one row for each run), buckling.png and buckling.md (brackets).
"""

import math
import textwrap
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pandas as pd
from jaxtyping import Array, Float

import derjax
from derjax import RolloutStats, Scene, SceneFile, State
from derjax.integrate.frames import new_stats

from .command import command_line
from .parallel import in_parallel

PITCHES = (5, 7, 9)
RPM = (30.0, 50.0, *np.arange(75.0, 301.0, 25.0).tolist())
WIDE = np.arange(100.0, 451.0, 50.0).tolist()
"""rpm, where it is not known where to look."""
END, WINDOW = 60.0, 20.0
"""Length of a run, and of its last part, over which is averaged; s."""
STEPS_PER_CALL = 200
BUCKLED_BELOW = 0.97
OTHER_LIMITS = (0.99, 0.95)
"""To show what depends on it."""

PAPER = {5: 230.0, 7: 363.0}
"""Rates (omega_bar) at which the paper sees buckling; at pitch 9 r it sees none."""
INDEPENDENT = {5: (201.0, 269.0), 7: (336.0, 403.0)}
"""Fastest unbuckled and slowest buckled rate of an independent code; at pitch 9 r none."""
SEARCHED = {5: (150.0, 200.0), 7: (250.0, 300.0)}
"""The same in rpm: between these the variants look for buckling."""

DEFAULT = "default, step 10 ms"
PUBLISHED_HINGE = {"hinge": "published"}
INDEPENDENT_FLUID = {"end_nodes": "full", "drag_matrix": "lower_triangle"}
FINE = {"step": 5e-3}
VARIANTS: dict[str, dict] = {
    DEFAULT: {},
    "step 5 ms": {"time": FINE},
    "step 2.5 ms": {"time": {"step": 2.5e-3}},
    "published hinge": {"motor": PUBLISHED_HINGE},
    "published hinge, step 5 ms": {"motor": PUBLISHED_HINGE, "time": FINE},
    "published hinge, full end nodes, lower triangle, step 5 ms": {
        "motor": PUBLISHED_HINGE,
        "fluid": INDEPENDENT_FLUID,
        "time": FINE,
    },
}
for _eps in (0.167e-3, 2.64e-3):
    for _hinge in ("rigid", "published"):
        VARIANTS[f"eps {1e3 * _eps:g} mm, {_hinge} hinge, step 5 ms"] = {
            "motor": {"hinge": _hinge},
            "fluid": {"regularization": _eps},
            "time": FINE,
        }
COLOURS = {5: "#0072b2", 7: "#d55e00", 9: "#009e73"}
PLAIN = {"facecolor": "white", "edgecolor": "none"}
MARKERS = {5: "o", 7: "s", 9: "^"}


class Length(NamedTuple):
    """L' / L'(0) after every step of a run, and how the steps went."""

    time: np.ndarray
    ratio: np.ndarray
    report: RolloutStats


class Measured(NamedTuple):
    """L' / L'(0) in the window: mean, least, most, and by how much the mean changes in it."""

    mean: float
    min: float
    max: float
    drift: float
    status: str


class Bracket(NamedTuple):
    """Fastest unbuckled rate below the slowest buckled rate; None where there is no such run."""

    unbuckled: float | None
    buckled: float | None

    def __str__(self) -> str:
        if self.buckled is None:
            return "runs failed" if self.unbuckled is None else f"none up to {self.unbuckled:.0f}"
        if self.unbuckled is None:
            return f"below {self.buckled:.0f}"
        return f"{self.unbuckled:.0f} to {self.buckled:.0f}"


def robot(pitch_over_radius: float, **tables: dict) -> SceneFile:
    """The paper's robot, with some tables of its scene given."""
    time = {"step": 1e-2, "end": END} | tables.get("time", {})
    shape = {"pitch": pitch_over_radius * 6.36e-3}
    return SceneFile.model_validate({**tables, "robot": shape, "time": time})


def time_unit(scene: SceneFile) -> float:
    """mu l^4 / EI (s), with l the axial length of the helix."""
    size, material = scene.robot, scene.material
    bending = material.youngs_modulus * math.pi * size.rod_radius**4 / 4
    return scene.fluid.viscosity * size.axial_length**4 / bending


def omega_bar(scene: SceneFile, rpm: float) -> float:
    """The dimensionless rate of the motor."""
    return rpm * 2 * math.pi / 60 * time_unit(scene)


def head_to_tail(scene: Scene, q: Array) -> Float[Array, " t"]:
    """Distance (m) from the head node to the tail node."""
    nodes = derjax.positions(scene.rod.topology, q)
    return jnp.linalg.norm(nodes[..., -1, :] - nodes[..., 0, :], axis=-1)


@jax.jit
def _advance(scene: Scene, state: State, report: RolloutStats) -> tuple[State, Array, RolloutStats]:
    states, report = derjax.roll_frames(scene, state, STEPS_PER_CALL, 1, report)
    return jax.tree.map(lambda x: x[-1], states), head_to_tail(scene, states.q), report


def simulate(file: SceneFile, rpm: float) -> Length:
    """Run a scene at a motor rate, from rest; stops at the first step that fails."""
    built = derjax.build(file, {"rpm": rpm})
    state = built.start
    lengths = [np.atleast_1d(head_to_tail(built, state.q))]
    report, n_steps = new_stats(), file.n_steps
    for _ in range(0, n_steps, STEPS_PER_CALL):
        state, length, report = _advance(built, state, report)
        lengths.append(np.asarray(length))
        if not report.ok:
            break
    kept = 1 + min(int(report.steps), n_steps)
    ratio = np.concatenate(lengths)[:kept] / lengths[0]
    return Length(file.step * np.arange(kept), ratio, report)


def measure(run: Length) -> Measured:
    """The numbers of a run; of a failed one there are none, but the message of the solver."""
    if not run.report.ok:
        return Measured(math.nan, math.nan, math.nan, math.nan, run.report.message())
    late = run.ratio[run.time > run.time[-1] - WINDOW]
    first, second = np.array_split(late, 2)
    drift = float(second.mean() - first.mean())
    return Measured(float(late.mean()), float(late.min()), float(late.max()), drift, "ok")


def is_buckled(mean: float, limit: float = BUCKLED_BELOW) -> bool | None:
    """Whether a mean L' / L'(0) counts as buckled; None if the run failed."""
    return None if math.isnan(mean) else mean < limit


def bracket(points: Iterable[tuple[float, float]], limit: float = BUCKLED_BELOW) -> Bracket:
    """Where pairs of a rate and a mean L' / L'(0) go from unbuckled to buckled."""
    judged = [(rate, is_buckled(mean, limit)) for rate, mean in points]
    buckled = min((rate for rate, yes in judged if yes), default=None)
    below = math.inf if buckled is None else buckled
    unbuckled = max((rate for rate, yes in judged if yes is False and rate < below), default=None)
    return Bracket(unbuckled, buckled)


def refined(
    measured: Callable[[float], float], rates: Iterable[float], halvings: int
) -> list[tuple[float, float]]:
    """Points at some rates, and between them where it buckles, by halving the bracket."""
    points = [(rate, measured(rate)) for rate in rates]
    for _ in range(halvings):
        low, high = bracket(points)
        if low is None or high is None:
            break
        middle = 0.5 * (low + high)
        points.append((middle, measured(middle)))
    return points


def study(variant: str, ratio: int) -> list[dict]:
    """One row for each run of a variant at a pitch."""
    file = robot(ratio, **VARIANTS[variant])
    rows = []

    def measured(rpm: float) -> float:
        rate, found = omega_bar(file, rpm), measure(simulate(file, rpm))
        where = {"variant": variant, "pitch_over_radius": ratio, "omega_bar": rate, "rpm": rpm}
        rows.append(where | found._asdict())
        print(
            f"{variant}, pitch {ratio} r, omega_bar {rate:.1f}: L'/L'(0) = {found.mean:.4f} "
            f"({found.min:.4f} to {found.max:.4f}), {found.status}",
            flush=True,
        )
        return found.mean

    if variant == DEFAULT:
        refined(measured, RPM, halvings=2)
    elif "regularization" in VARIANTS[variant].get("fluid", {}):
        refined(measured, WIDE, halvings=3)
    else:
        refined(measured, SEARCHED[ratio], halvings=3)
    return sorted(rows, key=lambda row: row["rpm"])


def _named(case: tuple[str, int]) -> tuple[tuple[str, int], list[dict]]:
    return case, study(*case)


def cases(variants: Iterable[str]) -> list[tuple[str, int]]:
    """Variants and pitches to be run; the variants only where the independent code buckles."""
    return [(v, r) for v in variants for r in PITCHES if v == DEFAULT or r in SEARCHED]


def brackets(table: pd.DataFrame, limit: float = BUCKLED_BELOW) -> dict[tuple, Bracket]:
    """The bracket of every variant and pitch."""
    grouped = table.groupby(["variant", "pitch_over_radius"], sort=False)
    return {
        key: bracket(zip(rows["omega_bar"], rows["mean"], strict=True), limit)
        for key, rows in grouped
    }


def markdown(table: pd.DataFrame) -> str:
    """Brackets beside those of others, all runs at the default settings, and failed runs."""
    found = brackets(table)
    for limit in OTHER_LIMITS:
        name = f"{DEFAULT}, below {limit} instead"
        strict = brackets(table[table["variant"] == DEFAULT], limit)
        found |= {(name, ratio): interval for (_, ratio), interval in strict.items()}
    others = {r: Bracket(*INDEPENDENT.get(r, (403.0, None))) for r in PITCHES}
    lines = [
        "Where the flagellum buckles, in omega_bar: fastest rate without and slowest rate with a",
        f"mean L'/L'(0) below {BUCKLED_BELOW} over the last {WINDOW:.0f} s of {END:.0f} s.",
        "",
        "| settings | " + " | ".join(f"pitch {r} r" for r in PITCHES) + " |",
        "|---|" + "---|" * len(PITCHES),
        "| the paper | "
        + " | ".join(f"{PAPER[r]:.0f}" if r in PAPER else "none" for r in PITCHES)
        + " |",
        "| independent code | " + " | ".join(str(others[r]) for r in PITCHES) + " |",
    ]
    for variant in dict.fromkeys(variant for variant, _ in found):
        cells = [str(found.get((variant, r), "")) for r in PITCHES]
        lines.append(f"| {variant} | " + " | ".join(cells) + " |")
    lines += [
        "",
        f"L'/L'(0) of the variant \"{DEFAULT}\": mean (least to most) over these seconds.",
        "",
    ]
    lines += ["| omega_bar | rpm | " + " | ".join(f"pitch {r} r" for r in PITCHES) + " |"]
    lines += ["|---|---|" + "---|" * len(PITCHES)]
    plain = table[table["variant"] == DEFAULT]
    for rpm, rows in plain.groupby("rpm"):
        by_pitch = {row["pitch_over_radius"]: row for row in rows.to_dict("records")}
        cells = [_cell(by_pitch.get(r)) for r in PITCHES]
        rate = rows["omega_bar"].iloc[0]
        lines.append(f"| {rate:.1f} | {rpm:g} | " + " | ".join(cells) + " |")
    failed = table[table["status"] != "ok"]
    lines += ["", f"Failed runs: {len(failed) or 'none'}."]
    lines += [
        f"- {row['variant']}, pitch {row['pitch_over_radius']} r, omega_bar "
        f"{row['omega_bar']:.1f}: {row['status']}"
        for row in failed.to_dict("records")
    ]
    return "\n".join(lines) + "\n"


def _cell(row: dict | None) -> str:
    if row is None:
        return ""
    if row["status"] != "ok":
        return "failed"
    mark = "**" if is_buckled(row["mean"]) else ""
    return f"{mark}{row['mean']:.3f}{mark} ({row['min']:.3f} to {row['max']:.3f})"


def figure(table: pd.DataFrame, path: Path) -> None:
    """L' / L'(0) over the rate, and the brackets of all settings."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    fig, (curves, bars) = plt.subplots(
        1, 2, figsize=(11, 5.2), width_ratios=(1.3, 1), layout="constrained"
    )
    for ratio in PITCHES:
        _curve(curves, table, ratio)
    curves.axhline(BUCKLED_BELOW, color="0.55", lw=0.8, ls=":")
    curves.text(
        28, BUCKLED_BELOW - 0.012, "below: counts as buckled", color="0.4", fontsize=8, va="top"
    )
    curves.set(
        xlabel=r"motor rate  $\bar\omega = \omega\mu l^4 / EI$", xlim=(20, 425), ylim=(0.15, 1.1)
    )
    curves.set_ylabel(r"head to tail  $L'/L'(0)$")
    curves.legend(frameon=False, loc="lower left", title="pitch / helix radius")
    curves.set_title(
        "dashed: the paper's thresholds; shaded: brackets of an independent code (9: none)",
        fontsize=9,
    )
    _bars(bars, brackets(table))
    for axis in (curves, bars):
        axis.spines[["top", "right"]].set_visible(False)
    fig.savefig(path, dpi=160)
    plt.close(fig)


def _curve(axis, table: pd.DataFrame, ratio: int) -> None:
    """One pitch: mean, range, and what others have found."""
    colour = COLOURS[ratio]
    if ratio in PAPER:
        axis.axvspan(*INDEPENDENT[ratio], color=colour, alpha=0.1, lw=0)
        axis.axvline(PAPER[ratio], color=colour, ls="--", lw=1.2)
    rows = table[(table["variant"] == DEFAULT) & (table["pitch_over_radius"] == ratio)]
    rows = rows.sort_values("omega_bar").dropna(subset="mean")
    axis.fill_between(rows["omega_bar"], rows["min"], rows["max"], color=colour, alpha=0.25, lw=0)
    axis.plot(
        rows["omega_bar"], rows["mean"], color=colour, marker=MARKERS[ratio], ms=4.5, label=ratio
    )


def _bars(axis, found: dict[tuple[str, int], Bracket]) -> None:
    """Brackets of every variant as bars, beside those of the paper and the independent code."""
    names = ["independent code", *dict.fromkeys(variant for variant, _ in found)]
    others = {("independent code", r): Bracket(*ends) for r, ends in INDEPENDENT.items()}
    for (name, ratio), (low, high) in {**others, **found}.items():
        if low is not None and high is not None:
            shade = 0.35 if (name, ratio) in others else 1.0
            place = {"left": low, "height": 0.45, "color": COLOURS[ratio], "alpha": shade}
            axis.barh(names.index(name), high - low, **place)
        elif low is None and high is None:
            where = {"x": PAPER[ratio], "y": names.index(name), "color": COLOURS[ratio]}
            axis.text(s="runs failed", ha="center", va="center", fontsize=9, bbox=PLAIN, **where)
    for ratio, rate in PAPER.items():
        axis.axvline(rate, color=COLOURS[ratio], ls="--", lw=1.2)
    axis.set_yticks(range(len(names)), [textwrap.fill(name, 34) for name in names], fontsize=7.5)
    axis.invert_yaxis()
    axis.set(xlabel=r"buckles between these $\bar\omega$", xlim=(180, 480))
    axis.tick_params(axis="y", length=0)


def write(table: pd.DataFrame, directory: Path) -> None:
    """buckling.csv, .md and .png."""
    table.to_csv(directory / "buckling.csv", index=False, float_format="%.6g")
    (directory / "buckling.md").write_text(markdown(table), encoding="utf-8")
    figure(table, directory / "buckling.png")


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--redraw", action="store_true", help="from buckling.csv, no simulation")
    options = parser.parse_args()
    if options.redraw:
        write(pd.read_csv(options.output / "buckling.csv"), options.output)
        return
    wanted, found = cases(options.only), {}
    for case, rows in in_parallel(_named, wanted, options.workers):
        found[case] = rows
        table = pd.DataFrame([row for case in wanted for row in found.get(case, [])])
        write(table, options.output)
    print(markdown(table))


if __name__ == "__main__":
    main()
