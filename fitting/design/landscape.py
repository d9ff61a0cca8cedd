"""The objective around the best design, and a figure of it with the way of the search."""

from collections.abc import Callable

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from derjax.results.plots import FLAGELLUM, HEAD, MEAN, MM, STYLE
from derjax.scenes.extensions import unit_of

from .outcome import Design
from .problem import Designs, Point
from .report import statistic
from .variables import Vector

MOST_SLICES = 6
"""Variables along which the objective is drawn."""


def landscape(
    designs: Designs, best: Point, count: int, stopping: Callable[[], bool]
) -> pd.DataFrame:
    """The objective around the best design: over one or two variables, or along each of several.

    Args:
        designs: that look at designs.
        best: through which slices go.
        count: points along each variable.
        stopping: asked after every design whether to stop.

    Returns:
        A row for each design: the variables by label, the objective, whether all limits are kept,
        and the label of the variable of its slice.
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
        if stopping():
            break
        point = designs(x)
        numbers = dict(zip(labels, variables.offset + variables.scale * x, strict=True))
        kept = designs.keeps(point)
        rows.append(numbers | {"objective": point.objective, "kept": kept, "slice": label})
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
            place.set_ylabel(label_of(design))
    return figure


def label_of(design: Design) -> str:
    """What stands at an axis of the objective."""
    objective = design.problem.objective
    said = "" if design.problem.uncertain is None else f"{statistic(design)} of "
    return f"{said}{objective.name}" + ("" if objective.unit == "1" else f" ({objective.unit})")


def _axis(label: str) -> tuple[str, float]:
    """What stands at an axis, and the factor from SI units: lengths in mm."""
    unit = unit_of(label)
    if unit == "m":
        return f"{label} (mm)", MM
    return (label if unit in ("1", label) else f"{label} ({unit})"), 1.0


def _slice(axes: Axes, design: Design, part: pd.DataFrame, label: str) -> None:
    text, scale = _axis(label)
    place = design.problem.variables.labels.index(label)
    x, y = scale * part[label].to_numpy(float), part["objective"].to_numpy(float)
    kept = part["kept"].to_numpy(bool)
    axes.plot(x, y, color="#b8bcc4", lw=1.2)
    axes.plot(x, np.where(kept, y, np.nan), color=FLAGELLUM, lw=1.8)
    if design.problem.variables.size == 1:
        for attempt in design.attempts:
            way = [p for p in attempt.path if p.ok]
            at = [scale * values_of(design, p)[place] for p in way]
            axes.plot(at, [p.objective for p in way], "o", color=MEAN, ms=2.5, alpha=0.5)
    axes.plot(
        scale * values_of(design, design.best)[place], design.objective, "o", color=HEAD, ms=6
    )
    if design.start is not None and design.problem.variables.size == 1:
        axes.plot(
            scale * values_of(design, design.start)[place],
            design.start.objective,
            "s",
            color=MEAN,
            ms=5,
            mfc="none",
        )
    axes.set_xlabel(text)


def values_of(design: Design, point: Point) -> Vector:
    """(n,) the variables of a design, in the units of the scene."""
    variables = design.problem.variables
    return variables.offset + variables.scale * point.x


def _map(design: Design, around: pd.DataFrame) -> Figure:
    first, second = design.problem.variables.labels
    (text, scale), (other, factor) = _axis(first), _axis(second)
    table = around.pivot(index=second, columns=first, values="objective")
    kept = around.pivot(index=second, columns=first, values="kept")
    x, y = scale * table.columns.to_numpy(float), factor * table.index.to_numpy(float)
    figure = Figure(figsize=(6.0, 4.6), layout="constrained")
    axes = figure.subplots()
    drawn = axes.contourf(x, y, table.to_numpy(float), 24, cmap="viridis")
    figure.colorbar(drawn, ax=axes, label=label_of(design))
    if not kept.to_numpy(bool).all():
        axes.contourf(x, y, kept.to_numpy(float), [-0.5, 0.5], colors=["white"], alpha=0.6)
        axes.contour(x, y, kept.to_numpy(float), [0.5], colors=["white"], linewidths=1.2)
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
