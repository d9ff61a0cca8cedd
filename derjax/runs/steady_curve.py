"""Steady states of a scene over a parameter, as the command `derjax steady` finds them."""

import contextlib
import dataclasses
import json
import shlex
import sys
from collections.abc import Iterator
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from scipy.spatial.transform import Rotation

from ..core.errors import InputError
from ..core.status import SolverError
from ..integrate.step import Scene
from ..io.output import Output, output_directory
from ..rods.kinematics import positions
from ..rods.rod import State
from ..rods.topology import Topology
from ..scenes.build import build
from ..scenes.extensions import unit_of
from ..scenes.file import SceneFile
from ..scenes.load import load_scene
from ..steady.curve import along
from ..steady.motion import symmetry_of
from ..steady.orbit import Orbit, orbit, period_of
from ..steady.stability import Stability, stability, threshold
from .progress import Progress, interruptible

TABLE, STATES, RECORD = "steady.csv", "steady.nc", "steady.json"
CURVES, SHAPES, MODE = "curves.png", "shapes.png", "mode.png"
DONE, INTERRUPTED = 0, 130

MOST_POINTS = 10_000


@dataclasses.dataclass(frozen=True)
class Options:
    """What the user asked for.

    Attributes:
        scene: scene file.
        output: directory of the results.
        vary: "NAME=FIRST:LAST:STEP" or "NAME=VALUE,VALUE,..."; None for the scene as it is.
        stability: find growth rates and thresholds.
        resume: compute the points that are missing.
        overwrite: replace what is there.
        figures: draw them.
        quiet: print errors only.
    """

    scene: Path
    output: Path
    vary: str | None = None
    stability: bool = False
    resume: bool = False
    overwrite: bool = False
    figures: bool = True
    quiet: bool = False

    def command(self, *extra: str) -> str:
        """The command line of these options, without those on existing results."""
        words = ["derjax", "steady", str(self.scene), "-o", str(self.output), *extra]
        words += ["--vary", self.vary] if self.vary else []
        words += ["--stability"] * self.stability
        words += ["--no-figures"] * (not self.figures) + ["--quiet"] * self.quiet
        return shlex.join(words)


def points_of(vary: str | None, file: SceneFile) -> tuple[str, list[float]]:
    """The parameter that is varied, and its values.

    Raises:
        InputError: the text cannot be understood, or the scene has no such parameter.
    """
    if vary is None:
        rpm = file.parameters.get("rpm")
        if file.motor_table is not None or rpm is None or np.ndim(rpm) > 0:
            raise InputError("[motor]: steady states need one motor with one constant rate")
        return "rpm", [float(rpm)]
    name, _, text = vary.partition("=")
    hint = "should be like rpm=10:300:30 (first, last, step) or pitch=0.03,0.04"
    try:
        if ":" in text:
            first, last, step = (float(part) for part in text.split(":"))
            count = int(np.floor((last - first) / step + 1e-9)) + 1
            values = [first + k * step for k in range(min(count, MOST_POINTS + 1))]
        else:
            values = [float(part) for part in text.split(",")]
    except (ValueError, ZeroDivisionError):
        raise InputError(f"--vary {vary}: {hint}") from None
    if not values or not np.all(np.isfinite(values)):
        raise InputError(f"--vary {vary}: no values; {hint}")
    if len(values) > MOST_POINTS:
        raise InputError(f"--vary {vary}: more than {MOST_POINTS} values")
    if len(set(values)) < len(values):
        raise InputError(f"--vary {vary}: a value is given twice")
    if name not in file.single_numbers:
        known = ", ".join(file.single_numbers)
        raise InputError(f"--vary {name}: no such number; the scene has {known}")
    return name, values


def steady_curve(options: Options) -> int:
    """Finds steady states of a scene and writes a table, their shapes, and figures.

    A value without a steady state is a row that says so. Ctrl-C stops after the current value.

    Returns:
        The exit code: 0 done, 130 interrupted.

    Raises:
        InputError: the scene or the options are wrong, or there are results that must not be
            replaced; nothing has been written.
        SolverError: there is a steady state at none of the values.
    """
    file = load_scene(options.scene)
    name, values = points_of(options.vary, file)
    try:
        scenes = [build(file, {name: value}) for value in values]
        _check(scenes[0])
    except InputError as error:
        raise InputError(f"{options.scene}: {error}") from None
    record = {
        "scene": json.loads(file.model_dump_json()),
        "parameter": name,
        "stability": options.stability,
        "derjax_version": version("derjax"),
    }
    with output_directory(options.output) as output:
        rows = _earlier(options, record, name)
        return _compute(options, scenes, name, values, rows, record, output)


def _check(scene: Scene) -> None:
    """Raises InputError where a scene has no steady motion."""
    if _turns_past_itself(scene):
        period_of(scene)
    else:
        symmetry_of(scene)


def _earlier(options: Options, record: dict[str, Any], name: str) -> dict[float, dict[str, Any]]:
    """The rows that are there already, by the value of the parameter."""
    table, known = options.output / TABLE, options.output / RECORD
    if options.overwrite or not (table.exists() or known.exists()):
        if options.resume:
            raise InputError(f"{table}: no such file: there is nothing to resume")
        return {}
    if not options.resume:
        raise InputError(
            f"{table}: exists already: --resume adds what is missing, --overwrite starts anew"
        )
    try:
        before = json.loads(known.read_text(encoding="utf-8"))
        frame = pd.read_csv(table)
    except (OSError, ValueError) as error:
        raise InputError(f"{options.output}: cannot be resumed: {error}") from None
    if {k: before.get(k) for k in record} != record:
        raise InputError(
            f"{known}: these steady states are of another scene, parameter, or version of derjax. "
            "Only the same can be resumed; --overwrite starts anew"
        )
    found = frame.astype(object).where(frame.notna(), None).to_dict("records")
    return {float(row[name]): {str(k): v for k, v in row.items()} for row in found}


@dataclasses.dataclass(frozen=True)
class Motion:
    """A shape that moves steadily, or that of an orbit where a turn begins.

    Attributes:
        scene: whose motion.
        positions: (n, 3) m.
        rotation: (3,) rad/s; of an orbit what is left of a turn of the motors, over its period.
        velocity: (3,) m/s, likewise.
        growth: 1/s, of the leading mode; None if it was not asked for.
        mode: (n, 3) complex displacement of the nodes in that mode, in units of its own.
        pace: rad/s, of that mode in the turning frame.
    """

    scene: Scene
    positions: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    growth: float | None = None
    mode: np.ndarray | None = None
    pace: float | None = None


@dataclasses.dataclass(frozen=True)
class Point:
    """What has been found at one value of the parameter: its numbers, and a motion or why not."""

    row: dict[str, Any]
    motion: Motion | None = None
    message: str = ""


def _shapes_that_last(scenes: list[Scene], values: list[float], modes: bool) -> Iterator[Point]:
    """Steady states of robots with one flagellum."""
    from ..results import steady as results  # slow to import

    for state in along(scenes, values):
        if not state.ok:
            yield Point(results.row(state), message=state.message())
            continue
        found = stability(state) if modes else None
        known: dict[str, Any] = {}
        if found is not None:
            known = {
                "growth": found.growth_rate,
                "mode": _at_nodes(state.scene.rod.topology, found),
                "pace": 2 * np.pi * found.frequency,
            }
        frequency = None if found is None else abs(found.laboratory_frequency)
        yield Point(
            results.row(state, known.get("growth"), frequency),
            Motion(
                state.scene,
                np.asarray(state.positions),
                np.asarray(state.motion.rotation),
                np.asarray(state.motion.velocity),
                **known,
            ),
        )


def _orbits(scenes: list[Scene], values: list[float], modes: bool) -> Iterator[Point]:
    """Orbits of robots with several flagella, each looked for from the one before."""
    from ..results import steady as results  # slow to import

    begin: State | None = None
    for scene in scenes:
        try:
            found = _orbit_from(scene, begin)
        except SolverError as error:
            numbers: dict[str, Any] = dict.fromkeys(results.NAMES)
            yield Point(numbers | {"status": "no orbit"}, message=str(error))
            continue
        begin = found.state
        multiplier = found.multipliers(2)[0] if modes else None
        row = results.orbit_row(found, multiplier)
        yield Point(
            row,
            Motion(
                found.scene,
                np.asarray(positions(scene.rod.topology, found.state.q)),
                Rotation.from_matrix(found.turn).as_rotvec() / found.period,
                found.shift / found.period,
                growth=row["growth_rate_per_s"],
            ),
        )


def _orbit_from(scene: Scene, begin: State | None) -> Orbit:
    """From a state that is near, or else from rest."""
    if begin is not None:
        with contextlib.suppress(SolverError):
            return orbit(scene, begin)
    return orbit(scene)


def _compute(
    options: Options,
    scenes: list[Scene],
    name: str,
    values: list[float],
    rows: dict[float, dict[str, Any]],
    record: dict[str, Any],
    output: Output,
) -> int:
    found: dict[float, Point] = {}
    stopped = False
    if not options.quiet:
        print(f"compiling {options.scene} ...", file=sys.stderr, flush=True)
    finder = _orbits if _turns_past_itself(scenes[0]) else _shapes_that_last
    points = finder(scenes, values, options.stability)
    with (
        interruptible("stopping after this value; Ctrl-C again quits without saving") as stopping,
        Progress(len(values), "steady states", 0, options.quiet) as progress,
    ):
        for k, (value, point) in enumerate(zip(values, points, strict=True)):
            found[value] = point
            if value not in rows:
                rows[value] = {name: value, **point.row}
                _write_table(rows, record, output)
            progress.update(k + 1)
            if stopping() and k + 1 < len(values):
                stopped = True
                break
    good = {value: point.motion for value, point in found.items() if point.motion is not None}
    if not good and not stopped:
        raise SolverError(
            f"{options.scene}: no steady state at any of {len(values)} values. The first: "
            f"{found[values[0]].message}"
        )
    zeros = _thresholds(good, name) if options.stability and not stopped else []
    _write_table(rows, record | {"thresholds": zeros}, output)
    _write_states(good, name, options, output)
    if options.figures and good:
        _draw(options, [rows[v] for v in sorted(rows)], good, name, zeros, output)
    if stopped:
        print(f"derjax: interrupted. Go on with: {options.command('--resume')}", file=sys.stderr)
        return INTERRUPTED
    if not options.quiet:
        _tell(options, rows, found, name, zeros)
    return DONE


def _turns_past_itself(scene: Scene) -> bool:
    """Whether several motors turn, so that no shape lasts."""
    topology = scene.rod.topology
    return len(topology.motors) + len(topology.driven_edges) > 1


def _write_table(rows: dict[float, dict[str, Any]], record: dict[str, Any], output: Output) -> None:
    with output.replacing(RECORD) as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    with output.replacing(TABLE) as temporary:
        pd.DataFrame([rows[value] for value in sorted(rows)]).to_csv(temporary, index=False)


def _write_states(good: dict[float, Motion], name: str, options: Options, output: Output) -> None:
    """Shapes, and leading modes, by the value of the parameter."""
    if not good:
        return
    ordered = sorted(good)
    motions = [good[value] for value in ordered]
    data: dict[str, Any] = {
        "position": (
            ("point", "node", "axis"),
            np.stack([m.positions for m in motions]),
            {"units": "m"},
        ),
        "rotation": (
            ("point", "axis"),
            np.stack([m.rotation for m in motions]),
            {"units": "rad/s"},
        ),
        "velocity": (("point", "axis"), np.stack([m.velocity for m in motions]), {"units": "m/s"}),
    }
    if all(m.growth is not None for m in motions):
        data["growth_rate"] = (("point",), [m.growth for m in motions], {"units": "1/s"})
    modes = [m.mode for m in motions if m.mode is not None]
    if len(modes) == len(motions):
        leading = np.stack(modes)
        data |= {
            "mode_real": (("point", "node", "axis"), np.real(leading)),
            "mode_imag": (("point", "node", "axis"), np.imag(leading)),
            "angular_frequency": (("point",), [m.pace for m in motions], {"units": "rad/s"}),
        }
    coordinates = {name: ("point", ordered, {"units": unit_of(name)}), "axis": list("xyz")}
    attributes = {"title": "Steady states, computed by derjax", "command": options.command()}
    with output.replacing(STATES) as temporary:
        xr.Dataset(data, coordinates, attributes).to_netcdf(temporary)


def _at_nodes(topology: Topology, modes: Stability) -> np.ndarray:
    """(n, 3) complex displacement of the nodes in the leading mode, in units of its own."""
    return np.asarray(modes.modes[0][: 3 * topology.n_nodes]).reshape(-1, 3)


def _thresholds(good: dict[float, Motion], name: str) -> list[float]:
    """Where the growth rate changes sign between neighbouring values.

    That of a steady state is found exactly; that of an orbit is interpolated.
    """
    zeros, ordered = [], sorted(good)
    for low, high in pairwise(ordered):
        first, second = good[low].growth, good[high].growth
        if first is None or second is None or first * second > 0:
            continue
        near = low + first / (first - second) * (high - low)
        scene = good[low].scene
        orbits = _turns_past_itself(scene)
        zeros.append(near if orbits else threshold(scene, name, start=near).value)
    return zeros


def _draw(
    options: Options,
    rows: list[dict[str, Any]],
    good: dict[float, Motion],
    name: str,
    zeros: list[float],
    output: Output,
) -> None:
    from ..results import steady as results

    ordered = sorted(good)
    figures = {
        SHAPES: results.shapes(
            [{name: value} for value in ordered],
            np.stack([good[value].positions for value in ordered]),
            name,
        )
    }
    if len(rows) > 1:
        figures[CURVES] = results.curves(rows, name, unit_of(name), zeros)
    last = good[ordered[-1]]
    if last.mode is not None:
        title = f"Leading mode at {name} = {ordered[-1]:g}: growth {last.growth:.3g} 1/s"
        figures[MODE] = results.mode_picture(last.positions, last.mode, title)
    for file, figure in figures.items():
        with output.replacing(file) as temporary:
            figure.savefig(temporary, format="png")


def _tell(
    options: Options,
    rows: dict[float, dict[str, Any]],
    found: dict[float, Point],
    name: str,
    zeros: list[float],
) -> None:
    shown = (name, "v_m_per_s", "head_rate_rad_per_s", "tail_to_head_m", "efficiency")
    shown += ("growth_rate_per_s",) * options.stability + ("status",)
    frame = pd.DataFrame([rows[value] for value in sorted(rows)])
    for column in frame[list(shown)].select_dtypes("number"):
        frame[column] = [f"{value:.6g}" for value in frame[column]]
    print(frame[list(shown)].to_string(index=False))
    motions = [point.motion for point in found.values() if point.motion is not None]
    exact = not any(_turns_past_itself(motion.scene) for motion in motions)
    for zero in zeros:
        print(f"stability changes {'at' if exact else 'near (interpolated)'} {name} = {zero:.6g}")
    for value, point in found.items():
        if point.message:
            print(f"{name} = {value:g}: {point.message}")
    print(f"results in {options.output}")
