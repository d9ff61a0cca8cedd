"""How two flagella bundle, for the pitches and motor rates of the paper.

    python -m benchmarks.bundling [-o docs/figures] [--runs runs/bundling] [--end 60] [--step 1e-2]

Runs the two-flagella robot for pitch / radius = 5, 7 and 9 at 30 to 70 rpm, with `derjax
simulate`; runs that are there already are not made again. Writes

- bundling_series.csv and bundling_series.png: bundled part and smallest distance against time;
- bundling.csv, bundling.md and bundling.png: speed, head rate, force and efficiency against the
  motor's rate, and whether they stand in the order that Lim, Yadunandan & Jawed (Soft Matter
  19, 2254, 2023) report.
"""

import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import xarray as xr

from derjax.runs.simulation import SUMMARY, TRAJECTORY, Options, simulate
from derjax.scenes.file import SceneFile

from .command import command_line

RADIUS = 6.36e-3
"""m, in which the paper counts pitches."""

RATIOS = (5, 7, 9)
RATES = (30, 40, 50, 60, 70)
COLOURS = {5: "#c1503a", 7: "#1f5a82", 9: "#5b8c3a"}
DIAMETER = 2 * SceneFile().robot.rod_radius

COLUMNS = {
    "v_x (mm/s)": ("v_x_m_per_s", 1e3),
    "head rate (rad/s)": ("head_rate_rad_per_s", 1.0),
    "force per flagellum (mN)": ("propulsive_force_per_flagellum_N", 1e3),
    "efficiency": ("efficiency", 1.0),
    "bundled part (%)": ("bundle_fraction", 100.0),
    "linking number": ("linking_number", 1.0),
    "smallest distance (2 r_0)": ("minimum_distance_m", 1 / DIAMETER),
    "contact force (mN)": ("contact_force_N", 1e3),
    "Newton iterations": ("newton_iterations", 1.0),
}

CLAIMS = {
    "head rate highest at 7": ("head rate (rad/s)", max, 7),
    "speed lowest at 7": ("v_x (mm/s)", min, 7),
    "force per flagellum highest at 5": ("force per flagellum (mN)", max, 5),
    "force per flagellum lowest at 7": ("force per flagellum (mN)", min, 7),
    "efficiency highest at 7": ("efficiency", max, 7),
    "efficiency lowest at 5": ("efficiency", min, 5),
}
"""What the paper says of two flagella, as column, which extreme, and at which ratio."""


def scene(ratio: int, rpm: int, step: float, end: float) -> str:
    """A scene file."""
    return f"""# Two flagella, pitch / radius = {ratio}, {rpm} rpm.
[robot]
kind = "two_flagella"
pitch = {round(ratio * RADIUS, 4)}

[motor]
rpm = {rpm}

[time]
step = {step}
end = {end}
"""


def run(directory: Path, text: str) -> tuple[dict, xr.Dataset]:
    """Summary and trajectory of a scene; simulates it unless that has been done."""
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / "scene.toml"
    done = (directory / SUMMARY).exists() and path.exists() and path.read_text() == text
    if not done:
        path.write_text(text)
        code = simulate(Options(path, directory, overwrite=True))
        if code:
            raise SystemExit(code)
    summary = json.loads((directory / SUMMARY).read_text())
    with xr.open_dataset(directory / TRAJECTORY, engine="h5netcdf") as trajectory:
        return summary, trajectory.load()


def row(ratio: int, rpm: int, summary: dict) -> dict[str, float]:
    """What is compared, of one run; speeds, forces and rates as magnitudes."""
    values = {name: scale * summary[key] for name, (key, scale) in COLUMNS.items()}
    values["Newton iterations"] /= summary["steps"]
    for name in ("v_x (mm/s)", "head rate (rad/s)", "force per flagellum (mN)"):
        values[name] = abs(values[name])
    return {"pitch / radius": ratio, "rpm": rpm, **values, "status": summary["status"]}


def claims(table: pd.DataFrame) -> pd.DataFrame:
    """For every claim and motor rate whether it holds, with the values at the three pitches."""
    rows = []
    for claim, (column, extreme, ratio) in CLAIMS.items():
        values = table.pivot(index="rpm", columns="pitch / radius", values=column)
        holds = {rpm: extreme(at.index, key=at.get) == ratio for rpm, at in values.iterrows()}
        rows.append({"claim": claim, **{f"{rpm} rpm": _word(yes) for rpm, yes in holds.items()}})
    return pd.DataFrame(rows)


def _word(holds: bool) -> str:
    return "yes" if holds else "no"


def series(trajectory: xr.Dataset, ratio: int, rpm: int) -> pd.DataFrame:
    """Bundled part, turns, distance and force against time."""
    return pd.DataFrame(
        {
            "pitch / radius": ratio,
            "rpm": rpm,
            "time (s)": trajectory.time,
            "bundled part": trajectory.bundle_fraction,
            "linking number": trajectory.linking_number,
            "smallest distance (2 r_0)": trajectory.minimum_distance / DIAMETER,
            "contact force (N)": trajectory.contact_force,
        }
    )


def draw_series(table: pd.DataFrame) -> plt.Figure:
    """Bundled part and smallest distance against time, a column for each pitch."""
    figure, axes = plt.subplots(
        2, len(RATIOS), figsize=(10, 5.2), sharex=True, sharey="row", layout="constrained"
    )
    shades = plt.get_cmap("viridis")(np.linspace(0.05, 0.85, len(RATES)))
    for (ratio, rpm), part in table.groupby(["pitch / radius", "rpm"]):
        column, colour = RATIOS.index(ratio), shades[RATES.index(rpm)]
        time = part["time (s)"]
        label = f"{rpm} rpm"
        bundled = part["bundled part"].rolling(20, center=True, min_periods=1).mean()
        axes[0, column].plot(time, 100 * bundled, color=colour, lw=1, label=label)
        axes[1, column].plot(time, part["smallest distance (2 r_0)"], color=colour, lw=1)
    for column, ratio in enumerate(RATIOS):
        axes[0, column].set_title(f"pitch / radius = {ratio}", loc="left")
        axes[1, column].axhline(1, color="black", lw=0.8, ls="--")
        axes[1, column].set_xlabel("time (s)")
    axes[0, 0].set_ylabel("bundled part (%), mean of 2 s")
    axes[0, 0].set_ylim(0, None)
    axes[1, 0].set_ylabel("smallest distance / diameter")
    axes[1, 0].set_ylim(0, None)
    axes[0, 1].legend(frameon=False, fontsize="small", loc="lower right")
    return figure


def draw(table: pd.DataFrame) -> plt.Figure:
    """Speed, head rate, force and efficiency against the motor's rate."""
    names = list(COLUMNS)[:4]
    figure, axes = plt.subplots(2, 2, figsize=(7.6, 5.6), sharex=True, layout="constrained")
    for ax, name in zip(axes.flat, names, strict=True):
        for ratio, part in table.groupby("pitch / radius"):
            ax.plot(part["rpm"], part[name], "o-", color=COLOURS[ratio], label=f"{ratio}")
        ax.set_ylabel(name)
        ax.set_ylim(0, None)
        ax.grid(alpha=0.25)
    for ax in axes[1]:
        ax.set_xlabel("motor (rpm)")
    axes[0, 0].legend(title="pitch / radius", frameon=False)
    return figure


def markdown(table: pd.DataFrame) -> str:
    """A table in Markdown."""
    cells = [[f"{v:.4g}" if isinstance(v, float) else str(v) for v in row] for row in table.values]
    rows = [list(table.columns), ["---"] * len(table.columns), *cells]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--runs", type=Path, default=Path("runs/bundling"))
    parser.add_argument("--end", type=float, default=60.0)
    parser.add_argument("--step", type=float, default=1e-2)
    parser.add_argument("--rpm", type=int, nargs="+", default=list(RATES))
    args = parser.parse_args()
    rows, curves = [], []
    for rpm in args.rpm:
        for ratio in RATIOS:
            name = f"ratio{ratio}_rpm{rpm}"
            summary, trajectory = run(args.runs / name, scene(ratio, rpm, args.step, args.end))
            rows.append(row(ratio, rpm, summary))
            curves.append(series(trajectory, ratio, rpm))
    table = pd.DataFrame(rows).sort_values(["pitch / radius", "rpm"])
    table.to_csv(args.output / "bundling.csv", index=False, float_format="%.6g")
    pd.concat(curves).to_csv(args.output / "bundling_series.csv", index=False, float_format="%.5g")
    verdicts = claims(table)
    text = f"{markdown(table)}\n{markdown(verdicts)}"
    (args.output / "bundling.md").write_text(text, encoding="utf-8")
    draw(table).savefig(args.output / "bundling.png", dpi=160)
    draw_series(pd.concat(curves)).savefig(args.output / "bundling_series.png", dpi=160)
    print(text)


if __name__ == "__main__":
    main()
