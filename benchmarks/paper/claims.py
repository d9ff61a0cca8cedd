"""What the paper says of its robots, and for which runs it holds."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd

V, SPIN, FORCE, ETA = (
    "v_x_m_per_s",
    "head_rate_rad_per_s",
    "propulsive_force_per_flagellum_N",
    "efficiency",
)
BUNDLED, TOUCHING = "bundle_fraction", "contact_count"
BUNDLE = 0.2
"""The part of the flagella that is near another one from which on it is called a bundle."""

Values = Mapping[float, float]
"""By pitch over radius."""


class Claim(NamedTuple):
    """A sentence of the paper on two flagella, as a condition on a number at the three pitches."""

    says: str
    column: str
    holds: Callable[[Values], bool]
    reason: str


def _is_extreme(which: Callable[..., float], ratio: float) -> Callable[[Values], bool]:
    return lambda values: which(values, key=lambda r: abs(values[r])) == ratio


ETA_LAW = (
    "eta = (3/4) (C_t/C_r) v / (r_h omega_h) for the paper's head: a lowest speed and a highest "
    "head rate at one pitch make eta lowest there, so that the paper's orderings exclude each other"
)

CLAIMS = (
    Claim("5: bundles", BUNDLED, lambda v: v[5] > BUNDLE, "in phase helices nest side by side"),
    Claim(
        "7: partial bundle",
        BUNDLED,
        lambda v: 0.02 < v[7] < BUNDLE,
        "Bu = 8 pi mu w a^2 L^4 / (EI h^2 ln(h / 2 r_0)) is 13 to 56: enough for a part of half a "
        "turn, which takes 214 (see Crossing and wrapping)",
    ),
    Claim("9: no bundle", BUNDLED, lambda v: v[9] < 0.02, "as above, with stiffer helices"),
    Claim(
        "9: continuous contact", TOUCHING, lambda v: v[9] > 0.0, "excludes the one above in phase"
    ),
    Claim("head rate highest at 7", SPIN, _is_extreme(max, 7), ETA_LAW),
    Claim("speed lowest at 7", V, _is_extreme(min, 7), ETA_LAW),
    Claim(
        "force per flagellum highest at 5",
        FORCE,
        _is_extreme(max, 5),
        "rigid flagella do that with eps < 0.55 mm; soft ones do not",
    ),
    Claim("force per flagellum lowest at 7", FORCE, _is_extreme(min, 7), "is the one on speed"),
    Claim(
        "efficiency highest at 7",
        ETA,
        _is_extreme(max, 7),
        "rigid flagella do that with eps < 0.59 mm; soft ones do not; " + ETA_LAW,
    ),
    Claim("efficiency lowest at 5", ETA, _is_extreme(min, 5), "thrust is lost in a bundle"),
)


def values_of(part: pd.DataFrame, column: str) -> dict[float, float]:
    """A number by pitch over radius."""
    return dict(zip(part["pitch/r"], part[column], strict=True))


def judged(pairs: pd.DataFrame, conditions: pd.DataFrame) -> pd.DataFrame:
    """One row for each claim: for which runs it holds, and what follows.

    Args:
        pairs: in phase and in antiphase, at every rate.
        conditions: in phase at one rate, with one thing changed; may be empty.
    """
    rows = []
    for claim in CLAIMS:
        held: dict[str, list[str]] = {}
        asked: dict[str, list[str]] = {}
        for (phase, rpm), part in pairs.groupby(["phase", "rpm"], sort=False):
            asked.setdefault(phase, []).append(f"{rpm:g}")
            if claim.holds(values_of(part, claim.column)):
                held.setdefault(phase, []).append(f"{rpm:g}")
        others, failing = [], []
        if len(conditions):
            for name, part in conditions.groupby("if", sort=False):
                good = claim.holds(values_of(part, claim.column))
                (others if good else failing).append(str(name))
        row = {"claim": claim.says}
        for phase, rates in asked.items():
            yes = held.get(phase, [])
            row[phase] = "all" if len(yes) == len(rates) else ", ".join(yes) or "none"
        every = row.get("in phase") == "all"
        row["at 50 rpm in phase also with"] = ", ".join(others)
        row["but not with"] = ", ".join(failing) if every else ""
        if every and not failing:
            row["verdict"] = "holds"
        elif held or others:
            row["verdict"] = "holds only under these conditions"
        else:
            row["verdict"] = "contradicts"
        row["why"] = claim.reason
        rows.append(row)
    return pd.DataFrame(rows)


def cycle(series: pd.DataFrame, skip: float = 30.0) -> tuple[float, float, float]:
    """Period (s), part of it that is bundled, and amplitude of the bundled part of a run.

    The period is that of the largest Fourier component slower than 5 s; the flagella count as
    bundled while the bundled part, averaged over 2 s, is above the middle of its range.
    """
    later = series[series["time"] > skip]
    step = float(np.diff(later["time"]).mean())
    smooth = later["bundle_fraction"].rolling(max(1, round(2 / step)), center=True).mean().dropna()
    values = smooth.to_numpy()
    low, high = np.quantile(values, [0.02, 0.98])
    power = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(len(values)), 8 * len(values)))
    rates = np.fft.rfftfreq(8 * len(values), step)
    slow = (rates > 1.0 / (len(values) * step)) & (rates < 0.2)
    period = 1.0 / rates[slow][np.argmax(power[slow])]
    return float(period), float(np.mean(values > 0.5 * (low + high))), float(high - low)
