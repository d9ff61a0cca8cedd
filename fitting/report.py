"""The outcome of a fit for people and programs: a figure, a JSON file, a table."""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from derjax.io.output import Output
from derjax.scenes.extensions import unit_of

from .joint.posterior import Posterior
from .joint.profile import Profile
from .observe import ANGLE, CHANNELS
from .outcome import Fit, RateFit, RunFit
from .simulate import SimulatedTrack

if TYPE_CHECKING:  # slow to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

REPORT, FIGURE, NETCDF, PAGE = "fit.json", "fit.png", "fit.nc", "report.html"
"""Names of the files."""

TRACK, BEFORE, AFTER = "#444444", "#b8bcc4", "#c8442b"
AXES = ("#c8442b", "#2f6fb0", "#4b9a4b", "#8a56a8")


def as_dict(fit: Fit) -> dict[str, Any]:
    """The fit as it is written to fit.json; SI units. What is not finite becomes null."""
    names = list(fit.estimates)
    return {
        "status": fit.status,
        "parameters": {
            name: {
                "value": e.value,
                "std": _finite(e.std),
                "ci95": [_finite(end) for end in e.ci95],
                "widened": e.widened,
                "unit": as_unit(fit, name),
                "start": fit.start[name],
            }
            for name, e in fit.estimates.items()
        },
        "correlation": {"names": names, "matrix": fit.correlation.tolist()},
        "warnings": list(fit.warnings),
        "goodness": {
            "good": fit.goodness.good,
            "chi2": fit.goodness.chi2,
            "degrees_of_freedom": fit.goodness.degrees_of_freedom,
            "p_value": fit.goodness.p_value,
            "rms_over_robot_length": fit.goodness.relative_rms,
            "error_bars_inflated_by": fit.goodness.inflation,
            "noise_given_over_residuals": fit.goodness.exaggeration,
            "order_of_residuals": [dataclasses.asdict(one) for one in fit.goodness.orders],
        },
        "likely_causes": [dataclasses.asdict(cause) for cause in fit.causes],
        "other_optima": [dataclasses.asdict(other) for other in fit.alternatives],
        "loss": fit.loss,
        "loss_history": [iteration.loss for iteration in fit.history],
        "noise": fit.noise,
        "runs": [
            {
                "track": one.run.name,
                "motor_rpm": one.run.motor_rpm,
                "frames": int(one.run.time.size),
                "t_end": float(one.run.time[-1]),
                "rms_position": one.rms.get("position"),
                "rms_head_angle": one.rms.get("head_angle"),
                "drift_m_per_s": one.drift,
                "frames_left_out": one.run.dropped,
                "how_the_track_was_read": list(one.run.said),
            }
            for one in fit.runs
        ],
        "rates": [
            {
                "name": rates.name,
                "motor_rpm": rates.motor_rpm.tolist(),
                "v": [_finite(v) for v in rates.data[:, 0]],
                "head_rate": [_finite(v) for v in rates.data[:, 1]],
                "fitted_v": rates.fitted[:, 0].tolist(),
                "fitted_head_rate": rates.fitted[:, 1].tolist(),
            }
            for rates in fit.rates
        ],
        "nuisances": {
            name: {"value": e.value, "std": _finite(e.std), "unit": fit.units.get(name, "1")}
            for name, e in fit.nuisances.items()
        },
        "correlation_from_frame_to_frame": fit.memory,
        "decisions": list(fit.said),
        "iterations": fit.iterations,
        "previews": fit.previews,
        "whole_simulations": fit.simulations,
        "wall_time_s": round(fit.wall_time, 3),
        "dataset": None if fit.dataset.path is None else str(fit.dataset.path),
        "derjax": version("derjax"),
    }


def as_unit(fit: Fit, name: str) -> str:
    """The unit of a parameter or nuisance; "1" if it has none."""
    return fit.units.get(name, unit_of(name))


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


def table(fit: Fit) -> str:
    """The parameters with standard error and 95 % interval, one a line."""
    width = max(len(name) for name in fit.estimates)
    lines = []
    for name, e in fit.estimates.items():
        unit = as_unit(fit, name)
        unit = "" if unit == "1" else f" {unit}"
        if math.isfinite(e.std):
            # Two significant digits of the error, and the value to the same place.
            places = max(0, 1 - math.floor(math.log10(e.std))) if e.std > 0 else 6
            places = min(places, 12)
            low, high = (f"{end:.{places}f}" for end in e.ci95)
            lines.append(
                f"{name:<{width}} = {e.value:.{places}f} +- {e.std:.{places}f}{unit} "
                f"(95 %: {low} to {high})"
            )
        else:
            lines.append(f"{name:<{width}} = {e.value:.6g}{unit} (not determined)")
    return "\n".join(lines)


def rms(of_kinds: Mapping[str, float]) -> str:
    """Root mean squares of residuals (m, rad) in words."""
    parts = []
    if "position" in of_kinds:
        parts.append(f"{1e3 * of_kinds['position']:.4g} mm")
    if "head_angle" in of_kinds:
        parts.append(f"{of_kinds['head_angle']:.4g} rad")
    if "speed" in of_kinds:
        parts.append(f"{1e3 * of_kinds['speed']:.4g} mm/s")
    if "head_rate" in of_kinds:
        parts.append(f"{of_kinds['head_rate']:.4g} rad/s")
    return ", ".join(parts)


def as_json(profiles: Sequence[Profile], drawn: Posterior | None) -> dict[str, Any]:
    """Profiles and posterior as they are written to fit.json."""
    content: dict[str, Any] = {}
    if profiles:
        content["profiles"] = {
            one.name: {
                "ci95": [_finite(end) for end in one.ci95],
                "values": one.values.tolist(),
                "rise_of_loss": one.rise.tolist(),
            }
            for one in profiles
        }
    if drawn is not None:
        content["posterior"] = {
            "mean": drawn.mean(),
            "std": drawn.std(),
            "ci95": drawn.ci95(),
            "r_hat": dict(zip(drawn.names, drawn.r_hat.tolist(), strict=True)),
            "effective_draws": dict(zip(drawn.names, drawn.effective.tolist(), strict=True)),
            "divergences": drawn.divergences,
        }
    return content


def write(
    fit: Fit, output: Output, figures: bool = True, more: Mapping[str, Any] | None = None
) -> tuple[Path, ...]:
    """Write fit.json and, if wanted, fit.png into a directory; returns their paths.

    Args:
        fit: what was found.
        output: where to.
        figures: whether figures are wanted.
        more: for fit.json.
    """
    with output.replacing(REPORT) as temporary:
        text = json.dumps({**as_dict(fit), **(more or {})}, indent=2, allow_nan=False)
        temporary.write_text(text + "\n", encoding="utf-8")
    if not figures:
        return (output.path / REPORT,)
    with output.replacing(FIGURE) as temporary:
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # slow to import

        FigureCanvasAgg(figure(fit)).print_figure(str(temporary), format="png", dpi=150)
    return output.path / REPORT, output.path / FIGURE


def figure(fit: Fit) -> "Figure":
    """Tracks over the simulation before and after the fit, one column a run.

    Rows: displacement along x (or the first coordinate tracked), head angle, residuals.
    """
    from matplotlib.figure import Figure

    tracked = {channel for one in fit.runs for channel in one.run.channels}
    rows = [c for c in (min(tracked - {ANGLE}, default=None), ANGLE) if c in tracked]
    if fit.rates:
        rows = [next((c for c in rows if c != ANGLE), 0), ANGLE]
    columns = len(fit.runs) + len(fit.rates)
    canvas = Figure(figsize=(max(5.0, 3.6 * columns), 2.5 * (len(rows) + 1)), layout="constrained")
    axes = canvas.subplots(len(rows) + 1, columns, squeeze=False, sharex="col")
    for column, one in enumerate(fit.runs):
        for row, channel in enumerate(rows):
            _motion(axes[row, column], one, channel)
        _residuals(axes[-1, column], one)
        rates = np.atleast_1d([] if one.run.motor_rpm is None else one.run.motor_rpm)
        rpm = f" ({', '.join(f'{rate:g}' for rate in rates)} rpm)" if rates.size else ""
        axes[0, column].set_title(f"{one.run.name}{rpm}", fontsize=9)
        axes[-1, column].set_xlabel("time (s)")
    for column, rates in enumerate(fit.rates, len(fit.runs)):
        rates_panels(list(axes[:, column]), rates)
    for row, channel in enumerate(rows if fit.runs else ()):
        label = "head angle (rad)" if channel == ANGLE else f"{CHANNELS[channel]} moved by (mm)"
        axes[row, 0].set_ylabel(label)
    if fit.runs:
        axes[-1, 0].set_ylabel("simulation − track")  # noqa: RUF001
    axes[0, 0].legend(fontsize=8, frameon=False)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=8)
    values = ",  ".join(f"{name} = {value:.4g}" for name, value in fit.values.items())
    canvas.suptitle(f"{values}   ({fit.status})", fontsize=11)
    return canvas


def rates_panels(axes: "Sequence[Axes]", rates: RateFit) -> None:
    """Speed, head rate, and what is left of both, over the rate of the motors."""
    order = np.argsort(rates.motor_rpm)
    rpm = rates.motor_rpm[order]
    for axis, channel, scale, label in (
        (axes[0], 0, 1e3, "speed (mm/s)"),
        (axes[1], 1, 1.0, "head rate (rad/s)"),
    ):
        data, std = scale * rates.data[order, channel], scale * rates.std[order, channel]
        axis.plot(
            rpm, scale * rates.fitted[order, channel], color=AFTER, lw=1.5, label="after the fit"
        )
        error = np.nan_to_num(std)
        axis.errorbar(
            rpm, data, error, ls="none", marker="o", ms=3, mfc="none", color=TRACK, label="measured"
        )
        axis.set_ylabel(label)
        left = (rates.fitted - rates.data)[order, channel] / np.nanmax(
            np.abs(rates.data[:, channel])
        )
        axes[-1].plot(
            rpm, 100 * left, "o-", ms=3, lw=0.8, color=AXES[3 * channel], label=label.split(" (")[0]
        )
    axes[-1].axhline(0.0, color=BEFORE, lw=0.8)
    axes[-1].set_ylabel("simulation − measured (%)")  # noqa: RUF001
    axes[-1].set_xlabel("motor (rpm)")
    axes[-1].legend(fontsize=7, frameon=False)
    axes[0].set_title(rates.name, fontsize=9)


def _motion(axis: "Axes", one: RunFit, channel: int) -> None:
    """One channel of a run: the track as points, the simulations as lines."""
    run, scale = one.run, 1.0 if channel == ANGLE else 1e3
    if channel not in run.channels:
        axis.set_axis_off()
        return
    values = run.values[:, run.channels.index(channel)]
    # Positions are shown from where the fitted simulation starts.
    zero = 0.0 if channel == ANGLE else float(one.after.observed[0, channel])
    track = values - zero
    if run.free_origin and channel != ANGLE:
        track = track + _offset(one, one.after, channel)

    def line(simulated: SimulatedTrack, **style: Any) -> None:
        shown = simulated.time <= run.time[-1] * (1 + 1e-9)
        axis.plot(
            simulated.time[shown], scale * (simulated.observed[shown, channel] - zero), **style
        )

    if one.before is not None:
        line(one.before, color=BEFORE, lw=1.5, label="before the fit")
    line(one.after, color=AFTER, lw=1.5, label="after the fit")
    every = max(1, len(run.time) // 40)
    axis.plot(
        run.time[::every],
        scale * track[::every],
        ls="none",
        marker="o",
        ms=3,
        mfc="none",
        mec=TRACK,
        label="track",
    )


def _offset(one: RunFit, simulated: SimulatedTrack, channel: int) -> float:
    """What is added to a track of free origin to lie on the simulation (m)."""
    run = one.run
    # The simulation of a fit that was stopped early may be shorter than the track.
    seen = run.time <= max(simulated.time[-1], run.time[0])
    at_frames = np.interp(run.time[seen], simulated.time, simulated.observed[:, channel])
    return float(np.mean(at_frames - run.values[seen, run.channels.index(channel)]))


def _residuals(axis: "Axes", one: RunFit) -> None:
    """Residuals of all channels of a run, positions in mm and angles in units of 0.1 rad."""
    axis.axhline(0.0, color=BEFORE, lw=0.8)
    for place, channel in enumerate(one.run.channels):
        angle = channel == ANGLE
        scale, unit = (10.0, "0.1 rad") if angle else (1e3, "mm")
        axis.plot(
            one.run.time,
            scale * one.residuals[:, place],
            color=AXES[channel],
            lw=0.9,
            label=f"{'angle' if angle else CHANNELS[channel]} ({unit})",
        )
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + 0.35 * (high - low))  # room for the legend
    axis.legend(fontsize=7, frameon=False, ncols=2, loc="upper right")
