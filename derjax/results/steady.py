"""What is said of steady states: the numbers of a row, and figures over a parameter."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..core.status import Status
from ..integrate.step import Scene
from ..rods.kinematics import positions
from ..steady.orbit import Orbit
from ..steady.solve import Steady
from ..terms.fluid.head import HeadDrag
from .mechanics import motor_torques
from .plots import FLAGELLUM, HEAD, MEAN, MM, STYLE

NAMES = (
    "v_m_per_s",
    "head_rate_rad_per_s",
    "tail_to_head_m",
    "propulsive_force_N",
    "torque_N_m",
    "efficiency",
    "growth_rate_per_s",
    "frequency_per_s",
    "iterations",
    "residual",
    "status",
)
"""Columns of `steady.csv` after the parameter that is varied; see `row`."""

WORDS = {Status.OK: "ok", Status.NOT_STEADY: "not steady"}
"""In the column `status`, where they are not "no steady state"."""

Row = dict[str, Any]


def motor_torque(state: Steady) -> Float[Array, ""]:
    """N m: with which the motor turns the flagellum against the head, or a held filament."""
    return motor_torques(state.scene, jax.tree.map(lambda leaf: leaf[None], state.state))[0, 0]


def row(state: Steady, growth_rate: float | None = None, frequency: float | None = None) -> Row:
    """The numbers of a steady state; None for what cannot be said.

    `v_m_per_s` is the speed along the axis about which the shape turns, `head_rate_rad_per_s` the
    rate at which the head turns about its own, `propulsive_force_N` the drag on the head at that
    speed, and `efficiency` is as in the summary of a run, F r_h / T. `frequency_per_s` is that of
    the leading mode in the laboratory.
    """
    numbers: Row = dict.fromkeys(NAMES)
    numbers |= {
        "status": WORDS.get(Status(int(state.status)), "no steady state"),
        "iterations": int(state.iterations),
        "residual": float(state.residual),
        "growth_rate_per_s": growth_rate,
        "frequency_per_s": frequency,
    }
    if not state.ok:
        return numbers
    numbers |= {
        "tail_to_head_m": float(state.tail_to_head),
        "torque_N_m": float(motor_torque(state)),
    }
    return numbers | _of_head(state.scene, float(state.speed), float(state.head_rate))


def _of_head(scene: Scene, speed: float, rate: float) -> Row:
    """What a head says: how fast it gets on and turns, and against which drag."""
    if scene.rod.topology.head is None:
        return {}
    numbers: Row = {"v_m_per_s": speed, "head_rate_rad_per_s": rate}
    heads = [term for term in scene.terms if isinstance(term, HeadDrag)]
    if len(heads) == 1:
        (head,) = heads
        force, torque = float(head.translation) * speed, float(head.spin) * abs(rate)
        numbers["propulsive_force_N"] = force
        numbers["efficiency"] = abs(force) * float(head.radius) / torque if torque > 0 else None
    return numbers


def orbit_row(orbit: Orbit, multiplier: complex | None = None) -> Row:
    """The numbers of an orbit, as those of a steady state: means over a turn of the motors.

    `torque_N_m` is the mean of all motors. The growth rate and the frequency are those of the
    largest Floquet `multiplier`, None if that is not known.
    """
    numbers: Row = dict.fromkeys(NAMES)
    numbers |= {"status": "ok", "iterations": orbit.iterations, "residual": orbit.residual}
    if multiplier is not None:
        exponent = np.log(complex(multiplier)) / orbit.period
        numbers["growth_rate_per_s"] = float(exponent.real)
        numbers["frequency_per_s"] = abs(float(exponent.imag)) / (2 * np.pi)
    states = orbit.one_turn()
    x = positions(orbit.scene.rod.topology, states.q)
    numbers["tail_to_head_m"] = float(jnp.mean(jnp.linalg.norm(x[:, -1] - x[:, 0], axis=-1)))
    if orbit.scene.rod.topology.motors:
        numbers["torque_N_m"] = float(jnp.mean(motor_torques(orbit.scene, states)))
    return numbers | _of_head(orbit.scene, orbit.speed, orbit.head_rate)


PANELS = (
    ("v_m_per_s", "speed (mm/s)", MM),
    ("head_rate_rad_per_s", "rate of the head (rad/s)", 1.0),
    ("tail_to_head_m", "head to tail (mm)", MM),
    ("torque_N_m", "torque of the motor (mN m)", 1e3),
    ("efficiency", "efficiency (%)", 100.0),
    ("growth_rate_per_s", "growth rate (1/s)", 1.0),
)
"""What `curves` draws: column, label, and unit."""


def curves(
    rows: Sequence[Mapping[str, Any]], name: str, unit: str, zeros: Sequence[float]
) -> Figure:
    """Numbers of steady states over a parameter: stable parts solid, unstable ones dashed.

    Args:
        rows: with the parameter under its name.
        name: of the parameter.
        unit: of the parameter.
        zeros: values at which stability changes, which are marked.
    """
    shown = [panel for panel in PANELS if any(row[panel[0]] is not None for row in rows)]
    with mpl.rc_context(STYLE):
        lines = -(-max(len(shown), 1) // 3)
        figure = Figure(figsize=(9.0, 2.6 * lines), layout="constrained")
        axes = figure.subplots(lines, min(3, max(len(shown), 1)), sharex=True, squeeze=False)
        for place, (column, label, scale) in zip(axes.flat, shown, strict=False):
            _curve(place, rows, name, column, scale)
            for value in zeros:
                place.axvline(value, color=HEAD, lw=0.8, ls=":")
            place.set_ylabel(label)
            if column == "growth_rate_per_s":
                place.axhline(0.0, color=MEAN, lw=0.6)
        for place in axes.flat[len(shown) :]:
            place.set_visible(False)
        for place in axes[-1]:
            place.set_xlabel(f"{name} ({unit})" if unit not in ("1", name) else name)
    return figure


def _curve(
    axes: Axes, rows: Sequence[Mapping[str, Any]], name: str, column: str, scale: float
) -> None:
    x = np.array([row[name] for row in rows], float)
    y = np.array([np.nan if row[column] is None else row[column] for row in rows], float) * scale
    grows = np.array([(row["growth_rate_per_s"] or -1.0) > 0 for row in rows])
    for chosen, style in ((~grows, "-"), (grows, "--")):
        joined = chosen | (np.roll(chosen, 1) & (np.arange(len(x)) > 0))
        axes.plot(x, np.where(joined, y, np.nan), style, color=FLAGELLUM, lw=1.4)
    axes.plot(x, y, ".", color=FLAGELLUM, ms=3)


def shapes(rows: Sequence[Mapping[str, Any]], nodes: np.ndarray, name: str) -> Figure:
    """Shapes of steady states from the side, coloured by the parameter.

    Args:
        rows: with the parameter under its name.
        nodes: (p, n, 3) m.
        name: of the parameter.
    """
    x = np.array([row[name] for row in rows], float)
    colours = mpl.colormaps["viridis"](np.linspace(0.0, 0.9, len(x)))
    chosen = np.unique(np.linspace(0, len(x) - 1, 6).round().astype(int))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 3.2), layout="constrained")
        axes = figure.subplots()
        for k in chosen:
            axes.plot(*(MM * nodes[k].T[:2]), color=colours[k], lw=1.6, label=f"{name} = {x[k]:g}")
        axes.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal", title="Steady shapes")
        axes.legend(frameon=False, loc="best", fontsize="small")
    return figure


def mode_picture(nodes: np.ndarray, mode: np.ndarray, title: str) -> Figure:
    """The shape, and what it becomes in the leading mode, at four phases, from the side and behind.

    Args:
        nodes: (n, 3) m.
        mode: (n, 3) complex displacement, in any unit.
        title: says which mode it is.
    """
    size = np.abs(mode).max()
    scale = 0.15 * np.linalg.norm(nodes[-1] - nodes[0]) / (size if size > 0 else 1.0)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 3.0), layout="constrained")
        side, behind = figure.subplots(1, 2, width_ratios=(2.2, 1.0))
        for axes, (i, j) in ((side, (0, 1)), (behind, (1, 2))):
            for k, phase in enumerate(np.arange(4) * np.pi / 2):
                moved = MM * (nodes + scale * (mode * np.exp(1j * phase)).real)
                axes.plot(moved[:, i], moved[:, j], color=HEAD, alpha=0.35 + 0.15 * k, lw=1.0)
            axes.plot(MM * nodes[:, i], MM * nodes[:, j], color=FLAGELLUM, lw=1.8)
            axes.set(xlabel=f"{'xyz'[i]} (mm)", ylabel=f"{'xyz'[j]} (mm)", aspect="equal")
        side.set_title(title)
    return figure
