"""The best rigid helices: of a swimming robot, of resistive force theory, and of a helix alone.

Two parts of `python -m benchmarks.design`. Known optima are from an independent calculation with
regularized Stokeslet segments, on fine meshes, and from closed forms of infinite helices.
"""

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import derjax as dj
from derjax.core.pytree import replace
from derjax.shapes import helix
from fitting.design import Design, Search, design

from .rigid import rigid_resistance, stokeslet_resistance
from .rodenborn import AXIAL_LENGTH, ROD_RADIUS
from .tables import markdown

Objective = Callable[[dj.Scene], jax.Array]

RIGID = 1.255e9
"""Pa: a thousand times that of the robot."""

RPM = 60.0
PITCHES = (0.02, 0.08)
"""m."""

KNOWN_SWIMMERS = {1: 5.46, 2: 5.66}
"""Best pitch / radius by the number of flagella."""

KNOWN_SPEEDS = {1: 0.506e-3 * RPM / 50, 2: 0.922e-3 * RPM / 50}
"""m/s there."""

SWIMMER_EDGES = 160
REGULARIZATION = 0.167e-3
"""m, of the fluid around rigid robots: what the known optima are for."""


def robot(youngs_modulus: float, **numbers: float) -> dj.Scene:
    """The robot with one flagellum, without inertia."""
    return dj.build(
        dj.robots.single_flagellum(
            youngs_modulus=youngs_modulus, rpm=RPM, time={"inertia": False}, **numbers
        )
    )


def swimming_speed(flagella: int) -> Objective:
    """Speed (m/s) of a head with rigid flagella on its axis that do not feel each other."""

    def of(scene: dj.Scene) -> jax.Array:
        numbers = scene.parameters
        shape = numbers["helix_radius"], numbers["pitch"], numbers["axial_length"]
        nodes = helix(*shape, SWIMMER_EDGES, "left")
        drag = stokeslet_resistance(nodes, numbers["viscosity"], numbers["regularization"])
        along, coupling, turn = _entries(flagella * rigid_resistance(nodes, drag))
        unit = jnp.pi * numbers["viscosity"] * numbers["head_radius"]
        head = 6 * unit * numbers["C_t"]
        spin = 8 * unit * numbers["head_radius"] ** 2 * numbers["C_r"]
        # No force and no torque in all; unknown are the speed and the rate of the head.
        matrix = jnp.array([[head + along, coupling], [coupling, spin + turn]])
        rate = numbers["rpm"] * 2 * jnp.pi / 60
        return jnp.abs(jnp.linalg.solve(matrix, -rate * jnp.stack([coupling, turn]))[0])

    return of


def _entries(matrix: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Axial resistance to translation, coupling, and resistance to rotation."""
    return matrix[0, 0], matrix[0, 3], matrix[3, 3]


def swimmers(output: Path) -> str:
    """Optimal pitch of rigid robots."""
    rows = []
    vary = {"pitch": PITCHES}
    for edge in (5e-3, 2.5e-3):
        scene = robot(RIGID, edge_length=edge, regularization=REGULARIZATION)
        found = design(scene, vary, maximise="speed", search=Search(starts=2))
        rows.append(
            _swimmer(f"1, steady states, edges of {1e3 * edge:g} mm", 1, found)
            | {"at known (m/s)": _speed(scene, KNOWN_SWIMMERS[1])}
        )
    scene = robot(RIGID, regularization=REGULARIZATION)
    radius = float(scene.parameters["helix_radius"])
    for flagella, known in KNOWN_SWIMMERS.items():
        objective = swimming_speed(flagella)
        found = design(scene, vary, maximise=objective, through="rest", search=Search(starts=2))
        there = float(objective(scene.replace(pitch=known * radius)))
        says = f"{flagella}, equations of rigid bodies, {SWIMMER_EDGES} edges"
        rows.append(_swimmer(says, flagella, found) | {"at known (m/s)": there})
    table = pd.DataFrame(rows)
    table["lost (%)"] = 100 * (1 - table["at known (m/s)"] / table["speed (m/s)"])
    table.to_csv(output / "design_rigid.csv", index=False, float_format="%.6g")
    formats = {
        "flagella": "",
        "pitch / radius": ".3f",
        "known": ".2f",
        "speed (m/s)": ".5e",
        "at known (m/s)": ".5e",
        "known (m/s)": ".4e",
        "lost (%)": ".4f",
        "1 % less at +-": ".2f",
    }
    return (
        f"Pitch of the helix that makes a rigid robot fastest, at {RPM:.0f} rpm, with its axial "
        f"length ({1e3 * float(scene.parameters['axial_length']):.1f} mm) and its radius "
        f"({1e3 * radius:.2f} mm) fixed and a regularization of {1e3 * REGULARIZATION:g} mm. "
        f"Rigid: Young's modulus {RIGID:.4g} Pa, "
        "and the search goes through steady states; or a head and rigid helices by equations of "
        "six numbers (an objective of one's own, `through='rest'`). There, two flagella count "
        "twice, and feel neither each other nor their distance from the axis. The optimum is so "
        "flat that what counts is what is lost at the known one.\n\n" + markdown(table, formats)
    )


def _speed(scene: dj.Scene, ratio: float) -> float:
    state = dj.steady(scene.replace(pitch=ratio * float(scene.parameters["helix_radius"])))
    state.raise_if_failed()
    return abs(float(state.speed))


def _swimmer(says: str, flagella: int, found: Design) -> dict:
    radius = float(found.scene.parameters["helix_radius"])
    return {
        "flagella": says,
        "pitch / radius": found.values["pitch"] / radius,
        "known": KNOWN_SWIMMERS[flagella],
        "speed (m/s)": found.objective,
        "known (m/s)": KNOWN_SPEEDS[flagella],
        "1 % less at +-": found.sensitivities["pitch"].tolerance / radius,
    }


ACROSS = 2.0
"""Drag across a filament over that along it."""

TURNS = (2, 4, 8, 16)
EDGES_PER_TURN = 60


def _resistive(scene: dj.Scene) -> tuple[jax.Array, jax.Array, jax.Array]:
    drag = dj.ResistiveDrag(jnp.asarray(1.0), jnp.asarray(ACROSS))
    return _entries(dj.resistance(replace(scene, terms=(drag,))))


def purcell(along: jax.Array, coupling: jax.Array, turn: jax.Array) -> jax.Array:
    """The largest efficiency that a helix can have, that with the best head."""
    rest = jnp.sqrt(1 - coupling**2 / (along * turn))
    return (1 - rest) / (1 + rest)


def purcell_resistive(scene: dj.Scene) -> jax.Array:
    """Largest efficiency, by resistive force theory."""
    return purcell(*_resistive(scene))


def advance(scene: dj.Scene) -> jax.Array:
    """Speed of a helix without head, over the speed at which its surface goes round."""
    along, coupling, _ = _resistive(scene)
    return jnp.abs(coupling / along) / scene.parameters["helix_radius"]


def thrust_per_torque(scene: dj.Scene) -> jax.Array:
    """Thrust times radius, over torque."""
    _, coupling, turn = _resistive(scene)
    return jnp.abs(coupling / turn) * scene.parameters["helix_radius"]


_HALF = (ACROSS - 1) / (2 * ACROSS**0.5)
INFINITE: dict[str, tuple[Objective, float, float]] = {
    "efficiency": (purcell_resistive, 1.0, ((ACROSS**0.5 - 1) / (ACROSS**0.5 + 1)) ** 2),
    "speed, no head": (advance, ACROSS**-0.5, _HALF),
    "thrust / torque": (thrust_per_torque, ACROSS**0.5, _HALF),
}
"""What is maximised; tangent of the best angle, and what it achieves, of infinite helices."""


def helices(output: Path) -> str:
    """Optimal rigid helices without head."""
    rows = []
    for name in INFINITE:
        finite = [_long(name, turns) for turns in TURNS]
        ends = {k: 2 * finite[-1][k] - finite[-2][k] for k in ("tangent", "value")}
        rows += [*finite, finite[-1] | ends | {"turns": "extrapolated"}]
    long = pd.DataFrame(rows)
    for off, of, true in (
        ("off (%)", "tangent", "infinite"),
        ("value off (%)", "value", "value, infinite"),
    ):
        long[off] = 100 * (long[of] / long[true] - 1)
    long.to_csv(output / "design_long_helices.csv", index=False, float_format="%.6g")
    alone = pd.DataFrame([_alone(name) for name in ALONE])
    alone.to_csv(output / "design_helix.csv", index=False, float_format="%.6g")
    return (
        "By resistive force theory, with a drag across the filament "
        f"{ACROSS:g} times that along it, the angle of an infinite helix that is best for "
        "something, and what it achieves, are known in closed form. The best pitch of helices of "
        f"some turns (counted at 45 degrees; {EDGES_PER_TURN} edges a turn, axial length fixed) "
        "tends to that; the tangent is that of the angle between filament and axis. Extrapolated: "
        "from 8 and 16 turns, with errors like one over the number of turns; what is left is that "
        "a turn is a polygon.\n\n"
        + markdown(
            long,
            {
                "best for": "",
                "turns": "",
                "tangent": ".4f",
                "infinite": ".4f",
                "off (%)": ".2f",
                "value": ".5f",
                "value, infinite": ".5f",
                "value off (%)": ".2f",
            },
        )
        + f"\nA helix of length {AXIAL_LENGTH} and rod radius {ROD_RADIUS} (its own radius, the "
        "rate of rotation and the viscosity are 1) by regularized Stokeslet segments, with "
        f"regularization sqrt(e) times the rod's radius and {N_EDGES} edges, against an "
        "independent calculation. Efficiency: Purcell's with the best head, "
        "(1 - s) / (1 + s) with s = sqrt(1 - B^2 / (A D)).\n\n"
        + markdown(
            alone,
            {
                "best for": "",
                "pitch / radius": ".3f",
                "known": ".2f",
                "value": ".5g",
                "value, known": ".4g",
                "lost at known (%)": ".4f",
            },
        )
    )


def _long(name: str, turns: int) -> dict:
    objective, tangent, value = INFINITE[name]
    radius = 0.01
    turn = 2 * np.pi * radius
    scene = dj.build(
        dj.robots.clamped(
            1,
            helix_radius=radius,
            pitch=turn,
            axial_length=turns * turn,
            edge_length=0.9999 * np.sqrt(2) * turn / EDGES_PER_TURN,
            rod_radius=1e-4,
            contact={"method": "none"},
            fluid={"hydrodynamics": "rft"},
        )
    )
    found = design(
        scene,
        {"pitch": (0.4 * turn, 2 * turn)},
        maximise=objective,
        through="rest",
        search=Search(starts=1),
    )
    return {
        "best for": name,
        "turns": f"{turns}",
        "tangent": turn / found.values["pitch"],
        "infinite": tangent,
        "value": found.objective,
        "value, infinite": value,
    }


N_EDGES = 200


def _stokeslets(scene: dj.Scene) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Of a helix of radius 1 whose pitch is that of the scene over the scene's radius."""
    ratio = scene.parameters["pitch"] / scene.parameters["helix_radius"]
    nodes = helix(1.0, ratio, AXIAL_LENGTH, N_EDGES, "left")
    drag = stokeslet_resistance(nodes, 1.0, np.sqrt(np.e) * ROD_RADIUS)
    return _entries(rigid_resistance(nodes, drag))


def thrust(scene: dj.Scene) -> jax.Array:
    """Of a helix that turns."""
    return jnp.abs(_stokeslets(scene)[1])


def thrust_over_torque(scene: dj.Scene) -> jax.Array:
    """Of a helix that turns."""
    _, coupling, turn = _stokeslets(scene)
    return jnp.abs(coupling / turn)


def free_speed(scene: dj.Scene) -> jax.Array:
    """Of a helix that turns and has no head."""
    along, coupling, _ = _stokeslets(scene)
    return jnp.abs(coupling / along)


def efficiency(scene: dj.Scene) -> jax.Array:
    """Purcell's, with the best head."""
    return purcell(*_stokeslets(scene))


ALONE: dict[str, tuple[Objective, float, float]] = {
    "thrust": (thrust, 5.91, 10.49),
    "thrust / torque": (thrust_over_torque, 7.84, 0.139),
    "speed, no head": (free_speed, 8.15, 0.278),
    "efficiency": (efficiency, 7.98, 0.00987),
}
"""What is maximised; the best pitch / radius, and what it achieves, by another code."""


def _alone(name: str) -> dict:
    objective, known, value = ALONE[name]
    scene = robot(RIGID)
    radius = float(scene.parameters["helix_radius"])
    found = design(
        scene,
        {"pitch": (3 * radius, 14 * radius)},
        maximise=objective,
        through="rest",
        search=Search(starts=2),
    )
    there = float(objective(scene.replace(pitch=known * radius)))
    return {
        "best for": name,
        "pitch / radius": found.values["pitch"] / radius,
        "known": known,
        "value": found.objective,
        "value, known": value,
        "lost at known (%)": 100 * (1 - there / found.objective),
    }
