"""Whether a fit describes its tracks: numbers, and what they mean in words.

Three questions are asked of the residuals. Are they larger than the noise that was given
(chi^2)? Are they of one sign for many frames, or do they follow their neighbours (runs test of
Wald and Wolfowitz, Ann. Math. Stat. 11, 147, 1940; correlation from frame to frame)? And are they
larger than what a camera does? The second is asked of every channel of every run, and the
first of all together, so that noise which is estimated from the residuals hides nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .observe import ANGLE, CHANNELS
from .tracks import Run
from .uncertainty import Residuals

UNLIKELY = 1e-4
"""Probability below which residuals are not called chance, over all tests of a kind."""

FEW = 8
"""Frames below which the order of residuals says nothing."""

SMALL_PLACE, SMALL_ANGLE = 1e-4, 1e-3
"""Residuals below what cameras see, as a part of the robot's length and in rad: their order does
not matter."""

LARGE_PLACE, LARGE_ANGLE = 0.01, 0.1
"""Noise beyond that of any camera: as a part of the robot's length, and in rad. A robot that fills
a picture of a thousand pixels is seen to a thousandth of its length."""


@dataclass(frozen=True)
class Order:
    """Whether residuals of one channel of a run come in an order that chance would not make.

    Attributes:
        run: name of the track.
        channel: one of `CHANNELS`.
        autocorrelation: from frame to frame, between -1 and 1.
        runs: number of runs of one sign.
        expected_runs: number of them if signs were independent.
        p_value: the smaller probability of the two tests, doubled.
    """

    run: str
    channel: str
    autocorrelation: float
    runs: int
    expected_runs: float
    p_value: float


@dataclass(frozen=True)
class Goodness:
    """What the residuals say of a fit.

    Attributes:
        chi2: sum of squares in units of the noise that was given; None if none was.
        degrees_of_freedom: of those observations.
        p_value: probability of a larger chi2 by chance.
        orders: one for every channel of every run with enough frames.
        relative_rms: root mean square of the residuals of positions over the robot's length.
        inflation: by what error bars are larger than independent noise of the size that was given
            or found would make them.
        findings: sentences on what residuals are beside noise, empty if nothing is wrong.
        exaggeration: how many times the noise that was given is larger than the residuals; 1 if
            chance explains the difference.
    """

    chi2: float | None
    degrees_of_freedom: int
    p_value: float | None
    orders: tuple[Order, ...]
    relative_rms: float | None
    inflation: float
    findings: tuple[str, ...]
    exaggeration: float = 1.0

    @property
    def good(self) -> bool:
        """Whether nothing speaks against the fit."""
        return not self.findings

    def sentence(self) -> str:
        """The fit in words."""
        if self.findings:
            return "The simulation does not describe these tracks: " + "; ".join(self.findings)
        known = "the residuals are no larger than the noise given" if self.chi2 is not None else ""
        chance = "their order is that of chance" if self.orders else ""
        said = " and ".join(part for part in (known, chance) if part)
        return f"The simulation describes the tracks: {said}." if said else ""

    def remark(self) -> str:
        """What the residuals say of the noise that was given, in words; empty if it is right."""
        if self.exaggeration == 1.0:
            return ""
        return (
            f"The noise that was given is about {self.exaggeration:.2g} times larger than the "
            "residuals: sigma or sigma_angle is too large, and so are the errors."
        )


def goodness(
    residuals: Residuals,
    runs: Sequence[Run],
    values: Sequence[Float[np.ndarray, "f c"]],
    size: float,
) -> Goodness:
    """Judge the residuals at the best fit.

    Args:
        residuals: of all runs.
        runs: tracks.
        values: residuals (m, rad) of every run, NaN where a channel was not tracked.
        size: m, length of the robot.
    """
    from scipy import special  # slow to import

    findings: list[str] = []
    chi2 = p_value = None
    given = np.isfinite(residuals.sigma)
    count = max(1, int(given.sum()) - (residuals.degrees_lost if given.all() else 0))
    scale = exaggeration = 1.0
    if given.any():
        chi2 = float(np.sum((residuals.value[given] / residuals.sigma[given]) ** 2))
        p_value = float(special.chdtrc(count, chi2))
        if p_value < UNLIKELY:
            scale = float(np.sqrt(chi2 / count))
            findings.append(
                f"residuals exceed the noise that was given (chi^2 = {chi2:.4g} for {count} "
                f"degrees of freedom, that is {scale:.2g} times the noise)"
            )
        elif special.chdtr(count, chi2) < UNLIKELY:
            exaggeration = float(np.sqrt(count) / np.sqrt(max(chi2, np.finfo(float).tiny)))
    orders = tuple(
        order(run, column, value[:, column])
        for run, value in zip(runs, values, strict=True)
        for column, angle in enumerate(run.is_angle)
        if len(value) >= FEW
        and np.sqrt(np.mean(value[:, column] ** 2)) > (SMALL_ANGLE if angle else SMALL_PLACE * size)
    )
    ordered = [one for one in orders if one.p_value * len(orders) < UNLIKELY]
    if ordered:
        worst = min(ordered, key=lambda one: one.p_value)
        findings.append(
            f"residuals of {worst.channel} in {worst.run} are not noise: each follows the one "
            f"before (correlation {worst.autocorrelation:.2f}, {worst.runs} runs of one sign where "
            f"chance makes {worst.expected_runs:.0f}"
            + (f"; likewise {len(ordered) - 1} more)" if len(ordered) > 1 else ")")
        )
    relative, large = _sizes(residuals, size)
    findings += large
    memory = max((abs(one.autocorrelation) for one in ordered), default=0.0)
    memory = min(memory, 0.95)
    return Goodness(
        chi2=chi2,
        degrees_of_freedom=count,
        p_value=p_value,
        orders=orders,
        relative_rms=relative,
        inflation=scale * float(np.sqrt((1 + memory) / (1 - memory))),
        findings=tuple(findings),
        exaggeration=exaggeration,
    )


def order(run: Run, column: int, value: Float[np.ndarray, " f"]) -> Order:
    """Tests of the order of the residuals of one channel."""
    centred = value - value.mean()
    n = len(value)
    power = float(centred @ centred)
    correlation = float(centred[1:] @ centred[:-1]) / power if power > 0 else 0.0
    above = centred > 0
    plus, minus = int(above.sum()), int((~above).sum())
    found = 1 + int(np.count_nonzero(above[1:] != above[:-1]))
    expected = 1 + 2 * plus * minus / n
    spread = np.sqrt(max((expected - 1) * (expected - 2) / (n - 1), 1e-12))
    # Small samples of white noise have the mean correlation -1/n and about the variance 1/n.
    from scipy import special

    tests = (correlation + 1 / n) * np.sqrt(n), (expected - found) / spread
    p_value = min(1.0, 2 * min(float(special.ndtr(-max(z, 0.0))) for z in tests))
    return Order(run.name, CHANNELS[run.channels[column]], correlation, found, expected, p_value)


def _sizes(residuals: Residuals, size: float) -> tuple[float | None, list[str]]:
    """The rms of positions over the robot's length, and what is too large for a camera."""
    rms = residuals.rms()
    relative = rms["position"] / size if "position" in rms else None
    large = []
    unknown = ~np.isfinite(residuals.sigma)
    angle = residuals.kind == 1
    if relative is not None and relative > LARGE_PLACE and (unknown & ~angle).any():
        large.append(
            f"positions are off by {100 * relative:.2g} % of the robot's length "
            f"({rms['position']:.3g} m), far more than the error of a camera"
        )
    if (unknown & angle).any() and rms["head_angle"] > LARGE_ANGLE:
        large.append(
            f"the {CHANNELS[ANGLE]} is off by {rms['head_angle']:.3g} rad, far more than the error "
            "of a camera"
        )
    return relative, large
