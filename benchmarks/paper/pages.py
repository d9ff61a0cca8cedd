"""What the page says of each study: its table, its figures, its verdicts."""

from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from ..buckling import omega_bar, robot
from ..tables import markdown
from . import figures, studies
from .claims import cycle, judged
from .local import turned
from .runs import Case, Result, table_of

Finder = Callable[[list[Case]], dict[str, Result]]
"""Finds the results of runs, and makes those that are missing."""

MODEL = (1.0, 2.0, 3.5, 5.0, 6.0, 6.7, 7.1, 8.0, 10.0, 14.0, 20.0, 28.0, 40.0, 56.0)
"""Bu, at which the local model is solved; it takes long beyond, as the filaments wrap."""

JAM = (
    "Helices half a turn of phase apart overlap where their axes are closer than 2 (a + r_0) = "
    "15.9 mm, and next to the motors they cannot give way: at 14 mm, motors of prescribed rates "
    "push them through each other after half a turn of phase, and the run ends there; motors of "
    "limited torque do not."
)

STEP = (
    "Phases that slip by less than a turn have no period: motors of limited torque keep in step, "
    "and their bundles last."
)

PAPER_CYCLE = 60.0
"""s: 10 s of bundling and 50 s of unbundling, with motors that are good to 1 rpm."""


COLUMNS = {
    "if": "",
    "phase": "",
    "motor": "",
    "status": "",
    "pitch/r": "g",
    "rpm": "g",
    "omega_bar": ".1f",
    "flagella": "d",
    "v_x_m_per_s": ".4g",
    "v_m_per_s": ".4g",
    "head_rate_rad_per_s": ".3f",
    "propulsive_force_N": ".3g",
    "propulsive_force_per_flagellum_N": ".3g",
    "efficiency": ".3f",
    "shortening": ".4f",
    "bundle_fraction": ".1%",
    "linking_number": ".3f",
    "contact_count": ".1f",
    "mismatch_rpm": "g",
    "friction": "g",
    "separation_mm": "g",
    "one_turn_s": ".0f",
    "period_s": ".1f",
    "bundled_s": ".1f",
    "amplitude": ".1%",
    "mean": ".1%",
    "slipped_turns": ".2f",
    "phase_at_start": "g",
    "youngs_modulus": ".3g",
    "phase_at_10_s": ".3f",
    "phase_at_end": ".3f",
    "rate": ".3g",
    "simulated_s": ".3g",
    "tips_at_start_mm": ".3g",
    "tips_at_end_mm": ".3g",
    "tips_mm": ".1f",
    "closest_mm": ".2f",
    "Bu": "g",
    "turned": ".2f",
    "local model": ".2f",
}
"""How the numbers of every column are written."""

PAIR = (
    *("pitch/r", "rpm", "v_x_m_per_s", "head_rate_rad_per_s", "propulsive_force_per_flagellum_N"),
    *("efficiency", "bundle_fraction", "linking_number", "contact_count", "status"),
)


def shown(table: pd.DataFrame, *columns: str) -> str:
    """Some columns as Markdown."""
    return markdown(table, {name: COLUMNS[name] for name in columns})


def _save(figure: plt.Figure, output: Path, name: str) -> None:
    figure.savefig(output / f"paper_{name}.png", dpi=150)
    plt.close(figure)


def pairs(length: studies.Length, found: Finder, output: Path) -> str:
    results = found(studies.pairs(length))
    table = table_of(results)
    changed = table_of(found(studies.conditions(length)))
    _save(figures.pairs(table), output, "pairs")
    _save(figures.tracks(results), output, "tracks")
    claims = judged(table, changed)
    table.to_csv(output / "paper_pairs.csv", index=False, float_format="%.6g")
    text = "## Claims\n\nIn phase and in antiphase: the rates (rpm) at which it holds.\n\n"
    text += markdown(claims, dict.fromkeys(claims.columns, ""))
    text += "\n## Two flagella\n\n" + shown(table, "phase", *PAIR)
    text += "\n![Two flagella](paper_pairs.png)\n\n![Tracks](paper_tracks.png)\n"
    if len(changed):
        text += "\nIn phase at 50 rpm, with one thing changed:\n\n"
        text += shown(changed, "if", *(name for name in PAIR if name != "rpm"))
    return text


def single(length: studies.Length, found: Finder, output: Path) -> str:
    one = studies.single(30 if length is studies.WHOLE else 12)
    two = table_of(found(studies.pairs(length)))
    unit = omega_bar(robot(5), 1.0)
    _save(figures.single(one, two, unit), output, "single")
    one.to_csv(output / "paper_single.csv", index=False, float_format="%.6g")
    at = one.iloc[(one["omega_bar"] - 80.0).abs().groupby(one["pitch/r"]).idxmin()]
    text = "## One flagellum, steady\n\n"
    return (
        text
        + shown(
            at,
            *("pitch/r", "omega_bar", "v_m_per_s", "head_rate_rad_per_s", "propulsive_force_N"),
            *("efficiency", "shortening"),
        )
        + "\n![One flagellum](paper_single.png)\n"
    )


def unbundling(length: studies.Length, found: Finder, output: Path) -> str:
    results = found(studies.unbundling(length))
    rows = []
    for name, result in results.items():
        done = result.numbers["status"] == "ok"
        period, duty, amplitude = cycle(result.series) if done else (np.nan,) * 3
        mismatch = result.numbers["mismatch_rpm"]
        slipped = float(result.series["phase_difference"].iloc[-1]) / (2 * np.pi)
        if abs(slipped) < 1.0:
            period = duty = np.nan
        rows.append(
            {
                "name": name,
                **{k: result.numbers[k] for k in ("motor", "mismatch_rpm", "friction")},
                "separation_mm": result.numbers["separation_mm"],
                "one_turn_s": 60.0 / mismatch if mismatch else np.nan,
                "period_s": period,
                "bundled_s": duty * period,
                "amplitude": amplitude,
                "mean": result.numbers["bundle_fraction"],
                "slipped_turns": slipped,
                "status": result.numbers["status"],
            }
        )
    cycles = pd.DataFrame(rows)
    _save(figures.unbundling(results, cycles), output, "unbundling")
    cycles.to_csv(output / "paper_unbundling.csv", index=False, float_format="%.6g")
    text = (
        f"## Unbundling\n\nThe paper's cycle: 10 s bundled of {PAPER_CYCLE:g} s. {JAM} {STEP}\n\n"
    )
    text += shown(cycles, *cycles.columns[1:]) + "\n![Unbundling](paper_unbundling.png)\n"
    if length is not studies.WHOLE:
        return text
    film = output / "paper_unbundling.gif"
    if not film.exists():
        run = studies.turn_of_phase()
        run.film(film, fps=10, speed=10 * studies.TURN, begin=float(run.time[-1]) / 2)
    text += "\nOne turn of phase at a mismatch of 1 rpm and 20 mm, with a frame for every turn of "
    return text + f"the slower motor:\n\n![One turn of phase]({film.name})\n"


def approach(time: np.ndarray, phase: np.ndarray) -> float:
    """1/s, at which a difference of phase decays, from 2 s on and while it is above 0.1 rad."""
    size = np.abs(phase)
    chosen = (time >= 2.0) & (np.cumsum(size < 0.1) == 0)
    if chosen.sum() < 5:
        return float("nan")
    return -float(np.polyfit(time[chosen], np.log(size[chosen]), 1)[0])


def synchrony(length: studies.Length, found: Finder, output: Path) -> str:
    results = found(studies.synchrony(length))
    rows = []
    for result in results.values():
        phase = result.series["phase_difference"].to_numpy()
        time = result.series["time"].to_numpy()
        begin = min(int(np.searchsorted(time, 10.0)), len(time) - 1)
        rows.append(
            {
                "phase_at_start": result.numbers["phase_at_start"],
                "youngs_modulus": result.numbers["youngs_modulus"],
                "phase_at_10_s": phase[begin],
                "phase_at_end": phase[-1],
                "rate": approach(time, phase),
                "status": result.numbers["status"],
            }
        )
    rates = pd.DataFrame(rows)
    _save(figures.synchrony(results, rates), output, "synchrony")
    rates.to_csv(output / "paper_synchrony.csv", index=False, float_format="%.6g")
    text = "## Synchronisation\n\nRate: at which the difference of phase decays, 1/s. "
    closer = np.abs(rates["phase_at_end"]) < rates["phase_at_start"]
    text += f"Towards phase zero go {closer.sum()} of {len(rates)} pairs; "
    mean = rates.groupby("youngs_modulus")["rate"].mean()
    fastest = mean.index[mean.argmax()]
    text += f"the fastest are those of {fastest / 1e6:g} MPa"
    text += ", the softest that were tried.\n\n" if fastest == mean.index[0] else ".\n\n"
    return text + shown(rates, *rates.columns) + "\n![Synchronisation](paper_synchrony.png)\n"


def wrapping(length: studies.Length, found: Finder, output: Path) -> str:
    results = found(studies.wrapping(length))
    _save(figures.wrapping(results), output, "wrapping")
    table = pd.DataFrame(
        {
            "flagella": result.numbers["flagella"],
            "simulated_s": result.numbers["simulated_s"],
            "tips_at_start_mm": 1e3 * result.series["tip_to_tip"].iloc[0],
            "tips_at_end_mm": 1e3 * result.series["tip_to_tip"].iloc[-1],
            "linking_number": result.series["linking_number"].iloc[-1],
            "status": result.numbers["status"],
        }
        for result in results.values()
    )
    text = "## Wrapping\n\n" + shown(table, *table.columns)
    return text + "\n![Distance of tips](paper_wrapping.png)\n"


def winding(length: studies.Length, found: Finder, output: Path) -> str:
    results = found(studies.winding(length))
    model = pd.DataFrame({"Bu": MODEL, "turned": [half_turns(turned(n)) for n in MODEL]})
    rows = pd.DataFrame(
        [
            {
                "Bu": result.numbers["Bu"],
                "turned": half_turns(result.series["tip_turn"].to_numpy()),
                "local model": np.interp(result.numbers["Bu"], model["Bu"], model["turned"]),
                "tips_mm": 1e3 * result.series["tip_to_tip"].iloc[-1],
                "closest_mm": 1e3 * result.series["minimum_distance"].min(),
                "linking_number": result.series["linking_number"].iloc[-1],
                "status": result.numbers["status"],
            }
            for result in results.values()
        ]
    )
    rows.loc[rows["Bu"] > MODEL[-1], "local model"] = np.nan
    _save(figures.winding(rows, model), output, "winding")
    rows.to_csv(output / "paper_winding.csv", index=False, float_format="%.6g")
    text = "## Crossing and wrapping\n\nTwo of the published filaments at other rates, against the "
    text += "local model (`benchmarks/paper/local.py`); half turns of the tips about each other.\n"
    few = rows["turned"].iloc[0] / (rows["Bu"].iloc[0] / 8 / np.pi)
    text += f"While they are few, those that are simulated are {few:.2f} of Bu / 8; "
    text += f"half a turn is reached at Bu = {first_at(rows, 1.0):.0f} (local model: 7).\n\n"
    return text + shown(rows, *rows.columns) + "\n![Turn of the tips](paper_winding.png)\n"


def first_at(rows: pd.DataFrame, turned: float) -> float:
    """Bu at which the tips have turned so far (half turns); NaN if they do not."""
    far = rows[rows["turned"] >= turned]
    if far.empty or far.index[0] == 0:
        return float("nan")
    pair = rows.loc[far.index[0] - 1 : far.index[0]]
    return float(np.exp(np.interp(turned, pair["turned"], np.log(pair["Bu"]))))


def half_turns(angle: np.ndarray) -> float:
    """The turn (half turns) at the end of a run: the mean of its last tenth."""
    return float(np.abs(np.mean(angle[-max(1, len(angle) // 10) :])) / np.pi)


STUDIES: dict[str, Callable[[studies.Length, Finder, Path], str]] = {
    "pairs": pairs,
    "single": single,
    "unbundling": unbundling,
    "synchrony": synchrony,
    "wrapping": wrapping,
    "winding": winding,
}
