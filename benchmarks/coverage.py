"""How often the 95 % intervals of a fit contain the truth, and what ignoring something does.

The robot of data/camera at 30, 70 and 100 rpm, on a motor that bends alike at every angle, filmed
for four minutes at a frame a second after its transient, with all that a film of a tank has: noise
of 0.1 mm and 0.02 rad that goes on from frame to frame (correlation 0.6), 2 % of the frames off by
ten times as much, a motor that is off by 1 rpm, a tank that drifts, a robot that does not swim
quite along the camera's axis, and a phase that nobody knows. A hundred times:

    python -m benchmarks.coverage

Fits are those of `derjax fit`, on steady states that are replaced by polynomials of the parameters
so that a hundred cost little; a few are made in full, from a start that is off by a factor of two.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from derjax import SceneFile
from fitting import load_dataset
from fitting.joint.assemble import assemble
from fitting.joint.begin import beginning
from fitting.joint.file import NoiseFile, Nuisances
from fitting.joint.fit import calibrate_jointly, errors, search
from fitting.joint.gait import Gait, swum
from fitting.joint.maps import applied, drift, orientation
from fitting.joint.sources import Known, source
from fitting.joint.surrogate import basis
from fitting.tracks import Dataset, Run

from .tables import write

DATASET = Path(__file__).parents[1] / "data" / "camera" / "dataset.toml"
FIGURES = Path(__file__).parents[1] / "docs" / "figures"
TRUTH = {"C_t": 4.8, "C_r": 0.36}
RATES = (30.0, 70.0, 100.0)
TIME = np.arange(0.0, 240.0, 1.0)
NOISE = np.array([1e-4, 1e-4, 1e-4, 0.02])
"""m and rad."""
RHO, OUTLIERS, TIMES_AS_MUCH = 0.6, 0.02, 10.0
TILT, DRIFT, RPM = 0.05, 5e-6, 1.0
"""Standard deviations: rad, m/s, rpm."""
REACH = 0.08
"""Part of all numbers by which polynomials go beyond the truth to each side."""

NUISANCES = {
    "motor_rpm": {"std": RPM},
    "drift": {"std": DRIFT},
    "orientation": {"std": TILT},
}


@dataclass(frozen=True)
class Way:
    """A way to fit: what is taken into account.

    Attributes:
        nuisances: keys of `NUISANCES` that are.
        shape, correlated: of the noise.
    """

    nuisances: tuple[str, ...] = tuple(NUISANCES)
    shape: str = "student"
    correlated: bool = True


WAYS = {
    "all taken into account": Way(),
    "motor's rate ignored": Way(("drift", "orientation")),
    "drift ignored": Way(("motor_rpm", "orientation")),
    "direction ignored": Way(("motor_rpm", "drift")),
    "outliers ignored": Way(shape="gaussian"),
    "memory of the noise ignored": Way(correlated=False),
    "all ignored": Way((), "gaussian", False),
}


def scene() -> SceneFile:
    """The robot, on a motor on which it has a steady state."""
    file = load_dataset(DATASET).scene
    return file.model_copy(update={"motor": file.motor.model_copy(update={"hinge": "rigid"})})


def noise(rng: np.random.Generator) -> np.ndarray:
    """(f, 4) with memory and outliers."""
    new = rng.normal(size=(len(TIME), 4))
    error = np.zeros_like(new)
    error[0] = new[0]
    for k in range(1, len(TIME)):
        error[k] = RHO * error[k - 1] + np.sqrt(1 - RHO**2) * new[k]
    wrong = rng.random((len(TIME), 4)) < OUTLIERS
    return NOISE * (error + wrong * TIMES_AS_MUCH * rng.normal(size=error.shape))


def dataset(way: Way, robot: SceneFile, tracks: Sequence[np.ndarray]) -> Dataset:
    """Tracks as a film gives them, to be fitted in some way."""
    known = {name: NUISANCES[name] for name in way.nuisances}
    # The direction of a steady track is estimated unless it is known.
    known.setdefault("orientation", {"std": 1e-6})
    runs = []
    for rpm, values in zip(RATES, tracks, strict=True):
        runs.append(
            Run(
                f"rpm{rpm:g}",
                TIME,
                (0, 1, 2, 3),
                values,
                rpm,
                steady=True,
                free_origin=True,
                nuisances=Nuisances.model_validate(known),
            )
        )
    shape = NoiseFile.model_validate({"shape": way.shape, "correlated": way.correlated})
    return Dataset(robot, tuple(runs), noise=shape)


class World:
    """Films of the robot, with everything that is not known drawn anew.

    Attributes:
        robot: its scene.
    """

    def __init__(self) -> None:
        self.robot = scene()
        self.polynomials = [quick(self.robot, rpm) for rpm in RATES]
        self.known = [
            source(self.robot, rpm, (*TRUTH, "rpm"))(np.array([*TRUTH.values(), rpm]))
            for rpm in RATES
        ]

    def tracks(self, seed: int) -> list[np.ndarray]:
        """(f, 4) for every rate."""
        rng = np.random.default_rng(seed)
        found = []
        for known in self.known:
            off = RPM * rng.normal()
            gait = Gait.of(jnp.asarray(known.gait + known.jacobian[:, -1] * off))
            numbers = np.r_[TILT * rng.normal(size=2), DRIFT * rng.normal(size=3)]
            track = swum(gait, jnp.asarray(TIME), 0.0, rng.uniform(0, 2 * np.pi))
            maps = (orientation(("y", "z")), drift(("x", "y", "z")))
            seen = applied(maps, track, jnp.asarray(TIME), jnp.asarray(numbers))
            origin = np.r_[0.01 * rng.normal(size=3), rng.normal()]
            found.append(np.asarray(seen) + origin + noise(rng))
        return found


class Quick:
    """The gait of a steady state, as a polynomial of second degree around the truth.

    It stands for the solver of steady states in a hundred fits: what is asked here is whether
    errors are right, and they are those of the same model that made the tracks.
    """

    def __init__(self, known: np.ndarray, coefficients: np.ndarray, names: tuple[str, ...]) -> None:
        self.known, self.coefficients, self.names = known, coefficients, names
        self.asked = [(*TRUTH, "rpm").index(name) for name in names]

    def in_words(self) -> str:
        return "a steady state"

    def __call__(self, values: np.ndarray) -> Known:
        full = self.known.copy()
        full[self.asked] = values
        u = (full / self.known - 1) / REACH
        by = np.asarray(jax.jacfwd(basis)(jnp.asarray(u))) / (self.known * REACH)
        jacobian = self.coefficients.T @ by
        return Known(np.asarray(basis(jnp.asarray(u))) @ self.coefficients, jacobian[:, self.asked])


def quick(robot: SceneFile, rpm: float) -> tuple[np.ndarray, np.ndarray]:
    """Numbers at the truth, and coefficients of the polynomial."""
    names = (*TRUTH, "rpm")
    known = np.array([*TRUTH.values(), rpm])
    exact = source(robot, rpm, names)
    rows, data = [], []
    for corner in product((-1.0, 0.0, 1.0), repeat=3):
        u = np.array(corner)
        found = exact(known * (1 + REACH * u))
        slopes = np.asarray(jax.jacfwd(basis)(jnp.asarray(u))).T
        rows += [np.asarray(basis(jnp.asarray(u)))[None], slopes]
        data += [found.gait[None], (found.jacobian * known * REACH).T]
    return known, np.linalg.lstsq(np.concatenate(rows), np.concatenate(data), rcond=None)[0]


def fits(way: Way, world: World, seeds: Sequence[int]) -> dict[str, list]:
    """How far estimates are off in units of their errors, and the errors, for every seed."""
    found: dict[str, list] = {name: [] for name in TRUTH}
    for seed in seeds:
        near = {name: 1.02 * value for name, value in TRUTH.items()}
        problem = assemble(dataset(way, world.robot, world.tracks(seed)), tuple(TRUTH), near)
        problem.sources = tuple(
            replace(one, source=Quick(*world.polynomials[k], one.source.names))
            for k, one in enumerate(problem.sources)
        )
        free = beginning(problem)
        assert free is not None
        optimum = search(problem, free)
        assert optimum is not None
        known = errors(problem, optimum, np.zeros(len(free), bool))
        for k, name in enumerate(TRUTH):
            off = optimum.free[k] - np.log(TRUTH[name])
            found[name].append((off / known.std[k], known.std[k], known.quantile))
    return found


def row(label: str, found: dict[str, list]) -> dict[str, Any]:
    """Coverage, how far off estimates are, and their error, of each parameter."""
    cells: dict[str, Any] = {"fit": label}
    for name in TRUTH:
        u, std, quantile = np.array(found[name]).T
        cells |= {
            f"{name}: inside (%)": 100 * np.mean(np.abs(u) <= quantile),
            f"{name}: off (std errors, rms)": np.sqrt(np.mean(u**2)),
            f"{name}: std error (%)": 100 * np.median(std),
        }
    return cells


def full(world: World, count: int) -> str:
    """Fits from a start that is far off, with nothing linearised."""
    lines = []
    for seed in range(count):
        data = dataset(Way(), world.robot, world.tracks(1000 + seed))
        fit, _ = calibrate_jointly(data, tuple(TRUTH), {"C_t": 2.4, "C_r": 0.72})
        apart = [
            (fit.values[name] - truth) / fit.estimates[name].std for name, truth in TRUTH.items()
        ]
        memory = ", ".join(f"{k} {v:.2f}" for k, v in fit.memory.items())
        lines.append(
            f"seed {seed}: {fit.status}, off by "
            + ", ".join(f"{u:+.2f} standard errors" for u in apart)
            + f"; correlation {memory}"
        )
        print(lines[-1], flush=True)
    return "\n".join(lines)


def main() -> None:
    """Write docs/figures/coverage.csv and .md."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--full", type=int, default=2, metavar="N", help="full fits (default: 2)")
    parser.add_argument("--seeds", type=int, default=100, help="of the first row (default: 100)")
    parser.add_argument("--others", type=int, default=30, help="of other rows (default: 30)")
    args = parser.parse_args()
    world = World()
    rows = []
    for label, way in WAYS.items():
        count = args.seeds if label == "all taken into account" else args.others
        rows.append(row(label, fits(way, world, range(count))))
        print(rows[-1], flush=True)
    said = full(world, args.full)
    note = (
        f"{args.seeds} films for the first row, {args.others} for the others. In full, from "
        f"C_t = 2.4 and C_r = 0.72, with steady states solved for:\n\n```\n{said}\n```"
    )
    formats = {"fit": "s"}
    for name in TRUTH:
        formats |= {
            f"{name}: inside (%)": ".0f",
            f"{name}: off (std errors, rms)": ".2f",
            f"{name}: std error (%)": ".3f",
        }
    write(pd.DataFrame(rows), FIGURES / "coverage.csv", formats, note)


if __name__ == "__main__":
    main()
