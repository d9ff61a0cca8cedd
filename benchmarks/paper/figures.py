"""The figures of the study."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from .claims import ETA, FORCE, SPIN, V
from .runs import Result

COLOURS = {5: "#c1503a", 7: "#1f5a82", 9: "#5b8c3a"}
STYLES = {"in phase": "o-", "antiphase": "s--"}


def pairs(table: pd.DataFrame) -> plt.Figure:
    """Speed, head rate, force, efficiency and bundle against the rate of the motors."""
    panels = {
        V: ("speed (mm/s)", 1e3),
        SPIN: ("head rate (rad/s)", 1.0),
        FORCE: ("force per flagellum (mN)", 1e3),
        ETA: ("efficiency", 1.0),
        "bundle_fraction": ("bundled part (%)", 100.0),
        "linking_number": ("linking number", 1.0),
    }
    fig, axes = plt.subplots(2, 3, figsize=(10, 5.6), sharex=True, layout="constrained")
    for ax, (column, (label, scale)) in zip(axes.flat, panels.items(), strict=True):
        for (ratio, phase), part in table.groupby(["pitch/r", "phase"]):
            values = scale * part[column].abs()
            ax.plot(
                part["rpm"],
                values,
                STYLES[phase],
                color=COLOURS[ratio],
                fillstyle="full" if phase == "in phase" else "none",
                label=f"{ratio}, {phase}",
                ms=4,
            )
        ax.set(ylabel=label)
        ax.grid(alpha=0.25)
    for ax in axes[1]:
        ax.set_xlabel("motors (rpm)")
    axes[0, 0].legend(title="pitch / radius", fontsize=7, frameon=False)
    return fig


def tracks(results: dict[str, Result]) -> plt.Figure:
    """x and y of the head against time, pitch over radius 7, in phase."""
    fig, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for name, result in results.items():
        if name.startswith("pair-in-phase-7-"):
            rpm, series = result.numbers["rpm"], result.series
            for ax, axis in zip(axes, "xy", strict=True):
                moved = series[axis] - series[axis][0]
                ax.plot(series["time"], 1e3 * moved, label=f"{rpm} rpm", lw=1)
    for ax, axis in zip(axes, "xy", strict=True):
        ax.set(xlabel="time (s)", ylabel=f"{axis} of the head (mm)")
        ax.grid(alpha=0.25)
    axes[0].legend(fontsize=7, frameon=False)
    fig.suptitle("pitch / radius = 7, in phase", fontsize=10)
    return fig


def single(one: pd.DataFrame, two: pd.DataFrame, unit: float) -> plt.Figure:
    """Length, force, speed and efficiency of one flagellum, and of two, against omega_bar."""
    panels = {
        "shortening": ("L' / L'(0)", 1.0, None),
        "propulsive_force_N": ("force per flagellum (mN)", 1e3, FORCE),
        "head_rate_rad_per_s": ("head rate (rad/s)", 1.0, SPIN),
        "efficiency": ("efficiency", 1.0, ETA),
    }
    fig, axes = plt.subplots(2, 2, figsize=(8.5, 6), sharex=True, layout="constrained")
    for ax, (column, (label, scale, other)) in zip(axes.flat, panels.items(), strict=True):
        for ratio, part in one.groupby("pitch/r"):
            colour = COLOURS[ratio]
            ax.plot(
                part["omega_bar"], scale * part[column].abs(), color=colour, label=f"{ratio}, one"
            )
            if other is not None:
                some = two[(two["pitch/r"] == ratio) & (two["phase"] == "in phase")]
                ax.plot(
                    unit * some["rpm"],
                    scale * some[other].abs(),
                    "o",
                    color=colour,
                    ms=4,
                    label=f"{ratio}, two in phase",
                )
        ax.set(ylabel=label)
        ax.grid(alpha=0.25)
    for ax in axes[1]:
        ax.set_xlabel("omega_bar")
    axes[0, 1].legend(fontsize=7, frameon=False)
    return fig


def unbundling(results: dict[str, Result], cycles: pd.DataFrame) -> plt.Figure:
    """Bundled part against time, and how much it comes and goes."""
    shown = [name for name in results if name.startswith("unbundling")]
    moving = cycles[cycles["mismatch_rpm"] > 0].sort_values("amplitude", ascending=False)
    chosen = list(moving["name"][:3])
    fig, axes = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    for name in chosen or shown[:3]:
        result = results[name]
        n = result.numbers
        smooth = result.series["bundle_fraction"].rolling(10, center=True, min_periods=1).mean()
        label = (
            f"{n['motor']}, +{n['mismatch_rpm']:g} rpm, friction {n['friction']:g}, "
            f"{n['separation_mm']:g} mm"
        )
        axes[0].plot(result.series["time"], 100 * smooth, lw=1, label=label)
    axes[0].set(xlabel="time (s)", ylabel="bundled part (%), mean of 2 s")
    axes[0].legend(fontsize=7, frameon=False)
    ordered = cycles.sort_values("mismatch_rpm")
    for (kind, friction), part in ordered.groupby(["motor", "friction"]):
        for separation, some in part.groupby("separation_mm"):
            axes[1].plot(
                some["mismatch_rpm"],
                100 * some["amplitude"],
                {"rate": "o-", "torque": "s--"}[kind],
                color=plt.get_cmap("viridis")(friction / 0.7),
                alpha=0.4 + 0.6 * (28 - separation) / 14,
                label=f"{kind}, friction {friction:g}, {separation:g} mm",
                ms=4,
            )
    axes[1].set(xlabel="mismatch (rpm)", ylabel="amplitude of the bundled part (%)")
    axes[1].legend(fontsize=5, ncol=2, frameon=False)
    for ax in axes:
        ax.grid(alpha=0.25)
    return fig


def synchrony(results: dict[str, Result], rates: pd.DataFrame) -> plt.Figure:
    """Difference of phase against time, and how fast it goes, against stiffness."""
    fig, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    moduli = sorted(set(rates["youngs_modulus"]))
    shades = plt.get_cmap("viridis")(np.linspace(0.05, 0.85, len(moduli)))
    for name, result in results.items():
        if name.startswith("synchrony"):
            colour = shades[moduli.index(result.numbers["youngs_modulus"])]
            axes[0].plot(
                result.series["time"], result.series["phase_difference"], color=colour, lw=1
            )
    axes[0].set(xlabel="time (s)", ylabel="phase of the second less the first (rad)")
    for phase, part in rates.groupby("phase_at_start"):
        axes[1].plot(
            part["youngs_modulus"] / 1e6, 1e3 * part["rate"], "o-", label=f"from {phase:g} rad"
        )
    axes[1].set(xscale="log", xlabel="Young's modulus (MPa)", ylabel="decay (1/1000 s)")
    axes[1].axhline(0.0, color="0.4", lw=0.8)
    axes[1].legend(fontsize=7, frameon=False)
    for ax in axes:
        ax.grid(alpha=0.25)
    return fig


def winding(rows: pd.DataFrame, model: pd.DataFrame) -> plt.Figure:
    """By how much the tips have turned about each other, by the local model's number."""
    fig, ax = plt.subplots(figsize=(6, 3.6), layout="constrained")
    ax.plot(model["Bu"], model["turned"], color="0.5", label="local model")
    ax.plot(rows["Bu"], rows["turned"], "o-", label="simulated")
    ax.set(xscale="log", xlabel="Bu", ylabel="turn of the tips (half turns)")
    ax.legend(fontsize=8, frameon=False)
    ax.grid(alpha=0.25)
    return fig


def wrapping(results: dict[str, Result]) -> plt.Figure:
    """Mean distance of tips against time."""
    fig, ax = plt.subplots(figsize=(6, 3.6), layout="constrained")
    for name, result in results.items():
        if name.startswith("wrapping"):
            count = result.numbers["flagella"]
            ax.plot(
                result.series["time"], 1e3 * result.series["tip_to_tip"], label=f"{count} flagella"
            )
    ax.set(xlabel="time (s)", ylabel="mean distance of tips (mm)")
    ax.legend(fontsize=8, frameon=False)
    ax.grid(alpha=0.25)
    return fig
