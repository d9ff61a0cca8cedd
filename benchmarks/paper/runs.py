"""Runs that are made once: each is kept as a small file with its numbers and its series."""

import json
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

import derjax as dj
from derjax.io.files import atomic_path
from derjax.runs.progress import Progress

RADIUS = 6.36e-3
"""m, in which the paper counts pitches."""

IN_PHASE, ANTIPHASE = 0.0, [np.pi, 0.0]


class Case(NamedTuple):
    """A run: its name, what it is a case of, and the tables of its scene."""

    name: str
    of: Mapping[str, Any]
    tables: Mapping[str, Mapping[str, Any]]


def two_flagella(
    ratio: float, end: float, frame: float = 0.1, **tables: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """The tables of the paper's robot, of some pitch over radius."""
    scene: dict[str, dict[str, Any]] = {
        "robot": {"kind": "two_flagella", "pitch": ratio * RADIUS, "helix_radius": RADIUS},
        "time": {"end": end, "frame": frame},
    }
    for table, keys in tables.items():
        scene[table] = scene.get(table, {}) | dict(keys)
    return scene


class Result(NamedTuple):
    """Numbers of a run over its second half, and its series (one value for each frame)."""

    numbers: dict[str, Any]
    series: pd.DataFrame


def results_of(cases: Iterable[Case], directory: Path, make: bool = True) -> dict[str, Result]:
    """The results of runs; those that are kept in a directory are not made again.

    A run that fails is kept as well: its status says why, and its series end there. Several
    processes may fill one directory: a run is looked for once more before it is made.

    Args:
        cases: the runs.
        directory: where they are kept.
        make: those that are missing; else they are left out.
    """
    cases = list(cases)
    directory.mkdir(parents=True, exist_ok=True)
    found = {case.name: _known(case, directory) for case in cases}
    missing = [case for case in cases if make and found[case.name] is None]
    with Progress(len(missing), "runs") as progress:
        for count, case in enumerate(missing):
            found[case.name] = _known(case, directory) or _made(case, directory)
            progress.update(count + 1)
    return {name: result for name, result in found.items() if result is not None}


def _known(case: Case, directory: Path) -> Result | None:
    path = directory / f"{case.name}.json"
    if not path.exists():
        return None
    kept = json.loads(path.read_text(encoding="utf-8"))
    if kept["scene"] != json.loads(json.dumps(case.tables)):
        return None
    series = pd.read_csv(path.with_suffix(".csv"))
    return Result({**case.of, **kept["numbers"]}, series)


def _made(case: Case, directory: Path) -> Result:
    began = time.process_time()
    run = dj.rollout(dj.build(dj.SceneFile.from_dict(case.tables)), reverse_mode=False)
    data = run.to_dataset()
    numbers = run.summary() | {
        "status": data.attrs["status"],
        "simulated_s": float(data.time[-1]),
        "processor_s": time.process_time() - began,
    }
    columns: dict[str, Any] = {"time": data.time.to_numpy()}
    for name in ("bundle_fraction", "linking_number", "minimum_distance", "contact_force"):
        if name in data:
            columns[name] = data[name].to_numpy()
    if "flagellum_phase" in data:
        phase = data.flagellum_phase.to_numpy()
        columns["phase_difference"] = phase[:, 1] - phase[:, 0]
    if "head_position" in data:
        columns |= dict(zip("xyz", data.head_position.to_numpy().T, strict=True))
        columns["head_angle"] = data.head_angle.to_numpy()
    for name in ("motor_rate", "motor_torque"):
        if name in data:
            values = data[name].to_numpy()
            columns |= {f"{name}_{k + 1}": values[:, k] for k in range(values.shape[1])}
    tips = [path[-1] for path in run.scene.rod.topology.filaments]
    x = np.asarray(run.positions)[:, tips]
    if len(tips) > 1:
        apart = [
            np.linalg.norm(x[:, a] - x[:, b], axis=-1)
            for a in range(len(tips))
            for b in range(a + 1, len(tips))
        ]
        columns["tip_to_tip"] = np.mean(apart, axis=0)
    if len(tips) == 2:
        across = (x[:, 1] - x[:, 0])[:, 1:]  # the robots lie along x
        turn = np.unwrap(np.arctan2(across[:, 1], across[:, 0]))
        columns["tip_turn"] = turn - turn[0]
    series = pd.DataFrame(columns)
    path = directory / f"{case.name}.json"
    series.to_csv(path.with_suffix(".csv"), index=False, float_format="%.7g")
    kept = {"scene": case.tables, "numbers": numbers}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(kept, default=float), encoding="utf-8")
    return Result({**case.of, **numbers}, series)


def table_of(results: Mapping[str, Result]) -> pd.DataFrame:
    """One row for each run."""
    return pd.DataFrame([result.numbers for result in results.values()])
