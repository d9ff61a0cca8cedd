"""Fits of two flagella to side views, from periodic orbits: how long they take, and what they find.

Tracks of x and y, a frame a second, with noise of 1 % of the radius of the head, of the default
robot with two flagella in its periodic regime, for both models of the motor's hinge; each is fitted
with both. A fit costs what its orbits cost: a track over an orbit is the orbit, again and again,
moved by its screw motion.

    python -m benchmarks.two_flagella_fit            # two rates, 60 s each
    python -m benchmarks.two_flagella_fit --five     # five rates, 240 s each, as well
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pandas as pd

from derjax import SceneFile, robots
from fitting.joint.fit import calibrate_jointly
from fitting.joint.gait import Gait, swum
from fitting.joint.sources import source
from fitting.tracks import Dataset, Run

from .tables import write

OUTPUT = Path(__file__).parents[1] / "docs" / "figures" / "two_flagella_fit.csv"
TRUTH = {"C_t": 4.8, "C_r": 0.36}
START = {"C_t": 4.0, "C_r": 0.45}
NOISE = 3e-4
"""m: 1 % of the radius of the head."""


def robot(hinge: str) -> SceneFile:
    """The default robot with two flagella."""
    file = robots.two_flagella()
    return file.model_copy(update={"motor": file.motor.model_copy(update={"hinge": hinge})})


def made(hinge: str, rates: Sequence[float], duration: float) -> list[Run]:
    """Tracks of the robot in its periodic regime."""
    runs = []
    for k, rpm in enumerate(rates):
        gait = source(robot(hinge), rpm, tuple(TRUTH))(np.array(list(TRUTH.values()))).gait
        frames = np.arange(0.0, duration + 0.5)
        track = np.asarray(swum(Gait.of(jnp.asarray(gait)), jnp.asarray(frames), 1.0, 0.7))
        noise = NOISE * np.random.default_rng(k).normal(size=(len(frames), 2))
        runs.append(
            Run(
                f"rpm{rpm:g}",
                frames,
                (0, 1),
                track[:, :2] + noise,
                rpm,
                steady=True,
                free_origin=True,
            )
        )
    return runs


def fitted(hinge: str, runs: Sequence[Run], label: str) -> dict[str, Any]:
    """A fit, once more after everything is compiled, and how long that takes."""
    data = Dataset(robot(hinge), tuple(runs))
    begun = time.perf_counter()
    fit, _ = calibrate_jointly(replace(data, runs=data.runs), tuple(TRUTH), START)
    cells: dict[str, Any] = {"data and model": label, "seconds": time.perf_counter() - begun}
    cells["status"] = fit.status
    for name, truth in TRUTH.items():
        e = fit.estimates[name]
        cells |= {name: e.value, f"{name} error (%)": 100 * e.std / e.value}
        cells[f"{name} off (%)"] = 100 * (e.value / truth - 1)
    print(cells, flush=True)
    return cells


def main() -> None:
    """Write docs/figures/two_flagella_fit.csv and .md."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--five", action="store_true", help="also five rates of 240 s")
    args = parser.parse_args()
    two = (40.0, 70.0)
    tracks = {hinge: made(hinge, two, 60.0) for hinge in ("rigid", "published")}
    for hinge in tracks:  # to compile
        calibrate_jointly(Dataset(robot(hinge), tuple(tracks[hinge])), tuple(TRUTH), TRUTH)
    rows = [
        fitted(model, tracks[data], f"{data} and {model}, 2 rates of 60 s")
        for data in tracks
        for model in tracks
    ]
    if args.five:
        rates = (30.0, 40.0, 50.0, 60.0, 70.0)
        rows.append(
            fitted("rigid", made("rigid", rates, 240.0), "rigid and rigid, 5 rates of 240 s")
        )
    formats = {"data and model": "s", "seconds": ".0f", "status": "s"}
    for name in TRUTH:
        formats |= {name: ".4f", f"{name} error (%)": ".2f", f"{name} off (%)": ".2f"}
    write(pd.DataFrame(rows), OUTPUT, formats)


if __name__ == "__main__":
    main()
