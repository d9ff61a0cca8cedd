"""Errors of runs, and tables of them."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd
from scipy.interpolate import CubicSpline

from derjax.scenes.file import SceneFile

from .runs import Runs
from .settings import CASES, EXPLICIT, FINEST_MESH, MESH_TOLERANCE, Setting, default, reference

NOISE = 1e-3
"""Difference between meshes that is not clear of what the error in time may make of it."""

ENOUGH = 0.005
"""Error in speed and head rate that a user will put up with."""

GOAL = 0.06
"""Seconds for a simulated second that the default may take."""

ASYMPTOTIC = 1 / 75
"""s, longest step from which orders are fitted."""

QUANTITIES = {
    "v_x": "error of $v_x$",
    "head rate": "error of head rate",
    "nodes": "RMS of nodes / R",
}


def row(runs: Runs, setting: Setting) -> dict[str, Any]:
    """A run with its errors."""
    run = runs[setting]
    numbers = dict(run.numbers)
    seconds = min(numbers.pop("seconds"))
    return {
        **numbers,
        "name": setting.name,
        "stepping": "fixed" if setting.tolerance is None else "adaptive",
        "default": setting == default(setting.case, setting.drag, setting.mesh),
        "cost": seconds / CASES[setting.case]["end"],
        **_errors(runs, setting, setting.mesh, ""),
        **_errors(runs, setting, FINEST_MESH, "whole "),
    }


def _errors(runs: Runs, setting: Setting, mesh: float, which: str) -> dict[str, float]:
    """Of speed and head rate, relative, and of nodes, in helix radii."""
    run, finest = runs[setting], reference(setting.case, setting.drag, mesh)
    if finest not in runs or finest == setting or run.numbers["message"]:
        return {}
    exact = runs[finest]
    moved = exact.moved
    if len(exact.along) != len(run.along):
        moved = CubicSpline(exact.along, moved, axis=2)(run.along)
    square = np.sum((run.moved - moved) ** 2, axis=-1).mean(axis=(1, 2))
    radius = SceneFile().robot.helix_radius
    return {
        **{
            f"{which}error {name}": abs(run.numbers[name] / exact.numbers[name] - 1)
            for name in ("v_x", "head rate")
        },
        f"{which}error nodes": float(np.sqrt(square.mean())) / radius,
        f"{which}error nodes at end": float(np.sqrt(square[-1])) / radius,
    }


def slope(x: Iterable[float], y: Iterable[float]) -> float:
    """Of the straight line through the logarithms."""
    return float(np.polyfit(np.log(np.asarray(x)), np.log(np.asarray(y)), 1)[0])


def fitted(table: pd.DataFrame, fine: pd.DataFrame | None) -> pd.DataFrame:
    """Orders of convergence, and over which range they were fitted."""
    rows = []

    def add(what: str, quantity: str, x: pd.Series, y: pd.Series) -> None:
        if len(x) < 2 or not (y > 0).all():
            return
        span = f"{x.min():.3g} to {x.max():.3g}"
        rows.append({"of": what, "quantity": quantity, "range": span, "order": slope(x, y)})

    if fine is not None:
        for (drag, inertia, scheme), part in fine.groupby(
            ["drag", "inertia", "scheme"], sort=False
        ):
            part = part[part.step <= ASYMPTOTIC]
            what = f"{scheme}, {drag.upper()}{', inertia' if inertia else ', no inertia'}, one turn"
            add(f"step (s): {what}", "nodes", part.step, part["error nodes"])
    runs = table[(table.case == "single") & (table.stepping == "fixed") & (table.mesh == 5e-3)]
    runs = runs[(runs.step <= ASYMPTOTIC) & (runs.scheme != "explicit")]
    for (scheme, drag), part in runs.dropna(subset="error nodes").groupby(["scheme", "drag"]):
        for quantity in QUANTITIES:
            what = f"step (s): {scheme}, {drag.upper()}, 20 s from rest"
            add(what, quantity, part.step, part[f"error {quantity}"])
    meshes = table[(table.scheme == "euler") & (table.tolerance == MESH_TOLERANCE)]
    for drag, part in meshes[meshes.case == "single"].groupby("drag"):
        part = part.sort_values("edge")
        finest, rest = part.iloc[0], part.iloc[1:]
        for quantity in ("v_x", "head rate"):
            error = rest[quantity] / finest[quantity] - 1
            clear = error.abs() > NOISE
            if (np.sign(error[clear]) == np.sign(error[clear].iloc[-1])).all():
                what = f"edge (m): {drag.upper()}, 20 s from rest"
                add(what, quantity, rest.edge[clear], error[clear].abs())
    return pd.DataFrame(rows)


def by_mesh(table: pd.DataFrame) -> pd.DataFrame:
    """Speed and head rate on every mesh, with the same tolerance, and by how much they differ."""
    chosen = table[(table.scheme == "euler") & (table.tolerance == MESH_TOLERANCE)]
    chosen = chosen.sort_values(["case", "drag", "edge"])
    rows = []
    for (case, drag), part in chosen.groupby(["case", "drag"], sort=False):
        finest = part.iloc[0]
        for _, run in part.iterrows():
            rows.append(
                {
                    "robot": case,
                    "drag": drag.upper(),
                    "edge, mm": 1e3 * run.edge,
                    "v_x, mm/s": 1e3 * run.v_x,
                    "head rate, rad/s": run["head rate"],
                    "v_x, % off finest": 100 * (run.v_x / finest.v_x - 1),
                    "head rate, % off finest": 100 * (run["head rate"] / finest["head rate"] - 1),
                    "s per simulated s": run.cost,
                }
            )
    return pd.DataFrame(rows)


def across_meshes(table: pd.DataFrame) -> pd.DataFrame:
    """Whether a tolerance, or a step, that is good enough on one mesh is so on the others."""
    rows = []
    runs = table[(table.case == "single") & (table.scheme != "explicit")]
    runs = runs[runs["error v_x"].notna() | (runs.message != "")]
    runs = runs.fillna({"tolerance": 0.0})
    for (drag, scheme, tolerance), group in runs.groupby(["drag", "scheme", "tolerance"]):
        for step, part in group.groupby("step"):
            adaptive = tolerance > 0
            how = f"tolerance {tolerance:g}" if adaptive else f"steps of {1e3 * step:.3g} ms"
            row: dict[str, Any] = {"drag": str(drag).upper(), "setting": f"{scheme}, {how}"}
            for _, run in part.iterrows():
                mesh = f"{1e3 * run.mesh:g} mm"
                row[f"{mesh}: error, %"] = 100 * _worst(run)
                row[f"{mesh}: s"] = run.cost
            rows.append(row)
    return pd.DataFrame(rows)


COLUMNS = {
    "robot": "",
    "drag": "",
    "setting": "",
    "v_x error, %": ".3f",
    "head rate error, %": ".3f",
    "nodes, RMS / R": ".2g",
    "nodes at end / R": ".2g",
    "steps": "d",
    "iterations a step": ".2f",
    "s per simulated s": ".3g",
    "faster than explicit 0.1 ms": ".0f",
    "before: worst error, %": ".3f",
    "before: s": ".3g",
}


def chosen(table: pd.DataFrame, before: pd.DataFrame | None) -> pd.DataFrame:
    """The default, the explicit runs, and of every scheme the cheapest that is good enough.

    Beside these the same settings before, if that is given.
    """
    rows, earlier = [], None if before is None else before.set_index("name")
    for (case, drag), part in table[table.mesh == 5e-3].groupby(["case", "drag"], sort=False):
        good = (part[["error v_x", "error head rate"]] <= ENOUGH).all(axis=1)
        explicit = part[part.scheme == "explicit"]
        base = explicit.cost[np.isclose(explicit.step, EXPLICIT[0])]
        best = [
            ("cheapest within 0.5 %: ", some.cost.idxmin())
            for _, some in part[good & (part.scheme != "explicit")].groupby(["scheme", "stepping"])
        ]
        rest = [("", index) for index in explicit.index]
        for label, index in [("default: ", i) for i in part.index[part.default]] + best + rest:
            run = part.loc[index]
            how = "" if np.isnan(run.tolerance) else f"tolerance {run.tolerance:g}"
            shown = how or f"steps of {1e3 * run.step:.3g} ms"
            shown += f" ({run.message})" if run.message else ""
            then = {}
            if earlier is not None and run["name"] in earlier.index:
                old = earlier.loc[run["name"]]
                then = {"before: worst error, %": 100 * _worst(old), "before: s": old.cost}
            rows.append(
                {
                    "robot": case,
                    "drag": drag.upper(),
                    "setting": f"{label}{run.scheme}, {shown}",
                    "v_x error, %": 100 * run["error v_x"],
                    "head rate error, %": 100 * run["error head rate"],
                    "nodes, RMS / R": run["error nodes"],
                    "nodes at end / R": run["error nodes at end"],
                    "steps": int(run.steps),
                    "iterations a step": run.iterations / max(run.steps, 1),
                    "s per simulated s": np.nan if run.message else run.cost,
                    "faster than explicit 0.1 ms": np.nan
                    if base.empty or run.message
                    else base.iloc[0] / run.cost,
                    **then,
                }
            )
    return pd.DataFrame(rows)


def _worst(run: pd.Series) -> float:
    """Of the errors of speed and head rate."""
    return max(run["error v_x"], run["error head rate"])


def findings(table: pd.DataFrame, before: pd.DataFrame | None) -> str:
    """What was to be shown, in sentences."""
    lines = []
    single = table[(table.case == "single") & (table.mesh == 5e-3) & (table.drag == "rss")]
    ours = single[single.default].iloc[0]
    worst = _worst(ours)
    lines.append(
        f"The default (one flagellum, RSS, 20 s) takes {ours.cost:.3g} s for a simulated second, "
        f"{'within' if ours.cost <= GOAL else 'more than'} the goal of {GOAL:g} s, and is off by "
        f"{100 * worst:.2g} % in the worse of speed and head rate."
    )
    explicit = single[(single.scheme == "explicit") & np.isclose(single.step, EXPLICIT[0])]
    if len(explicit):
        ratio = explicit.cost.iloc[0] / ours.cost
        lines.append(f"It is {ratio:.0f} times as fast as explicit drag in steps of 0.1 ms.")
    failed = table[table.message != ""]
    if len(failed):
        names = ", ".join(sorted(failed.name))
        lines.append(f"Runs that failed, or blew up, and are in no figure: {names}.")
    if before is not None:
        lines += against(table, before)
    return " ".join(lines)


def against(table: pd.DataFrame, before: pd.DataFrame) -> list[str]:
    """What runs cost before, and which of them fail that did not, in sentences."""
    both = table.merge(before, on="name", suffixes=("", " before"))
    lines = []
    for (case, scheme), part in both.groupby(["case", "scheme"], sort=False):
        ran = part[(part.message == "") & (part["message before"] == "")]
        ratio = ran["cost before"] / ran.cost
        least, middle, most = np.quantile(ratio, (0.1, 0.5, 0.9))
        lines.append(
            f"{case}, {scheme}: {len(ran)} settings cost {middle:.2g} times as much before "
            f"(eight tenths of them from {least:.2g} to {most:.2g})."
        )
    new = both.name[(both.message != "") & (both["message before"] == "")]
    mended = both.name[(both.message == "") & (both["message before"] != "")]
    for what, names in (("fail that did not", new), ("do not fail that did", mended)):
        lines.append(f"Runs that {what}: {', '.join(sorted(names)) or 'none'}.")
    return lines
