"""What softness and contact make of the best pitch: two parts of `python -m benchmarks.design`."""

import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import derjax as dj
from fitting.design import Design, Search, design
from fitting.design.outcome import problem_of

from .design_rigid import PITCHES, RIGID, robot
from .tables import markdown

SOFT = 1.255e6
"""Pa: the robot's own Young's modulus."""

RATES = (30.0, 60.0, 90.0, 120.0, 150.0, 175.0, 200.0, 250.0, 300.0)

STABLE = {"growth_rate": (None, 0.0)}
SEARCH = Search(starts=2)


def softness(output: Path) -> str:
    """Optimal pitch over the rate of the motor, of rigid and soft robots."""
    rigid = _best(robot(RIGID))
    table = pd.DataFrame([_at(rpm, rigid) for rpm in RATES])
    table.to_csv(output / "design_softness.csv", index=False, float_format="%.6g")
    _softness_figure(table, rigid).savefig(output / "design_softness.png", dpi=150)
    formats = {
        "rpm": ".0f",
        "pitch / radius": ".3f",
        "speed (m/s)": ".4e",
        "1 % less at +-": ".2f",
        "speed at the rigid pitch (m/s)": ".4e",
        "growth rate (1/s)": ".3f",
        "pitch / radius, stable": ".3f",
        "speed, stable (m/s)": ".4e",
        "growth rate, stable (1/s)": ".3f",
    }
    return (
        f"Best pitch of the robot with one flagellum ({SOFT:.4g} Pa, no inertia, bounds "
        f"{PITCHES[0]:g} and {PITCHES[1]:g} m) for speed, through steady states, without and with "
        "the constraint that these be stable (growth rate at most 0). A rigid robot has "
        f"{rigid / _radius(robot(RIGID)):.3f} at any rate of the motor, with the default "
        f"regularization, {1e3 * float(robot(SOFT).parameters['regularization']):.3f} mm, as here. "
        f"{_binding(table)}\n\n"
        + markdown(table, formats)
        + "\n![Best pitch over the rate of the motor](design_softness.png)"
    )


def _radius(scene: dj.Scene) -> float:
    return float(scene.parameters["helix_radius"])


def _best(scene: dj.Scene) -> float:
    found = design(scene, {"pitch": PITCHES}, maximise="speed", search=SEARCH)
    return found.values["pitch"]


def _at(rpm: float, rigid: float) -> dict:
    scene = robot(SOFT).replace(rpm=rpm)
    radius = _radius(scene)
    free = design(scene, {"pitch": PITCHES}, maximise="speed", search=SEARCH)
    kept = design(scene, {"pitch": PITCHES}, maximise="speed", limits=STABLE, search=SEARCH)
    there = dj.steady(scene.replace(pitch=rigid))
    return {
        "rpm": rpm,
        "pitch / radius": free.values["pitch"] / radius,
        "speed (m/s)": free.objective,
        "1 % less at +-": free.sensitivities["pitch"].tolerance / radius,
        "speed at the rigid pitch (m/s)": abs(float(there.speed)) if there.ok else np.nan,
        "growth rate (1/s)": _growth(free.scene),
        "pitch / radius, stable": kept.values["pitch"] / radius,
        "speed, stable (m/s)": kept.objective,
        "growth rate, stable (1/s)": kept.quantities["growth_rate"],
        "at bounds": " ".join(free.at_bounds),
        "binding": " ".join(kept.binding),
        "status": free.status,
        "status, stable": kept.status,
    }


def _growth(scene: dj.Scene) -> float:
    return dj.stability(dj.steady(scene)).growth_rate


def _binding(table: pd.DataFrame) -> str:
    """Where the constraint begins to bind."""
    rates, growth = table["rpm"].to_numpy(), table["growth rate (1/s)"].to_numpy()
    above = np.flatnonzero(growth > 0.0)
    if not len(above):
        return f"The constraint does not bind up to {rates[-1]:.0f} rpm."
    k = above[0]
    if k == 0:
        return "The constraint binds at all of these rates."
    begins = np.interp(0.0, growth[k - 1 : k + 1], rates[k - 1 : k + 1])
    return (
        f"The constraint binds from {rates[k]:.0f} rpm on, not yet at {rates[k - 1]:.0f} rpm; "
        f"by interpolation of the growth rate at the best pitch it begins at {begins:.0f} rpm."
    )


def _softness_figure(table: pd.DataFrame, rigid: float) -> plt.Figure:
    fig, (above, below) = plt.subplots(
        2, 1, figsize=(6.5, 6), sharex=True, height_ratios=(3, 2), layout="constrained"
    )
    rates = table["rpm"]
    ratio = rigid / _radius(robot(RIGID))
    above.axhline(ratio, color="0.4", ls="--", lw=1.2, label="rigid")
    best, tolerance = table["pitch / radius"], table["1 % less at +-"]
    above.fill_between(
        rates, best - tolerance, best + tolerance, color="C0", alpha=0.15, lw=0, label="within 1 %"
    )
    above.plot(rates, best, "o-", color="C0", ms=4, label="soft")
    above.plot(
        rates, table["pitch / radius, stable"], "s--", color="C3", ms=4, label="soft, and stable"
    )
    above.set(ylabel="best pitch / radius")
    above.legend(fontsize=8, loc="upper left")
    below.axhline(0.0, color="0.3", lw=0.8)
    below.plot(rates, table["growth rate (1/s)"], "o-", color="C0", ms=4)
    below.plot(rates, table["growth rate, stable (1/s)"], "s--", color="C3", ms=4)
    below.set(xlabel="rate of the motor, rpm", ylabel="growth rate, 1/s")
    for axes in (above, below):
        axes.grid(alpha=0.3)
    return fig


CONTACT_RATES = (60.0, 30.0, 120.0)
CONTACT_PITCHES = (0.025, 0.06)
CONTACT_END, CONTACT_BEGIN = 6.0, 3.0
"""s: end of a run, and from when on its speed is measured."""

COARSE = 0.01
"""m: edges of two flagella."""

SCAN = 17
"""Runs over pitch."""

LONGEST = 900.0
"""s, after which no further rate of the motor is begun."""


def pair(rpm: float) -> dj.Scene:
    """Two flagella that turn alike, from rest."""
    return dj.build(
        dj.robots.two_flagella(
            edge_length=COARSE, rpm=rpm, time={"end": CONTACT_END, "inertia": False}
        )
    )


def contact(output: Path) -> str:
    """Optimal pitch of two flagella, through runs from rest."""
    rows, began = [], time.perf_counter()
    for rpm in CONTACT_RATES:
        if time.perf_counter() - began > LONGEST / 2:
            break
        rows.append(_pair_at(rpm))
    table = pd.DataFrame(rows)
    table.to_csv(output / "design_contact.csv", index=False, float_format="%.6g")
    formats = {
        "rpm": ".0f",
        "pitch / radius": ".3f",
        "at start": ".3f",
        "speed (m/s)": ".4e",
        "at start (m/s)": ".4e",
        "clearance (m)": ".2e",
        "designs": "d",
        "status": "",
        "wall time (s)": ".0f",
        "processor time (s)": ".0f",
    }
    along = _scan(pair(CONTACT_RATES[0]))
    along.to_csv(output / "design_contact_scan.csv", index=False, float_format="%.6g")
    _contact_figure(along, rows[0]).savefig(output / "design_contact.png", dpi=150)
    closest = table["clearance (m)"].min()
    says = (
        "Below zero, flagella touch during the run (contact is soft)."
        if closest < 0.0
        else "All clearances are above zero: at these designs the flagella do not touch."
    )
    return (
        f"Speed of the robot with two flagella from {CONTACT_BEGIN:g} to {CONTACT_END:g} s of a "
        f"run from rest, made large by the pitch (from {CONTACT_PITCHES[0]:g} to "
        f"{CONTACT_PITCHES[1]:g} m), with derivatives through the run, contact included. Edges of "
        f"{COARSE:g} m, no inertia. Clearance: the smallest distance between the surfaces of the "
        f"flagella in the run. {says} Times are of the whole search, "
        "compilation included.\n\n"
        + markdown(table, formats)
        + f"\nThe figure has runs at {SCAN} pitches and {CONTACT_RATES[0]:g} rpm. "
        f"{_compared(along, rows[0])}\n\n"
        "![Speed and clearance over pitch](design_contact.png)"
    )


def _compared(along: pd.DataFrame, best: dict) -> str:
    """The design against the best of the runs over pitch, and which of these failed."""
    top = along.loc[along["speed"].idxmax()]
    more = 100 * (top["speed"] / best["speed (m/s)"] - 1)
    says = f"The best of them, at {top['pitch / radius']:.3f}, is {abs(more):.2f} % "
    says += (
        "faster than the design: steps that adapt, and contact, leave small ripples on the speed, "
        "and the search ends on top of one."
        if more > 0
        else "slower than the design."
    )
    for row in along.loc[along["failure"] != ""].to_dict("records"):
        says += f" At {row['pitch / radius']:.3f} the run fails: {row['failure']}"
    return says


def _scan(scene: dj.Scene) -> pd.DataFrame:
    """Speed and clearance over pitch."""
    limits = {"clearance": (-1.0, None)}
    vary = {"pitch": CONTACT_PITCHES}
    evaluate = problem_of(
        scene, vary, "speed", None, limits, through="run", begin=CONTACT_BEGIN
    ).evaluator()
    rows = []
    for pitch in np.linspace(*CONTACT_PITCHES, SCAN):
        found = evaluate({"pitch": pitch})
        rows.append(
            {"pitch / radius": pitch / _radius(scene), **found.values, "failure": found.failure}
        )
    return pd.DataFrame(rows)


def _contact_figure(along: pd.DataFrame, best: dict) -> plt.Figure:
    fig, (above, below) = plt.subplots(
        2, 1, figsize=(6.5, 5), sharex=True, height_ratios=(3, 2), layout="constrained"
    )
    x = along["pitch / radius"]
    above.plot(x, 1e3 * along["speed"], "o-", color="C0", ms=4, label="runs")
    place = best["pitch / radius"]
    above.plot(place, 1e3 * best["speed (m/s)"], "*", color="C3", ms=14, label="design")
    above.set(ylabel="speed, mm/s")
    above.legend(fontsize=8)
    below.plot(x, 1e3 * along["clearance"], "o-", color="C0", ms=4)
    below.plot(place, 1e3 * best["clearance (m)"], "*", color="C3", ms=14)
    below.axhline(0.0, color="0.3", lw=0.8)
    below.set(xlabel="pitch / radius", ylabel="clearance, mm")
    for axes in (above, below):
        axes.grid(alpha=0.3)
    return fig


def _pair_at(rpm: float) -> dict:
    scene = pair(rpm)
    wall, spent = time.perf_counter(), time.process_time()
    found: Design = design(
        scene,
        {"pitch": CONTACT_PITCHES},
        maximise="speed",
        limits={"clearance": (-1.0, None)},  # never binds: to be told what it is
        through="run",
        begin=CONTACT_BEGIN,
        search=Search(starts=1, most=12, tolerance=1e-5),
    )
    radius = _radius(scene)
    return {
        "rpm": rpm,
        "pitch / radius": found.values["pitch"] / radius,
        "at start": float(scene.parameters["pitch"]) / radius,
        "speed (m/s)": found.objective,
        "at start (m/s)": np.nan if found.start is None else found.start.objective,
        "clearance (m)": found.quantities["clearance"],
        "designs": len(found.points),
        "failed": sum(not point.ok for point in found.points),
        "status": found.status,
        "wall time (s)": time.perf_counter() - wall,
        "processor time (s)": time.process_time() - spent,
    }
