"""Figures of a trajectory. Each function takes the data set that `trajectory.nc` holds.

The figures do not depend on a display: they are `matplotlib.figure.Figure` objects, to be
saved with `savefig`, or shown by a notebook.
"""

from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D

from .summary import slope, window

MM = 1e3
HEAD, FLAGELLUM, MEAN = "#c1503a", "#1f5a82", "#222222"
STYLE: dict[Any, Any] = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": "medium",
    "axes.titlelocation": "left",
    "axes.grid": True,
    "grid.alpha": 0.25,
    "savefig.dpi": 160,
    "font.size": 9.0,
}


def track(trajectory: xr.Dataset) -> Figure | None:
    """The way of the head seen along z and along y, coloured by time.

    None without a head, or if the first step failed.
    """
    if "head_position" not in trajectory or trajectory.sizes["time"] < 2:
        return None
    path = MM * trajectory.head_position.transpose("time", "axis").to_numpy()
    time = trajectory.time.to_numpy()
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 5.0), layout="constrained")
        axes = figure.subplots(2, 1, sharex=True)
        lines = [_coloured_line(axes[i], path[:, 0], path[:, 1 + i], time) for i in range(2)]
        for i, name in enumerate("yz"):
            axes[i].plot(path[0, 0], path[0, 1 + i], "o", color=MEAN, ms=4, label="start")
            axes[i].set(ylabel=f"{name} (mm)", title=f"Head in the x-{name} plane")
        axes[0].legend(frameon=False, loc="best")
        axes[1].set_xlabel("x (mm)")
        figure.colorbar(lines[0], ax=axes, label="time (s)", shrink=0.85, pad=0.02)
    return figure


def shape(trajectory: xr.Dataset, moments: int = 4) -> Figure:
    """The robot in three dimensions at a few times, all to the same, equal scale."""
    chosen = np.unique(np.linspace(0, trajectory.sizes["time"] - 1, moments).round().astype(int))
    nodes = MM * trajectory.position.transpose("time", "node", "axis").to_numpy()[chosen]
    edges = np.stack([trajectory.edge_start.to_numpy(), trajectory.edge_end.to_numpy()], axis=1)
    head = float(MM * trajectory.attrs.get("head_radius", 0.0))
    low, high = nodes.min(axis=(0, 1)), nodes.max(axis=(0, 1))
    if "head_position" in trajectory:
        low, high = low - [head, 0, 0], high
        low[1:], high[1:] = np.minimum(low[1:], -head), np.maximum(high[1:], head)
    columns = min(2, len(chosen))
    rows = -(-len(chosen) // columns)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(4.8 * columns, 3.0 * rows), layout="constrained")
        for place, frame in enumerate(chosen):
            ax = figure.add_subplot(rows, columns, place + 1, projection="3d")
            assert isinstance(ax, Axes3D)
            _draw_robot(ax, nodes[place], edges)
            if "head_position" in trajectory:
                centre = MM * trajectory.head_position.isel(time=frame).to_numpy()
                _draw_sphere(ax, centre, head)
            _equal_box(ax, low, high)
            ax.set_title(f"t = {float(trajectory.time[frame]):.4g} s", y=0.98)
    return figure


def speed(trajectory: xr.Dataset) -> Figure | None:
    """Speed along x and spin of the head against time, with the means that a summary gives.

    None without a head, or if the first step failed.
    """
    if "head_position" not in trajectory or trajectory.sizes["time"] < 2:
        return None
    time = trajectory.time.to_numpy()
    chosen = window(time)
    velocity = MM * trajectory.head_velocity.sel(axis="x").to_numpy()
    spin = trajectory.head_spin.to_numpy()
    way = MM * trajectory.head_position.sel(axis="x").to_numpy()
    angle = trajectory.head_angle.to_numpy()
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 4.8), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True)
        # At the start the robot is at rest: there is no step that ends there.
        above.plot(time[1:], velocity[1:], color=FLAGELLUM)
        below.plot(time[1:], spin[1:], color=HEAD)
        for ax, values, unit in ((above, way, "mm/s"), (below, angle, "rad/s")):
            if chosen.sum() >= 2:
                mean = slope(time[chosen], values[chosen])
                label = f"fit to the second half: {mean:.4g} {unit}"
                ax.plot(time[chosen][[0, -1]], [mean, mean], "--", color=MEAN, label=label)
                ax.legend(frameon=False, loc="best")
            ax.axhline(0.0, color=MEAN, lw=0.6)
        above.set(ylabel="v$_x$ of the head (mm/s)", title="Speed")
        below.set(ylabel="spin of the head (rad/s)", xlabel="time (s)", title="Rate of the head")
    return figure


def bundle(trajectory: xr.Dataset) -> Figure | None:
    """How the flagella come together: bundled part, turns, distance and forces against time.

    None with less than two flagella.
    """
    if "bundle_fraction" not in trajectory:
        return None
    time = trajectory.time.to_numpy()
    diameter = 2 * float(trajectory.attrs["rod_radius"])
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 6.4), layout="constrained")
        bundled, turns, distance = figure.subplots(3, 1, sharex=True)
        bundled.plot(time, 100 * trajectory.bundle_fraction, color=FLAGELLUM)
        bundled.set(ylabel="bundled part (%)", ylim=(-4, 104), title="Bundle")
        turns.plot(time, trajectory.linking_number, color=FLAGELLUM)
        turns.axhline(0.0, color=MEAN, lw=0.6)
        turns.set(ylabel="turns about each other", title="Linking number")
        distance.plot(time, trajectory.minimum_distance / diameter, color=FLAGELLUM)
        distance.axhline(1.0, color=MEAN, lw=0.8, ls="--", label="touching")
        distance.set(ylabel="distance / diameter", ylim=(0, None), xlabel="time (s)")
        distance.set_title("Smallest distance of the flagella")
        distance.legend(frameon=False, loc="best")
        if "contact_force" in trajectory:
            force = distance.twinx()
            force.plot(time, 1e3 * trajectory.contact_force, color=HEAD, lw=0.9)
            force.set_ylabel("contact force (mN)", color=HEAD)
            force.set_ylim(0, None)
            force.grid(visible=False)
            force.spines["right"].set_visible(True)
    return figure


def _coloured_line(ax: Axes, x: np.ndarray, y: np.ndarray, time: np.ndarray) -> LineCollection:
    points = np.stack([x, y], axis=1)
    pieces = list(np.stack([points[:-1], points[1:]], axis=1))
    lines = LineCollection(pieces, array=time[1:], cmap="viridis", lw=1.4)
    lines.set_clim(time[0], time[-1])
    ax.add_collection(lines)
    ax.autoscale_view()
    return lines


def _draw_robot(ax: Axes3D, nodes: np.ndarray, edges: np.ndarray) -> None:
    for pair in edges:
        ax.plot(*nodes[pair].T, color=FLAGELLUM, lw=2.2, solid_capstyle="round")


def _draw_sphere(ax: Axes3D, centre: np.ndarray, radius: float) -> None:
    around, down = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(0, np.pi, 13))
    ball = np.stack([np.cos(around) * np.sin(down), np.sin(around) * np.sin(down), np.cos(down)])
    x, y, z = centre[:, None, None] + radius * ball
    ax.plot_surface(x, y, z, color=HEAD, alpha=0.15, linewidth=0, shade=False)


def _equal_box(ax: Axes3D, low: np.ndarray, high: np.ndarray) -> None:
    margin = 0.03 * (high - low).max()
    low, high = low - margin, high + margin
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    ax.set_box_aspect(tuple(high - low), zoom=1.12)  # pyright: ignore[reportArgumentType]
    ax.set(xlabel="x (mm)", ylabel="y (mm)", zlabel="z (mm)")
    for axis in (ax.yaxis, ax.zaxis):
        axis.set_major_locator(MaxNLocator(4))
    ax.view_init(elev=18, azim=-65)
