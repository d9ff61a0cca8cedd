"""Errors against what they cost, drawn."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from .results import ASYMPTOTIC, ENOUGH, GOAL, QUANTITIES, slope
from .settings import MESHES

STYLES = {
    ("trbdf2", "fixed"): ("#0b3c5d", "o-"),
    ("trbdf2", "adaptive"): ("#328cc1", "s-"),
    ("euler", "fixed"): ("#8c4a1f", "o--"),
    ("euler", "adaptive"): ("#d9883b", "s--"),
    ("explicit", "fixed"): ("#5b8c3a", "^:"),
}


def curves(axes: plt.Axes, part: pd.DataFrame, before: pd.DataFrame | None, quantity: str) -> None:
    """Error against cost, a line for each way of stepping; what they cost before is grey."""
    column = f"error {quantity}"
    earlier = () if before is None else before.groupby(["scheme", "stepping"])
    for how, runs in earlier:
        runs = runs.dropna(subset=column).sort_values(["tolerance", "step"])
        line, label = STYLES[how][1], "before" if how == ("euler", "fixed") else None
        axes.plot(runs.cost, runs[column], line, color="0.75", ms=3, lw=0.9, label=label)
    for how, (colour, line) in STYLES.items():
        runs = part[(part.scheme == how[0]) & (part.stepping == how[1])].dropna(subset=column)
        runs = runs.sort_values("tolerance" if how[1] == "adaptive" else "step")
        label = f"{how[0]}, {'adaptive' if how[1] == 'adaptive' else 'steps of one length'}"
        label = "explicit drag" if how[0] == "explicit" else label
        axes.plot(runs.cost, runs[column], line, color=colour, ms=4, lw=1.2, label=label)
    ours = part[part.default].dropna(subset=column)
    axes.plot(ours.cost, ours[column], "*", color="#c1272d", ms=13, label="default", zorder=5)
    if quantity != "nodes":
        axes.axhline(ENOUGH, color="black", lw=0.8, ls=":")
    if "single" in set(part.case):
        axes.axvline(GOAL, color="0.6", lw=0.8, ls=":")
    axes.set(xscale="log", yscale="log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.25, which="major")


def draw(table: pd.DataFrame, before: pd.DataFrame | None, case: str) -> plt.Figure:
    """Error against cost on the mesh of 5 mm: a row for each quantity, a column for each drag."""

    def shown(runs: pd.DataFrame) -> pd.DataFrame:
        return runs[(runs.case == case) & (runs.mesh == 5e-3) & (runs.message == "")]

    part, earlier = shown(table), None if before is None else shown(before)
    drags = list(dict.fromkeys(part.drag))
    figure, axes = plt.subplots(
        len(QUANTITIES),
        len(drags),
        figsize=(4.6 * len(drags) + 0.6, 8.6),
        sharex=True,
        sharey="row",
        squeeze=False,
        layout="constrained",
    )
    for column, drag in enumerate(drags):
        axes[0, column].set_title({"rss": "Stokeslet segments", "rft": "local drag"}[drag])
        for line, (quantity, label) in enumerate(QUANTITIES.items()):
            then = None if earlier is None else earlier[earlier.drag == drag]
            curves(axes[line, column], part[part.drag == drag], then, quantity)
            if column == 0:
                axes[line, 0].set_ylabel(label)
        axes[-1, column].set_xlabel("processor seconds per simulated second")
    handles, names = axes[0, 0].get_legend_handles_labels()
    columns = 3 if len(drags) > 1 else 2
    figure.legend(handles, names, loc="outside lower center", ncols=columns, frameon=False)
    return figure


def draw_meshes(table: pd.DataFrame) -> plt.Figure:
    """Errors of the head rate against cost, a line for each mesh, in steps that adapt."""
    part = table[(table.case == "single") & (table.stepping == "adaptive") & (table.message == "")]
    rows = {"error head rate": "error in time", "whole error head rate": "whole error"}
    drags = list(dict.fromkeys(part.drag))
    figure, axes = plt.subplots(
        2,
        len(drags),
        figsize=(4.9 * len(drags), 7.0),
        sharex=True,
        sharey=True,
        squeeze=False,
        layout="constrained",
    )
    colours = plt.get_cmap("viridis")(np.linspace(0.1, 0.8, len(MESHES["single"])))
    for column, drag in enumerate(drags):
        axes[0, column].set_title({"rss": "Stokeslet segments", "rft": "local drag"}[drag])
        for panel, quantity in zip(axes[:, column], rows, strict=True):
            for mesh, colour in zip(MESHES["single"], colours, strict=True):
                for scheme, line in (("trbdf2", "o-"), ("euler", "s--")):
                    runs = part[(part.drag == drag) & (part.mesh == mesh)]
                    runs = runs[runs.scheme == scheme].sort_values("tolerance")
                    label = f"{scheme}, edges of {1e3 * mesh:g} mm"
                    error = runs[quantity]
                    panel.plot(runs.cost, error, line, ms=4, lw=1.2, color=colour, label=label)
                    ours = runs.default
                    panel.plot(runs.cost[ours], error[ours], "*", color="#c1272d", ms=12, zorder=5)
            panel.set(xscale="log", yscale="log")
            panel.axhline(ENOUGH, color="black", lw=0.8, ls=":")
            panel.grid(alpha=0.25)
        axes[1, column].set_xlabel("processor seconds per simulated second")
    for panel, label in zip(axes[:, 0], rows.values(), strict=True):
        panel.set_ylabel(f"{label}, head rate")
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False)
    return figure


def draw_orders(fine: pd.DataFrame) -> plt.Figure:
    """Error over one turn of the motor against the length of the steps."""
    count = fine.inertia.nunique()
    figure, axes = plt.subplots(
        1, count, figsize=(4.8 * count, 4.2), sharey=True, squeeze=False, layout="constrained"
    )
    for panel, (inertia, part) in zip(axes[0], fine.groupby("inertia", sort=False), strict=True):
        for (drag, scheme), runs in part.groupby(["drag", "scheme"], sort=False):
            colour = STYLES[scheme, "fixed" if drag == "rss" else "adaptive"][0]
            close = runs[runs.step <= ASYMPTOTIC]
            order = slope(close.step, close["error nodes"])
            label = f"{scheme}, {drag.upper()}: order {order:.2f}"
            line = "o-" if scheme == "trbdf2" else "s--"
            panel.plot(runs.step, runs["error nodes"], line, color=colour, ms=4, label=label)
        panel.axvspan(fine.step.min() * 0.9, ASYMPTOTIC * 1.05, color="0.94", zorder=0)
        panel.set(xscale="log", yscale="log", xlabel="step, s")
        panel.set_title("with inertia" if inertia else "without inertia")
        panel.legend(frameon=False, fontsize="small")
        panel.grid(alpha=0.25)
    axes[0, 0].set_ylabel("RMS of nodes / R after one turn")
    return figure
