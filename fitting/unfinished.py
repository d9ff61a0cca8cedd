"""Fits that were interrupted: what they have simulated, and of what fit it is."""

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from derjax import InputError
from derjax.io.files import atomic_path
from derjax.io.output import Output

from .tracks import Dataset

EVALUATIONS = "evaluations"
"""Directory, in that of the results, of what an unfinished fit has simulated."""

IDENTITY = "identity.json"


def begin(
    output: Output, dataset: Dataset, parameters: Sequence[str], initial: Mapping[str, float]
) -> Path:
    """A new directory for the simulations of a fit; those of an earlier one are gone."""
    finish(output)
    directory = output.path / EVALUATIONS
    directory.mkdir()
    with atomic_path(directory / IDENTITY) as temporary:
        text = json.dumps(_identity(dataset, parameters, initial), indent=2)
        temporary.write_text(text + "\n", encoding="utf-8")
    return directory


def resume(
    output: Output, dataset: Dataset, parameters: Sequence[str], initial: Mapping[str, float]
) -> Path:
    """The directory of the simulations of an unfinished fit.

    Raises:
        InputError: there is none, or it is of another fit.
    """
    directory = output.path / EVALUATIONS
    try:
        old = json.loads((directory / IDENTITY).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{directory}: there is no unfinished fit to resume") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{directory / IDENTITY}: cannot be read: {error}") from None
    new = _identity(dataset, parameters, initial)
    if changed := [key for key in new if old.get(key) != new[key]]:
        raise InputError(
            f"{directory}: this is an unfinished fit with other {', '.join(changed)}. "
            "Only the same fit can be resumed; --overwrite starts anew"
        )
    return directory


def finish(output: Output) -> None:
    """Remove what an unfinished fit has left."""
    shutil.rmtree(output.path / EVALUATIONS, ignore_errors=True)


def _identity(
    dataset: Dataset, parameters: Sequence[str], initial: Mapping[str, float]
) -> dict[str, Any]:
    """What two fits must have in common for one to continue the other, as JSON data."""
    tracks = hashlib.sha256()
    for run in dataset.runs:
        words = (run.name, run.channels, run.motor_rpm, run.sigma, run.sigma_angle)
        more = (
            run.free_origin,
            run.drift,
            run.sight,
            run.steady,
            run.scene,
            run.own,
            run.nuisances,
            run.exposure,
        )
        tracks.update(repr((*words, *more)).encode())
        for array in (run.time, run.values):
            tracks.update(np.ascontiguousarray(array).tobytes())
    for rates in dataset.rates:
        tracks.update(repr((rates.name, rates.scene, rates.own, rates.nuisances)).encode())
        for array in (rates.motor_rpm, *rates.measured):
            tracks.update(np.ascontiguousarray(array).tobytes())
    tracks.update(repr((dataset.priors, dataset.noise, dataset.shared)).encode())
    table = dataset.scene.motor_table
    content = {
        "version": version("derjax"),
        "scene": dataset.scene.model_dump(mode="json"),
        "motor table": None if table is None else table.model_dump(mode="json"),
        "tracks": tracks.hexdigest(),
        "parameters": list(parameters),
        "start": dict(initial),
    }
    return json.loads(json.dumps(content))
