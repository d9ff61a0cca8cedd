"""A fit as one page to look at, which needs nothing else: `report.html`."""

import base64
import html
import io
import math
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from derjax import Scene, State, build
from derjax.core.pytree import replace
from derjax.io.output import Output
from derjax.results.dataset import to_dataset
from derjax.results.film import film_of
from derjax.results.viewer import view

from .goodness import UNLIKELY, order
from .joint.posterior import Posterior
from .joint.profile import RISE, Profile
from .outcome import Estimate, Fit
from .report import AFTER, AXES, BEFORE, PAGE, TRACK, as_unit, figure, rms, table

MOST_LISTED = 60
"""Nuisances that are listed."""

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem;
  color: #222; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
table { border-collapse: collapse; margin: 0.6rem 0; } th { text-align: left; }
td, th { padding: 0.15rem 0.9rem 0.15rem 0; border-bottom: 1px solid #ddd; }
td { font-variant-numeric: tabular-nums; }
img { max-width: 100%; } pre { background: #f6f6f4; padding: 0.6rem 0.8rem; overflow-x: auto; }
.warning { border-left: 4px solid #c8442b; padding-left: 0.8rem; margin: 0.6rem 0; }
"""


def page(
    fit: Fit,
    robot: tuple[Scene, State] | None = None,
    profiles: Sequence[Profile] = (),
    drawn: Posterior | None = None,
) -> str:
    """The page.

    Args:
        fit: what is shown.
        robot: a scene and a state of it; None for the robot at rest with the fitted parameters.
        profiles: of its parameters.
        drawn: their posterior.
    """
    name = "fit" if fit.dataset.path is None else str(fit.dataset.path)
    parts = [
        f"<h1>{_text(name)}</h1>",
        f"<p>{_text(fit.status)}; {_text(fit.goodness.sentence())}</p>",
        "<h2>Parameters</h2>",
        f"<pre>{_text(table(fit))}</pre>",
        _of_estimates(fit, fit.estimates, fit.start),
        *(f'<p class="warning">{_text(warning)}</p>' for warning in fit.warnings),
        *([f"<h2>Decisions</h2>{_list(fit.said)}"] if fit.said else []),
        "<h2>Data as read</h2>",
        _data(fit),
        "<h2>The fit over the data</h2>",
        _picture(figure(fit)),
        "<h2>Residuals</h2>",
        _residuals(fit),
    ]
    if len(fit.estimates) > 1:
        parts += ["<h2>Correlation</h2>", _correlation(fit)]
    if profiles:
        parts += [
            "<h2>Profiles</h2>",
            _profiles_words(profiles),
            _picture(profile_figure(profiles)),
        ]
    if drawn is not None:
        parts += [
            "<h2>Posterior</h2>",
            _posterior_words(drawn),
            _picture(posterior_figure(drawn, fit)),
        ]
    if fit.nuisances:
        listed = dict(list(fit.nuisances.items())[:MOST_LISTED])
        parts += ["<h2>Also estimated</h2>", _of_estimates(fit, listed, {})]
        if len(fit.nuisances) > len(listed):
            parts.append(f"<p>and {len(fit.nuisances) - len(listed)} more, in fit.nc</p>")
    parts += ["<h2>The robot</h2>", _robot(fit, robot)]
    parts.append(f"<p>derjax {version('derjax')}; {fit.wall_time:.0f} s</p>")
    content = "\n".join(parts)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f"<title>{_text(name)}</title>\n<style>{STYLE}</style>\n</head>\n"
        f"<body>\n{content}\n</body>\n</html>\n"
    )


def write_page(
    fit: Fit,
    output: Output,
    robot: tuple[Scene, State] | None = None,
    profiles: Sequence[Profile] = (),
    drawn: Posterior | None = None,
) -> None:
    """Write report.html."""
    with output.replacing(PAGE) as temporary:
        temporary.write_text(page(fit, robot, profiles, drawn), encoding="utf-8")


def _text(words: str) -> str:
    return html.escape(words)


def _list(sentences: Iterable[str]) -> str:
    return "<ul>" + "".join(f"<li>{_text(one)}</li>" for one in sentences) + "</ul>"


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    head = "".join(f"<th>{_text(one)}</th>" for one in header)
    body = "".join(
        "<tr>" + "".join(f"<td>{_text(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def _number(value: float) -> str:
    return f"{value:.6g}" if math.isfinite(value) else "not determined"


def _of_estimates(fit: Fit, estimates: dict[str, Estimate], start: dict[str, float]) -> str:
    rows = []
    for name, e in estimates.items():
        unit = as_unit(fit, name)
        interval = (
            f"{e.ci95[0]:.6g} to {e.ci95[1]:.6g}" if math.isfinite(e.std) else "not determined"
        )
        began = [f"{start[name]:.4g}"] if start else []
        rows.append(
            [name, _number(e.value), f"{e.std:.2g}", interval, "" if unit == "1" else unit, *began]
        )
    header = ["", "value", "standard error", "95 % interval", "unit"]
    return _table([*header, *(["start"] if start else [])], rows)


def _data(fit: Fit) -> str:
    rows = []
    for one in fit.runs:
        run = one.run
        from_ = "steady from the first frame" if run.steady else "from rest"
        gaps = float(np.median(np.diff(run.time)))
        rows.append(
            [
                run.name,
                "" if run.motor_rpm is None else str(run.motor_rpm),
                f"{run.time.size} frames, {run.time[0]:g} to {run.time[-1]:g} s, "
                f"{gaps:.3g} s apart",
                ", ".join(("x", "y", "z", "head angle")[c] for c in run.channels),
                f"{run.dropped} frames left out" if run.dropped else "",
                from_,
                rms(one.rms),
            ]
        )
    words = []
    if rows:
        words.append(
            _table(["run", "rpm", "frames", "channels", "", "start", "rms of residuals"], rows)
        )
    for rates in fit.rates:
        entries = [
            [f"{rpm:g}", *(_number(v) for v in (1e3 * d[0], 1e3 * f[0], d[1], f[1]))]
            for rpm, d, f in zip(rates.motor_rpm, rates.data, rates.fitted, strict=True)
        ]
        header = ["rpm", "v (mm/s)", "fitted", "head rate (rad/s)", "fitted"]
        words.append(f"<p>{_text(rates.name)}</p>" + _table(header, entries))
    return "".join(words)


def _residuals(fit: Fit) -> str:
    """Sizes, tests of order, histograms."""
    words = [
        f"<p>Noise: {_text(rms(fit.noise))}"
        + "".join(f"; correlation from frame to frame ({k}) {v:.2f}" for k, v in fit.memory.items())
        + "</p>"
    ]
    rows = []
    for one in fit.runs:
        for column in range(one.residuals.shape[1]):
            found = order(one.run, column, one.residuals[:, column])
            rows.append(
                [
                    found.run,
                    found.channel,
                    f"{found.autocorrelation:.2f}",
                    f"{found.runs} ({found.expected_runs:.0f} by chance)",
                    f"{found.p_value:.2g}",
                    "not chance" if found.p_value < UNLIKELY else "",
                ]
            )
    if rows:
        header = ["run", "channel", "correlation", "runs of one sign", "p", ""]
        words.append(_table(header, rows))
        words.append(_picture(residual_figure(fit)))
    return "".join(words)


def residual_figure(fit: Fit) -> Figure:
    """Residuals over time, and how they are distributed, for every run."""
    count = len(fit.runs)
    canvas = Figure(figsize=(9, 2.2 * count), layout="constrained")
    axes = canvas.subplots(count, 2, squeeze=False, width_ratios=(3, 1))
    for row, one in enumerate(fit.runs):
        for column, channel in enumerate(one.run.channels):
            spread = float(np.std(one.residuals[:, column])) or 1.0
            scaled = one.residuals[:, column] / spread
            axes[row, 0].plot(one.run.time, scaled, lw=0.8, color=AXES[channel])
            label = ("x", "y", "z", "angle")[channel]
            bins = np.linspace(-4, 4, 33)
            axes[row, 1].hist(
                scaled, bins, histtype="step", density=True, color=AXES[channel], label=label
            )
        grid = np.linspace(-4, 4, 200)
        axes[row, 1].plot(
            grid, np.exp(-0.5 * grid**2) / np.sqrt(2 * np.pi), color=BEFORE, lw=1, zorder=0
        )
        axes[row, 0].set_title(one.run.name, fontsize=9)
        axes[row, 0].set_ylabel("residual / its spread", fontsize=8)
        axes[row, 1].legend(fontsize=7, frameon=False)
    axes[-1, 0].set_xlabel("time (s)")
    _plain(axes.flat)
    return canvas


def _correlation(fit: Fit) -> str:
    names = list(fit.estimates)
    rows = [
        [name, *(f"{value:.3f}" for value in row)]
        for name, row in zip(names, fit.correlation, strict=True)
    ]
    return _table(["", *names], rows)


def _profiles_words(profiles: Sequence[Profile]) -> str:
    rows = [[p.name, _number(p.ci95[0]), _number(p.ci95[1])] for p in profiles]
    return _table(["", "95 % from", "to"], rows)


def profile_figure(profiles: Sequence[Profile]) -> Figure:
    """The rise of the loss over every parameter, and what the covariance makes of it."""
    canvas = Figure(figsize=(4.2 * len(profiles), 3.2), layout="constrained")
    axes = canvas.subplots(1, len(profiles), squeeze=False)[0]
    for axis, one in zip(axes, profiles, strict=True):
        axis.plot(one.values, one.rise, "o-", ms=4, color=AFTER, label="profile")
        axis.plot(one.values, one.parabola, "--", color=TRACK, lw=1, label="covariance")
        axis.axhline(RISE, color=BEFORE, lw=0.8)
        axis.set_ylim(-0.2, 2.2 * RISE)
        axis.set_xlabel(one.name)
    axes[0].set_ylabel("rise of the loss")
    axes[0].legend(fontsize=8, frameon=False)
    _plain(axes)
    return canvas


def _posterior_words(drawn: Posterior) -> str:
    mean, std, ends = drawn.mean(), drawn.std(), drawn.ci95()
    rows = [
        [
            name,
            f"{mean[name]:.6g}",
            f"{std[name]:.2g}",
            f"{ends[name][0]:.6g} to {ends[name][1]:.6g}",
            f"{r:.3f}",
            f"{n:.0f}",
        ]
        for name, r, n in zip(drawn.names, drawn.r_hat, drawn.effective, strict=True)
    ]
    header = ["", "mean", "standard deviation", "95 %", "R hat", "effective draws"]
    return _table(header, rows)


def posterior_figure(drawn: Posterior, fit: Fit) -> Figure:
    """Draws of all pairs of parameters, and of each, over what the covariance says."""
    count = len(drawn.names)
    canvas = Figure(figsize=(2.6 * count + 1, 2.6 * count), layout="constrained")
    axes = canvas.subplots(count, count, squeeze=False)
    flat = drawn.draws.reshape(-1, count)
    shown = flat[:: max(1, len(flat) // 1000)]
    for row in range(count):
        for column in range(count):
            axis = axes[row, column]
            if column > row:
                axis.set_axis_off()
                continue
            if column < row:
                axis.plot(shown[:, column], shown[:, row], ".", ms=2, alpha=0.4, color=AFTER)
            else:
                axis.hist(flat[:, row], 40, density=True, color=AFTER, alpha=0.5)
                e = fit.estimates[drawn.names[row]]
                if math.isfinite(e.std) and e.std > 0:
                    grid = np.linspace(e.value - 4 * e.std, e.value + 4 * e.std, 200)
                    u = (grid - e.value) / e.std
                    bell = np.exp(-0.5 * u**2) / (e.std * np.sqrt(2 * np.pi))
                    axis.plot(grid, bell, "--", color=TRACK, lw=1)
            if row == count - 1:
                axis.set_xlabel(drawn.names[column])
            if column == 0 and row > 0:
                axis.set_ylabel(drawn.names[row])
    _plain(axes.flat)
    return canvas


def _plain(axes: Iterable[Any]) -> None:
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=8)


def _picture(canvas: Figure) -> str:
    buffer = io.BytesIO()
    FigureCanvasAgg(canvas).print_figure(buffer, format="png", dpi=110)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    return f'<p><img alt="" src="data:image/png;base64,{data}"></p>'


def _robot(fit: Fit, robot: tuple[Scene, State] | None) -> str:
    """The robot in three dimensions, to turn and zoom."""
    if robot is None:
        plain = {n: v for n, v in fit.values.items() if n in fit.dataset.scene.single_numbers}
        scene = build(fit.dataset.scene.with_parameters(plain))
        robot = scene, scene.start
    scene, state = robot
    later = replace(state, time=state.time + 1.0)
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), state, later)
    still = view(film_of(to_dataset(scene, both)))
    still.frames = ()
    still.update_layout(updatemenus=[], sliders=[], title=None, height=520)
    return still.to_html(
        full_html=False,
        include_plotlyjs=True,
        include_mathjax=False,
        config={"displaylogo": False, "responsive": True},
    )
