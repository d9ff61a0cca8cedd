"""Which runs the claims are judged by."""

from itertools import product
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

import derjax as dj
from derjax.results.steady import row

from ..buckling import omega_bar
from .local import Filaments
from .runs import ANTIPHASE, IN_PHASE, RADIUS, Case, two_flagella

RATIOS = (5, 7, 9)
PHASES = {"in phase": IN_PHASE, "antiphase": ANTIPHASE}
EPS = (0.167e-3, 0.5e-3, 1.0e-3, 2.64e-3)
SEPARATIONS = (14e-3, 20e-3)
SWEPT_RPM, CHOSEN_RPM = (30, 40, 50, 60, 70), 50


class Length(NamedTuple):
    """How much is run: all of it, or what takes minutes."""

    end: float
    rates: tuple[int, ...]
    unbundling: float
    mismatches: tuple[float, ...]
    frictions: tuple[float, ...]
    separations: tuple[float, ...]
    phases: tuple[float, ...]
    moduli: tuple[float, ...]
    synchrony: float
    conditions: bool
    wrapping: dict[int, float]
    winding: float
    numbers: tuple[float, ...]


WHOLE = Length(
    end=60.0,
    rates=SWEPT_RPM,
    unbundling=300.0,
    mismatches=(1.0, 0.3, 2.0, 0.0),
    frictions=(0.0, 0.3, 0.6),
    separations=(14e-3, 28e-3, 20e-3),
    phases=(0.5, 1.5, 2.5, 3.1),
    moduli=(0.3e6, 0.6e6, 1.255e6, 2.5e6, 5e6, 20e6),
    synchrony=120.0,
    conditions=True,
    wrapping={2: 40.0, 3: 20.0, 5: 8.0},
    winding=200.0,
    numbers=(3.5, 5.0, 7.0, 10.0, 14.0, 28.0, 56.0, 100.0, 200.0, 400.0),
)
QUICK = Length(
    end=20.0,
    rates=(50,),
    unbundling=100.0,
    mismatches=(2.0,),
    frictions=(0.0,),
    separations=(20e-3,),
    phases=(1.5,),
    moduli=(1.255e6,),
    synchrony=30.0,
    conditions=False,
    wrapping={2: 6.0},
    winding=100.0,
    numbers=(3.5, 14.0),
)


def pairs(length: Length) -> list[Case]:
    """In phase and in antiphase, at every pitch and rate."""
    return [
        Case(
            f"pair-{name.replace(' ', '-')}-{ratio}-{rpm}",
            {"pitch/r": ratio, "rpm": rpm, "phase": name},
            two_flagella(ratio, length.end, robot={"phase": phase}, motor={"rpm": float(rpm)}),
        )
        for (name, phase), ratio, rpm in product(PHASES.items(), RATIOS, length.rates)
    ]


def conditions(length: Length) -> list[Case]:
    """What the claims depend on, one at a time, in phase at one rate."""
    if not length.conditions:
        return []
    varied: dict[str, dict[str, dict[str, Any]]] = {}
    for eps in EPS:
        varied[f"eps {1e3 * eps:g} mm"] = {"fluid": {"regularization": eps}}
    for separation in SEPARATIONS:
        varied[f"separation {1e3 * separation:g} mm"] = {"robot": {"separation": separation}}
    varied["friction 0.3"] = {"friction": {"coefficient": 0.3}}
    varied["published arm"] = {"head": {"arm": "published"}}
    varied["published hinge"] = {"motor": {"hinge": "published"}}
    varied["motors of limited torque"] = {}
    cases = []
    for (name, tables), ratio in product(varied.items(), RATIOS):
        motor: dict[str, Any] = {"rpm": float(CHOSEN_RPM)}
        if name == "motors of limited torque":
            motor = {"stall_torque": 2.9e-4, "free_rpm": 2.0 * CHOSEN_RPM}
        motor |= tables.get("motor", {})
        rest = {key: value for key, value in tables.items() if key != "motor"}
        label = name.replace(" ", "-").replace(".", "_")
        scene = two_flagella(ratio, length.end, motor=motor, **rest)
        cases.append(Case(f"if-{label}-{ratio}", {"pitch/r": ratio, "if": name}, scene))
    return cases


def unbundling(length: Length) -> list[Case]:
    """Motors of a little different rates, pitch over radius 5, in phase at the start."""
    cases = []
    choices = (length.mismatches, length.separations, length.frictions, ("rate", "torque"))
    for mismatch, separation, friction, kind in product(*choices):
        fast = CHOSEN_RPM + mismatch
        motor: dict[str, Any] = {"rpm": [float(CHOSEN_RPM), fast]}
        if kind == "torque":
            motor = {"stall_torque": 2.9e-4, "free_rpm": [2.0 * CHOSEN_RPM, 2.0 * fast]}
        tables: dict[str, dict[str, Any]] = {"robot": {"separation": separation}, "motor": motor}
        if friction:
            tables["friction"] = {"coefficient": friction}
        of = {"motor": kind, "mismatch_rpm": mismatch, "friction": friction}
        name = f"unbundling-{kind}-{mismatch:g}-{friction:g}-{1e3 * separation:g}"
        scene = two_flagella(5, length.unbundling, frame=0.2, **tables)
        of |= {"separation_mm": 1e3 * separation}
        cases.append(Case(name.replace(".", "_"), of, scene))
    return cases


TURN = 60.0 / CHOSEN_RPM
"""s, of the slower motor."""


def turn_of_phase() -> dj.Run:
    """A run over two turns of phase, with a frame for every turn of the slower motor."""
    name = "unbundling-rate-1-0-20"
    (case,) = [case for case in unbundling(WHOLE) if case.name == name]
    lap = 60.0 / case.of["mismatch_rpm"]
    time = {"end": 2.0 * lap, "frame": TURN}
    scene = dj.build(dj.SceneFile.from_dict({**case.tables, "time": time}))
    run = dj.rollout(scene, reverse_mode=False)
    run.raise_if_failed()
    return run


def synchrony(length: Length) -> list[Case]:
    """Motors of limited torque that start out of phase, on flagella of some stiffness.

    So far apart that they hardly touch: what couples them is the fluid, and the head.
    """
    return [
        Case(
            f"synchrony-{phase:g}-{modulus / 1e6:g}".replace(".", "_"),
            {"phase_at_start": phase, "youngs_modulus": modulus},
            two_flagella(
                5,
                length.synchrony,
                frame=0.2,
                robot={"phase": [0.0, phase], "separation": 40e-3},
                material={"youngs_modulus": modulus},
                motor={"stall_torque": 2e-4, "free_rpm": 200.0},
            ),
        )
        for phase, modulus in product(length.phases, length.moduli)
    ]


PUBLISHED = Filaments(0.2, 0.01, 1e-3, 0.03, 3e6, 0.1)
PUBLISHED_RATE = 15.0
"""rad/s."""


def clamped(count: int, rate: float, end: float, frame: float) -> dict[str, dict[str, Any]]:
    """Filaments on fixed motors, as published for another code; see `benchmarks.many_flagella`.

    Args:
        count: of filaments.
        rate: rad/s, of the motors.
        end, frame: s.
    """
    return {
        "robot": {
            "kind": "clamped",
            "n_flagella": count,
            "helix_radius": PUBLISHED.radius,
            "pitch": 0.05,
            "axial_length": PUBLISHED.length,
            "rod_radius": PUBLISHED.rod_radius,
            "edge_length": 0.0048,
            "separation": PUBLISHED.separation,
            "handedness": "right",
        },
        "material": {"youngs_modulus": PUBLISHED.youngs_modulus, "density": 1000.0},
        "fluid": {"regularization": 1.02e-3, "viscosity": PUBLISHED.viscosity},
        "motor": {"rpm": -rate * 30.0 / np.pi},
        "contact": {"stiffness": 1e4},
        "time": {"end": end, "frame": frame, "scheme": "trbdf2", "tolerance": 2.5e-4},
    }


def wrapping(length: Length) -> list[Case]:
    """The published filaments, of several numbers."""
    return [
        Case(f"wrapping-{count}", {"flagella": count}, clamped(count, PUBLISHED_RATE, end, 0.1))
        for count, end in length.wrapping.items()
    ]


def winding(length: Length) -> list[Case]:
    """Two of the published filaments at lower rates, which is a lower Bu and nothing else."""
    unit = PUBLISHED.number(1.0)
    return [
        Case(
            f"winding-{number:g}".replace(".", "_"),
            {"Bu": number},
            clamped(2, number / unit, length.winding, 0.5),
        )
        for number in length.numbers
    ]


def single(rates: int = 30) -> pd.DataFrame:
    """Steady states of the robot with one flagellum, omega_bar of 10 to 400."""
    rows = []
    for ratio in RATIOS:
        file = dj.SceneFile.from_dict(
            {"robot": {"pitch": ratio * RADIUS, "helix_radius": RADIUS}, "motor": {"rpm": 10.0}}
        )
        unit = omega_bar(file, 1.0)
        scene = dj.build(file)
        rpm = np.linspace(10.0 / unit, 400.0 / unit, rates)
        length = None
        for value, state in zip(rpm, dj.steady_curve(scene, "rpm", rpm), strict=False):
            if not state.ok:
                break
            numbers = row(state)
            length = numbers["tail_to_head_m"] if length is None else length
            rows.append(
                {
                    "pitch/r": ratio,
                    "rpm": value,
                    "omega_bar": value * unit,
                    "shortening": numbers["tail_to_head_m"] / length,
                    **numbers,
                }
            )
    return pd.DataFrame(rows)
