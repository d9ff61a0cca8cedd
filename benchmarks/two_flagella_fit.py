"""Fits of two flagella to side views, from periodic orbits: how long they take, and what they find.

Tracks of x and y, or of the head's angle as well, a frame a second, with noise of 1 % of the radius
of the head, of the default robot with two flagella: made of its periodic orbits, or simulated in
time from rest, with what is before the transient has died out left away. A fit costs what its
orbits cost: a track over an orbit is the orbit, again and again, moved by its screw motion.

    python -m benchmarks.two_flagella_fit              # two rates, 60 s each
    python -m benchmarks.two_flagella_fit five         # five rates, 240 s each
    python -m benchmarks.two_flagella_fit crossed      # data of one hinge, fit with another

Each writes its rows into the table, and keeps those of the others.
"""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from derjax import SceneFile, build, robots, rollout
from derjax.rods.head import head_angle, head_position
from fitting.joint.fit import Solved, calibrate_jointly
from fitting.joint.gait import Gait, swum
from fitting.joint.parts import TrackPart
from fitting.joint.sources import source
from fitting.observe import interpolation
from fitting.outcome import Progress
from fitting.tracks import Dataset, Run

from .command import command_line
from .tables import write

TRUTH = {"C_t": 4.8, "C_r": 0.36}
START = {"C_t": 4.0, "C_r": 0.45}
NOISE = 3e-4
"""m: 1 % of the radius of the head."""

NOISE_ANGLE = 0.02
"""rad."""

TRANSIENT = 20.0
"""s, that are left away of a simulation."""

TWO, FIVE = (40.0, 70.0), (30.0, 40.0, 50.0, 60.0, 70.0)
HINGES = ("rigid", "published")
SEEN = {"x, y": (0, 1), "x, y, angle": (0, 1, 3)}
KEY = ["data", "model", "tracks", "seen"]


def robot(hinge: str) -> SceneFile:
    """The default robot with two flagella."""
    file = robots.two_flagella()
    return file.model_copy(update={"motor": file.motor.model_copy(update={"hinge": hinge})})


def over_an_orbit(hinge: str, rpm: float, frames: np.ndarray) -> np.ndarray:
    """(f, 4) the track of the robot over its periodic orbit."""
    gait = source(robot(hinge), rpm, tuple(TRUTH))(np.array(list(TRUTH.values()))).gait
    print(f"{rpm:g} rpm, rates and path: {gait[:4]}", gait[4:].reshape(-1, 4)[:5], sep="\n")
    return np.asarray(swum(Gait.of(jnp.asarray(gait)), jnp.asarray(frames), 1.0, 0.7))


def in_time(hinge: str, rpm: float, frames: np.ndarray) -> np.ndarray:
    """(f, 4) the track of a simulation from rest, after its transient, in the scene's steps."""
    file = robot(hinge)
    scene = build(file, {**file.parameters, **TRUTH, "rpm": rpm})
    step = 0.05
    run = rollout(scene, TRANSIENT + frames[-1] + 1.0, frame=step, reverse_mode=False)
    run.raise_if_failed()
    topology = scene.rod.topology
    place = np.asarray(head_position(topology, run.states))
    angle = np.asarray(head_angle(topology, run.states))
    every = np.concatenate([place, angle[:, None]], axis=1)
    at_frames = interpolation(TRANSIENT + frames, step)
    return np.asarray(at_frames(every))


WAYS: dict[str, Callable[[str, float, np.ndarray], np.ndarray]] = {
    "orbit": over_an_orbit,
    "simulation": in_time,
}


def made(way: str, hinge: str, rates: Sequence[float], duration: float) -> list[Run]:
    """Tracks of the robot, with noise: all of it."""
    runs = []
    frames, every = np.arange(0.0, duration + 0.5), tuple(range(4))
    for k, rpm in enumerate(rates):
        size = np.array([NOISE, NOISE, NOISE, NOISE_ANGLE])
        noise = size * np.random.default_rng(k).normal(size=(len(frames), 4))
        values = WAYS[way](hinge, rpm, frames) + noise
        run = Run(f"rpm{rpm:g}", frames, every, values, rpm, steady=True, free_origin=True)
        runs.append(run)
    return runs


def told(progress: Progress) -> None:
    """Where a fit is, as it takes minutes."""
    print(f"{time.process_time():.0f} s of processor:", progress.stage, progress.values, flush=True)


def fitted(
    way: str, hinge: str, model: str, runs: Sequence[Run], seen: str
) -> tuple[dict[str, Any], Solved]:
    """A fit, once everything is compiled, how long it takes, and what it finds."""
    begun, chosen = time.perf_counter(), SEEN[seen]
    duration = runs[0].time[-1]
    own = [replace(run, channels=chosen, values=run.values[:, chosen]) for run in runs]
    data = Dataset(robot(model), tuple(own))
    calibrate_jointly(data, tuple(TRUTH), TRUTH, max_iterations=0, progress=told)
    print(f"compiled: {time.perf_counter() - begun:.0f} s", flush=True)
    wall, processor = time.perf_counter(), time.process_time()
    fit, solved = calibrate_jointly(data, tuple(TRUTH), START, progress=told)
    cells: dict[str, Any] = {
        "data": f"{hinge}, {way}",
        "model": model,
        "tracks": f"{len(runs)} of {duration:g} s",
        "seen": seen,
        "processor_s": time.process_time() - processor,
        "wall_s": time.perf_counter() - wall,
        "load": os.getloadavg()[0],
        "evaluations": solved.problem.evaluations,
        "status": fit.status if fit.goodness.good else f"{fit.status}, bad fit",
    }
    for name, truth in TRUTH.items():
        e = fit.estimates[name]
        cells |= {name: e.value, f"{name} error (%)": 100 * e.std / e.value}
        cells[f"{name} off (%)"] = 100 * (e.value / truth - 1)
    cells["noise_mm"] = 1e3 * fit.noise["position"]
    print(cells, *fit.said, *fit.warnings, sep="\n", flush=True)
    return cells, solved


def with_others(cells: dict[str, Any], path: Path) -> pd.DataFrame:
    """A row, and those that the table has of other data."""
    new = pd.DataFrame([cells])
    if not path.exists():
        return new
    old = pd.read_csv(path)
    both = pd.concat([old, new]).drop_duplicates(KEY, keep="last")
    return both.sort_values(["tracks", "seen", "data", "model"], ignore_index=True)


def draw(solved: Solved, path: Path) -> None:
    """Track, fit, and what is left, of every run."""
    point = solved.optimum.trial.model
    parts = [(k, p) for k, p in enumerate(solved.problem.parts) if isinstance(p, TrackPart)]
    figure, axes = plt.subplots(
        3, len(parts), figsize=(4.5 * len(parts), 6.5), sharex=True, squeeze=False, dpi=130
    )
    for (number, part), column in zip(parts, axes.T, strict=True):
        fine = np.linspace(part.run.time[0], part.run.time[-1], 2000)
        curve = part.predicted(point, number, fine)[0]
        left = part.table(part.rows(point, number).value)
        for axis, channel, name in zip(column[:2], (0, 1), "xy", strict=True):
            axis.plot(fine, 1e3 * curve[:, channel], lw=0.6, color="tab:orange", label="fit")
            seen = 1e3 * part.run.values[:, channel]
            axis.plot(part.run.time, seen, ".", ms=3, color="tab:blue", label="track")
            axis.set_ylabel(f"{name} (mm)")
            column[2].plot(part.run.time, 1e3 * left[:, channel], ".", ms=3, label=name)
        column[0].set_title(f"{part.run.motor_rpm:g} rpm")
        column[2].set(xlabel="t (s)", ylabel="fit - track (mm)")
    axes[0, 0].legend()
    axes[2, 0].legend()
    figure.tight_layout()
    figure.savefig(path)


FORMATS = {"data": "s", "model": "s", "tracks": "s", "seen": "s"}
FORMATS |= {"processor_s": ".0f", "wall_s": ".0f", "load": ".1f", "evaluations": ".0f"}
FORMATS |= {"status": "s"}
for _name in TRUTH:
    FORMATS |= {_name: ".4f", f"{_name} error (%)": ".2f", f"{_name} off (%)": ".2f"}
FORMATS |= {"noise_mm": ".3f"}


def main() -> None:
    """Write two_flagella_fit.csv, .md and .png."""
    parser = command_line(__doc__)
    parser.add_argument("what", nargs="?", choices=("two", "five", "crossed"), default="two")
    parser.add_argument("--data", choices=tuple(WAYS), help="only data that are made so")
    args = parser.parse_args()
    jobs = {
        "two": [(way, "rigid", ("rigid",), TWO, 60.0) for way in WAYS],
        "five": [("orbit", "rigid", ("rigid",), FIVE, 240.0)],
        "crossed": [("orbit", data, HINGES, TWO, 60.0) for data in HINGES],
    }[args.what]
    path = args.output / "two_flagella_fit.csv"
    for way, hinge, models, rates, duration in jobs:
        if args.data not in (None, way):
            continue
        begun = time.perf_counter()
        runs = made(way, hinge, rates, duration)
        print(f"data: {time.perf_counter() - begun:.0f} s", flush=True)
        for model in models:
            for seen in SEEN:
                cells, solved = fitted(way, hinge, model, runs, seen)
                write(with_others(cells, path), path, FORMATS)
                if args.what == "two":
                    draw(solved, path.with_suffix(".png"))


if __name__ == "__main__":
    main()
