"""Rigid helices turned and pulled in oil: derjax against the measurements of 2013.

Thrust and torque of a helix that turns about its axis, and drag of one that is pulled along
it, against its pitch: regularized Stokeslet segments with three regularizations, and two
resistive force theories, beside the experiment of Rodenborn et al. (PNAS 110, E338, 2013).

    python -m benchmarks.rodenborn [-o docs/figures]

writes rodenborn.csv (every computed point), rodenborn.png and rodenborn.md (the measured
pitches, with the deviations from experiment).
"""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pandas as pd

from benchmarks.rigid import (
    propulsion,
    resistive_resistance,
    rigid_resistance,
    stokeslet_resistance,
)
from derjax.shapes import helix
from derjax.terms.fluid.resistive import gray_hancock, lighthill

from .command import command_line

EXPERIMENT = Path(__file__).parent.parent / "data" / "rodenborn_2013.csv"
QUANTITIES = ("thrust", "torque", "drag")
AXIAL_LENGTH = 20.63  # helix radii
ROD_RADIUS = 0.0630  # helix radii
N_EDGES = 300

Model = Callable[[jax.Array], jax.Array]


@partial(jax.jit, static_argnames=("n_edges",))
def stokeslets(pitch: jax.Array, ratio: jax.Array, n_edges: int = N_EDGES) -> jax.Array:
    """(6, 6) resistance in units of viscosity and helix radius; `ratio`: eps / rod radius."""
    nodes = helix(1.0, pitch, AXIAL_LENGTH, n_edges, "left")
    return rigid_resistance(nodes, stokeslet_resistance(nodes, 1.0, ratio * ROD_RADIUS))


@partial(jax.jit, static_argnames=("law", "n_edges"))
def resistive(pitch: jax.Array, law: Callable, n_edges: int = N_EDGES) -> jax.Array:
    """(6, 6) resistance in units of viscosity and helix radius."""
    nodes = helix(1.0, pitch, AXIAL_LENGTH, n_edges, "left")
    drag = resistive_resistance(nodes, *law(1.0, pitch, ROD_RADIUS, 1.0))
    return rigid_resistance(nodes, drag)


MODELS: dict[str, Model] = {
    "RSS, eps = 1.649 a": partial(stokeslets, ratio=np.sqrt(np.e)),
    "RSS, eps = 1.02 a": partial(stokeslets, ratio=1.02),
    "RSS, eps = 0.104 a": partial(stokeslets, ratio=0.104),
    "RFT, Gray-Hancock": partial(resistive, law=gray_hancock),
    "RFT, Lighthill": partial(resistive, law=lighthill),
}
STYLES = {
    "RSS, eps = 1.649 a": ("#0b3c5d", "-"),
    "RSS, eps = 1.02 a": ("#328cc1", "-"),
    "RSS, eps = 0.104 a": ("#9cc9e8", "-"),
    "RFT, Gray-Hancock": ("#c8792b", "--"),
    "RFT, Lighthill": ("#8c4a1f", ":"),
}


def experiment() -> pd.DataFrame:
    """The measured points: columns pitch_over_radius, thrust, torque, drag."""
    return pd.read_csv(EXPERIMENT, comment="#")


def sweep(pitches: np.ndarray, models: Iterable[str] = tuple(MODELS)) -> pd.DataFrame:
    """Thrust, torque and drag by some models at some pitches (helix radii), one row each."""
    rows = []
    for name in models:
        for pitch in pitches:
            computed = propulsion(MODELS[name](jnp.asarray(pitch)))
            rows.append({"model": name, "pitch_over_radius": pitch, **computed})
    return pd.DataFrame(rows)


def table(measured: pd.DataFrame, computed: pd.DataFrame) -> str:
    """Markdown: computed values at the measured pitches and how far off they are."""
    lines = [
        "| quantity | pitch / R | experiment | " + " | ".join(MODELS) + " |",
        "|---|---|---|" + "---|" * len(MODELS),
    ]
    indexed = computed.set_index(["model", "pitch_over_radius"])
    for quantity in QUANTITIES:
        for point in measured.itertuples():
            reference = getattr(point, quantity)
            cells = []
            for name in MODELS:
                value = float(indexed.loc[(name, point.pitch_over_radius), quantity])
                cells.append(f"{value:.4g} ({100 * (value / reference - 1):+.0f} %)")
            row = (quantity, f"{point.pitch_over_radius:.3f}", f"{reference:.4g}", *cells)
            lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines) + "\n"


def figure(measured: pd.DataFrame, computed: pd.DataFrame, path: Path) -> None:
    """Three panels: thrust, torque and drag against pitch."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    labels = {
        "thrust": r"thrust  $F / \eta\omega R^2$",
        "torque": r"torque  $T / \eta\omega R^3$",
        "drag": r"drag  $D / \eta U R$",
    }
    figure, axes = plt.subplots(1, 3, figsize=(11, 4.0), layout="constrained")
    for axis, quantity in zip(axes, QUANTITIES, strict=True):
        for name, rows in computed.groupby("model", sort=False):
            colour, dashes = STYLES[name]
            rows = rows.sort_values("pitch_over_radius")
            label = name.replace("eps", r"$\varepsilon$").replace(" a", " $a$")
            axis.plot(
                rows.pitch_over_radius, rows[quantity], dashes, color=colour, label=label, lw=1.8
            )
        axis.errorbar(
            measured.pitch_over_radius,
            measured[quantity],
            yerr=0.03 * measured[quantity],
            fmt="o",
            color="black",
            ms=5,
            capsize=2,
            label="experiment (bars: digitisation, 3 %)",
            zorder=5,
        )
        axis.set(xlabel=r"pitch / helix radius  $\lambda/R$", ylabel=labels[quantity])
        axis.set(yscale="log", xlim=(1.5, 16))
        axis.yaxis.set_major_locator(mpl.ticker.LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
        axis.yaxis.set_major_formatter(mpl.ticker.StrMethodFormatter("{x:g}"))
        axis.yaxis.set_minor_formatter(mpl.ticker.NullFormatter())
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(axis="y", color="0.92")
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=160)
    plt.close(figure)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--points", type=int, default=18, help="pitches between the measured ones")
    options = parser.parse_args()
    measured = experiment()
    between = np.geomspace(2.0, 15.6, options.points)
    computed = sweep(np.concatenate([measured.pitch_over_radius, between]))
    computed.to_csv(options.output / "rodenborn.csv", index=False, float_format="%.6g")
    text = table(measured, computed)
    (options.output / "rodenborn.md").write_text(text, encoding="utf-8")
    figure(measured, computed, options.output / "rodenborn.png")
    print(text)


if __name__ == "__main__":
    main()
