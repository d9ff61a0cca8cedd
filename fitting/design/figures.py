"""Figures of a design, and its film."""

import matplotlib as mpl
import numpy as np
from jax import numpy as jnp
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from derjax import Run, Scene, positions, rollout, steady, steady_run
from derjax.results.plots import FLAGELLUM, HEAD, MM, STYLE

from .landscape import label_of, values_of
from .outcome import Design
from .report import statistic

PALE = "#b8bcc4"

FILM_TURNS, FILM_FRAMES = 3.0, 90
"""Turns of the motor that the film of a steady state shows, and its frames."""


def shapes_figure(design: Design) -> Figure:
    """The robot before and after, from the side: at rest, and as it swims steadily."""
    problem = design.problem
    first = problem.scene
    pairs = [("start", first), ("best", design.scene)]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 4.0), layout="constrained")
        axes = figure.subplots(2, 1, sharex=True, sharey=True)
        for place, (word, scene) in zip(axes, pairs, strict=True):
            rest = positions(scene.rod.topology, scene.start.q)
            _drawn(place, scene, np.asarray(rest), PALE, "at rest")
            if problem.through == "steady":
                state = steady(scene)
                if state.ok:
                    _drawn(place, scene, np.asarray(state.positions), FLAGELLUM, "swimming", HEAD)
            place.set(ylabel="y (mm)", aspect="equal", title=word)
        axes[-1].set_xlabel("x (mm)")
        axes[0].legend(frameon=False, fontsize="small", loc="upper right")
    return figure


def _drawn(
    axes: Axes, scene: Scene, nodes: np.ndarray, colour: str, label: str, of_head: str = PALE
) -> None:
    for k, path in enumerate(scene.rod.topology.filaments):
        line = MM * nodes[list(path)]
        axes.plot(line[:, 0], line[:, 1], color=colour, lw=1.6, label=label if k == 0 else None)
    head = scene.rod.topology.head
    if head is not None and "head_radius" in scene.parameters:
        centre, radius = MM * nodes[head.node], MM * float(scene.parameters["head_radius"])
        axes.add_patch(Circle(tuple(centre[:2]), radius, fill=False, ec=of_head, lw=0.8))


def tolerances_figure(design: Design) -> Figure:
    """By how much each number may be off for the objective to change by 1 %."""
    chosen = {k: s for k, s in design.sensitivities.items() if np.isfinite(s.tolerance)}
    values = dict(zip(design.problem.variables.labels, values_of(design, design.best), strict=True))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.6, 1.2 + 0.35 * len(chosen)), layout="constrained")
        axes = figure.subplots()
        parts = [100 * s.tolerance / abs(values[k] or 1.0) for k, s in chosen.items()]
        axes.barh(list(chosen), parts, color=FLAGELLUM, height=0.6)
        axes.invert_yaxis()
        axes.set(xlabel="deviation that changes the objective by 1 % (% of the number)")
        axes.grid(visible=False, axis="y")
    return figure


def programme_figure(design: Design) -> Figure:
    """The rates of the motors over time, before and after."""
    table = design.problem.scene.source.file.motor_table
    before = np.asarray(design.problem.variables.start["rpm"]).reshape(len(table.time), -1)
    after = np.asarray(design.values["rpm"]).reshape(len(table.time), -1)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 3.0), layout="constrained")
        axes = figure.subplots()
        for k, colour in zip(
            range(after.shape[1]), mpl.colormaps["tab10"](np.arange(10)), strict=False
        ):
            label = "" if after.shape[1] == 1 else f" {k + 1}"
            axes.plot(table.time, before[:, k], "--", color=colour, lw=1.0, label=f"start{label}")
            axes.plot(table.time, after[:, k], color=colour, lw=1.6, label=f"best{label}")
        axes.set(xlabel="time (s)", ylabel="motor (rpm)")
        axes.legend(frameon=False, fontsize="small", ncols=2)
    return figure


def spread_figure(design: Design) -> Figure:
    """How the objective of the best design spreads with what is uncertain."""
    good = design.spread[np.isfinite(design.spread)]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.6, 3.0), layout="constrained")
        axes = figure.subplots()
        said, size = label_of(design)
        axes.hist(size * good, bins=24, color=FLAGELLUM, alpha=0.8)
        axes.axvline(size * design.objective, color=HEAD, lw=1.6, label=statistic(design))
        axes.set(xlabel=said.removeprefix(f"{statistic(design)} of "), ylabel="draws")
        axes.legend(frameon=False)
    return figure


def film(design: Design) -> Run:
    """What the film shows: some turns of the steady state, or the run."""
    if design.problem.through == "steady":
        state = steady(design.scene)
        rate = abs(float(state.motor_rate)) or 1.0
        return steady_run(state, jnp.linspace(0.0, FILM_TURNS * 2 * np.pi / rate, FILM_FRAMES))
    return rollout(design.scene, reverse_mode=False)
