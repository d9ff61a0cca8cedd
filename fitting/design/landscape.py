"""The objective around the best design, and a figure of it with the way of the search."""

from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from derjax.results.plots import FLAGELLUM, HEAD, MEAN, MM, STYLE
from derjax.scenes.extensions import unit_of

from .outcome import Design
from .problem import KEPT, Designs, Point
from .report import statistic
from .variables import Vector

MOST_SLICES = 6
"""Variables along which the objective is drawn."""


def landscape(designs: Designs, best: Point, count: int) -> pd.DataFrame:
    """The objective around the best design: over one or two variables, or along each of several.

    Args:
        designs: that look at designs.
        best: through which slices go.
        count: points along each variable.

    Returns:
        A row for each design: the variables by label, the objective, the smallest margin to a
        limit in parts of it, and the label of the variable of its slice.
    """
    variables = designs.problem.variables
    labels, line = variables.labels, np.linspace(0.0, 1.0, count)
    if variables.size == 2:
        places = [("", np.array([a, b])) for b in line for a in line]
    else:
        places = []
        for k, label in enumerate(labels[:MOST_SLICES]):
            # The best design itself as well, which a slice should go through.
            along = np.sort(np.append(line, best.x[k])) if variables.size > 1 else line
            for value in along:
                x = best.x.copy()
                x[k] = value
                places.append((label, x))
    rows = []
    for label, x in places:
        point = designs(x)
        numbers = dict(zip(labels, variables.offset + variables.scale * x, strict=True))
        left = float(np.min(designs.margins(point), initial=np.inf)) if point.ok else -np.inf
        rows.append(numbers | {"objective": point.objective, "margin": left, "slice": label})
    return pd.DataFrame(rows)


def landscape_figure(design: Design, around: pd.DataFrame) -> Figure:
    """The objective over the variables, with the way of the search."""
    variables = design.problem.variables
    with mpl.rc_context(STYLE):
        if variables.size == 2:
            return _map(design, around)
        shown = [label for label in variables.labels if label in set(around["slice"])]
        columns = min(len(shown), 3)
        rows = -(-len(shown) // columns)
        figure = Figure(figsize=(1.2 + 3.1 * columns, 2.9 * rows), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, sharey=True)
        for place, label in zip(axes.flat, shown, strict=False):
            _slice(place, design, around.loc[around["slice"] == label], label)
        for place in axes.flat[len(shown) :]:
            place.set_visible(False)
        for place in axes[:, 0]:
            place.set_ylabel(label_of(design)[0])
    return figure


def label_of(design: Design) -> tuple[str, float]:
    """What stands at an axis of the objective, and the factor from SI units."""
    said = "" if design.problem.uncertain is None else f"{statistic(design)} of "
    objective = design.problem.objective
    text, scale = _with_unit(objective.name, objective.unit)
    return said + text, scale


def _with_unit(name: str, unit: str) -> tuple[str, float]:
    """A name with its unit, and the factor from SI units: lengths in mm."""
    if unit in ("m", "m/s"):
        return f"{name} (m{unit})", MM
    return (name if unit in ("1", name) else f"{name} ({unit})"), 1.0


def _slice(axes: Axes, design: Design, part: pd.DataFrame, label: str) -> None:
    text, scale = _with_unit(label, unit_of(label))
    place = design.problem.variables.labels.index(label)
    size = label_of(design)[1]
    x, y = scale * part[label].to_numpy(float), size * part["objective"].to_numpy(float)
    kept = part["margin"].to_numpy(float) >= -KEPT
    axes.plot(x, y, color="#b8bcc4", lw=1.2)
    axes.plot(x, np.where(kept, y, np.nan), color=FLAGELLUM, lw=1.8)

    def mark(points: list[Point], kind: str, **style: Any) -> None:
        at = [scale * values_of(design, point)[place] for point in points]
        axes.plot(at, [size * point.objective for point in points], kind, **style)

    if design.problem.variables.size == 1:
        for attempt in design.attempts:
            mark([p for p in attempt.path if p.ok], "o", color=MEAN, ms=2.5, alpha=0.5)
        if design.start is not None:
            mark([design.start], "s", color=MEAN, ms=5, mfc="none")
    mark([design.best], "o", color=HEAD, ms=6)
    axes.set_xlabel(text)


def values_of(design: Design, point: Point) -> Vector:
    """(n,) the variables of a design, in the units of the scene."""
    variables = design.problem.variables
    return variables.offset + variables.scale * point.x


def _map(design: Design, around: pd.DataFrame) -> Figure:
    first, second = design.problem.variables.labels
    (text, scale), (other, factor) = (_with_unit(n, unit_of(n)) for n in (first, second))
    table = around.pivot(index=second, columns=first, values="objective")
    margin = around.pivot(index=second, columns=first, values="margin").to_numpy(float)
    x, y = scale * table.columns.to_numpy(float), factor * table.index.to_numpy(float)
    figure = Figure(figsize=(6.0, 4.6), layout="constrained")
    axes = figure.subplots()
    said, size = label_of(design)
    drawn = axes.contourf(x, y, size * table.to_numpy(float), 24, cmap="viridis")
    figure.colorbar(drawn, ax=axes, label=said)
    margin = np.clip(margin, -1.0, 1.0)
    if margin.min() < 0.0 < margin.max():
        axes.contourf(x, y, margin, [-2.0, 0.0], colors=["white"], alpha=0.6)
        axes.contour(x, y, margin, [0.0], colors=["white"], linewidths=1.4)
    for attempt in design.attempts:
        way = np.array([values_of(design, p) for p in attempt.path if p.ok]).reshape(-1, 2)
        axes.plot(
            scale * way[:, 0], factor * way[:, 1], ".-", color="white", lw=0.8, ms=4, alpha=0.8
        )
    if design.start is not None:
        at = values_of(design, design.start)
        axes.plot(scale * at[0], factor * at[1], "s", color=MEAN, mfc="white", ms=6, label="start")
    at = values_of(design, design.best)
    axes.plot(scale * at[0], factor * at[1], "o", color=HEAD, ms=7, label="best")
    axes.set(xlabel=text, ylabel=other)
    axes.legend(frameon=True, loc="best", fontsize="small")
    axes.grid(visible=False)
    return figure
