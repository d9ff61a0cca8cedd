"""A picture of a track over time: what was found, what is missing, what is odd."""

from matplotlib.figure import Figure

from ..observe import ANGLE, CHANNELS
from .understood import Understood

TRACK, GAP, ODD = "#2f6fb0", "#e3e5e9", "#c8442b"


def figure(one: Understood) -> Figure:
    """One row for each channel; gaps are grey, outliers have a ring."""
    track = one.track
    count = len(track.channels)
    canvas = Figure(figsize=(8.0, 1.0 + 1.7 * count), layout="constrained")
    axes = canvas.subplots(count, 1, squeeze=False, sharex=True)[:, 0]
    for column, axis in enumerate(axes):
        channel = track.channels[column]
        values, odd = one.shown(column), one.outliers[:, column]
        for k, (start, end, _) in enumerate(one.gaps):
            axis.axvspan(start, end, color=GAP, lw=0, label="no frames" if k == 0 else None)
        axis.plot(track.time, values, ".-", color=TRACK, ms=3, lw=0.6)
        if odd.any():
            axis.plot(track.time[odd], values[odd], "o", mfc="none", mec=ODD, ms=9, label="outlier")
        unit = "rad" if channel == ANGLE else one.length_unit
        axis.set_ylabel(f"{CHANNELS[channel].replace('_', ' ')} ({unit})")
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=8)
        if axis.get_legend_handles_labels()[1]:
            axis.legend(fontsize=8, frameon=False, loc="best", ncols=2)
    axes[-1].set_xlabel(f"time ({one.time_unit})")
    canvas.suptitle(f"{one.path.name}: {one.settled.format.title}", fontsize=10)
    return canvas
