"""The figure of a sweep: how fast the robot swims, against what varies."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from ...results.plots import MEAN, STYLE
from ...scenes.extensions import unit_of
from .file import Sweep

Row = Mapping[str, str]

QUANTITIES = {
    "v_x_m_per_s": (1e3, "speed along x (mm/s)"),
    "head_rate_rad_per_s": (1.0, "rate of the head (rad/s)"),
    "minimum_distance_m": (1e3, "smallest distance (mm)"),
    "bundle_fraction": (1.0, "bundled part"),
}
"""What is drawn, the first two of these that there are: factor and label."""

MOST_IN_A_LEGEND = 10


def figure(plan: Sweep, rows: Mapping[int, Row]) -> Figure | None:
    """Speed and rate of the head against the first key, a curve for each value of the others.

    Points that failed are crosses at the bottom. None if no point has anything to draw.
    """
    drawn = [name for name in QUANTITIES if any(row.get(name) for row in rows.values())][:2]
    if not drawn:
        return None
    place, labels = _axis(plan)
    curves = _curves(plan)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 2.9 * len(drawn) + 0.4), layout="constrained")
        panels: list[Axes] = list(figure.subplots(len(drawn), 1, sharex=True, squeeze=False)[:, 0])
        colours = mpl.colormaps["viridis"](np.linspace(0.0, 0.88, len(curves)))
        for axes, name in zip(panels, drawn, strict=True):
            factor, label = QUANTITIES[name]
            for colour, (values, numbers) in zip(colours, curves.items(), strict=True):
                _curve(axes, place, rows, numbers, name, factor, colour, _said(plan, values))
            _failures(axes, place, rows)
            axes.set_ylabel(label)
        panels[0].set_title("Sweep")
        panels[-1].set_xlabel(_label(plan.names[0]))
        if labels is not None:
            panels[-1].set_xticks(range(len(labels)), labels)
        elif _is_geometric(sorted(set(place.values()))):
            panels[-1].set_xscale("log")
        handles, _ = panels[0].get_legend_handles_labels()
        if 0 < len(handles) <= MOST_IN_A_LEGEND + 1:
            panels[0].legend(frameon=False, loc="best", fontsize="small")
        elif handles:
            _colour_bar(figure, panels, plan, curves)
    return figure


def _axis(plan: Sweep) -> tuple[dict[int, float], list[str] | None]:
    """Where each point is along the first key; and labels, if its values are not numbers."""
    values = [point[0] for point in plan.points]
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        return {k: float(v) for k, v in enumerate(values)}, None
    words = [_word(v) for v in values]
    labels = list(dict.fromkeys(words))
    return {k: float(labels.index(word)) for k, word in enumerate(words)}, labels


def _curves(plan: Sweep) -> dict[tuple[str, ...], list[int]]:
    """The numbers of the points that belong to each curve, by the values of the other keys."""
    if plan.mode == "together":
        return {(): list(range(len(plan.points)))}
    curves: dict[tuple[str, ...], list[int]] = {}
    for number, point in enumerate(plan.points):
        curves.setdefault(tuple(_word(v) for v in point[1:]), []).append(number)
    return curves


def _curve(
    axes: Axes,
    place: Mapping[int, float],
    rows: Mapping[int, Row],
    numbers: Sequence[int],
    name: str,
    factor: float,
    colour: Any,
    label: str,
) -> None:
    good = [k for k in numbers if rows.get(k, {}).get(name)]
    x = np.array([place[k] for k in good])
    y = np.array([factor * float(rows[k][name]) for k in good])
    if not good:
        return
    order = np.argsort(x, kind="stable")
    axes.plot(x[order], y[order], "o-", ms=3.5, color=colour, label=label or None)


def _failures(axes: Axes, place: Mapping[int, float], rows: Mapping[int, Row]) -> None:
    """Crosses below the points that failed."""
    x = sorted({place[k] for k, row in rows.items() if row["status"] != "ok"})
    axes.margins(x=0.04, y=0.12)
    if x:
        bottom = axes.get_xaxis_transform()
        axes.plot(
            x, [0.03] * len(x), "x", color=MEAN, transform=bottom, label="a point failed here"
        )


def _colour_bar(
    figure: Figure, panels: Sequence[Axes], plan: Sweep, curves: Mapping[tuple[str, ...], Any]
) -> None:
    """Instead of a legend of many curves, the values of the second key by their order."""
    scale = ScalarMappable(Normalize(0, len(curves) - 1), "viridis")
    bar = figure.colorbar(
        scale, ax=list(panels), shrink=0.85, pad=0.02, label=_label(plan.names[1])
    )
    chosen = np.unique(np.linspace(0, len(curves) - 1, 6).round().astype(int))
    bar.set_ticks(chosen.tolist(), labels=[list(curves)[k][0] for k in chosen])


def _said(plan: Sweep, values: Sequence[str]) -> str:
    return ", ".join(f"{k} = {v}" for k, v in zip(plan.names[1:], values, strict=False))


def _label(name: str) -> str:
    key = name.split(".")[-1]
    unit = unit_of(name)
    return name if unit in ("1", key) else f"{name} ({unit})"


def _word(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return value if isinstance(value, str) else json.dumps(value)


def _is_geometric(values: Sequence[float]) -> bool:
    """Whether values are evenly spaced by their logarithms, and not by themselves."""
    if len(values) < 3 or values[0] <= 0:
        return False
    ratios = np.diff(np.log(values))
    return bool(np.ptp(ratios) < 1e-6 * ratios.mean())
