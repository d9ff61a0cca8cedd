"""Where each scheme converges, is accurate, needs a smaller step, or fails, and how.

    python -m benchmarks.stability [-o docs/figures] [--only AXIS ...] [--resume] [--redraw]

The robot with one flagellum (a coarse one, of 12 edges, unless the axis is the mesh) starts from
rest and runs for 1 s at 60 rpm, or for 0.2 s where that is many turns or many nodes. One thing at a
time is changed, far beyond what anybody would build: an axis of the map. Every value is run with
steps that adapt, of both implicit schemes at default settings, and with steps of several fixed
lengths of all three.

The nodes at the end are compared with those of a reference: adaptive TR-BDF2 at a tolerance of
1e-5. The error is the largest distance of a node from where it should be, over the radius of a
circle as long as the flagellum. Outcomes are

    accurate        the error is below 1 %
    rough           from 1 to 100 %: needs a smaller step
    far off         above 100 %, or not even comparable
    no reference    it finished, but the reference did not, or is itself uncertain by more than 1 %
    failed          stopped with a status and its message
    refused         the input was refused with a message
    slow            stopped after 10 s of processor time
    silent NaN      a number that is not finite, and no status: must not happen

The exit code is 1 if there is a silent NaN, or a failure without a message. Ctrl-C keeps the cases
that are finished; --resume goes on with the others. Writes stability.csv (one row for each case,
with its message), stability.md and stability.png.
"""

import itertools
import math
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pandas as pd
from jax import lax
from matplotlib.colors import ListedColormap
from pydantic import ValidationError

import derjax
from derjax import InputError, RolloutStats, Scene, SceneFile, State, Status
from derjax.core.pytree import replace
from derjax.integrate.frames import SEGMENTS, TRIES, _attempt, _going, _Run, new_stats
from derjax.io.files import atomic_path
from derjax.runs.progress import Progress, interruptible
from derjax.scenes.build import build_unchecked
from derjax.scenes.ingredients.time import TOLERANCES
from derjax.scenes.messages import check
from derjax.scenes.motortable import RateTable
from derjax.scenes.shape import touching_pairs

from .command import command_line

END, SHORT = 1.0, 0.2
"""Length of a run, s."""
LIMIT = 10.0
"""Processor time after which a run is stopped, s; a reference has three times as much."""
MOST_TRIES = SEGMENTS * TRIES
"""Of steps that adapt, in a frame."""
REFERENCE = (1e-4, 1e-5)
"""Tolerances of the reference: what they differ by is how uncertain it is."""
ACCURATE, FAR = 0.01, 1.0
BETWEEN_WRITES = 10.0

FIRST_STEP = 0.05
"""Of steps that adapt, s."""
DEFAULT, SECOND_ORDER = "adaptive Euler", "adaptive TR-BDF2"
ADAPTIVE: dict[str, dict[str, Any]] = {
    DEFAULT: {"scheme": "euler", "tolerance": TOLERANCES["euler"]},
    SECOND_ORDER: {"scheme": "trbdf2", "tolerance": TOLERANCES["trbdf2"]},
}
COLUMNS: dict[str, dict[str, Any]] = {
    **{name: {"step": FIRST_STEP, **times} for name, times in ADAPTIVE.items()},
    **{f"TR-BDF2 {1e3 * h:g} ms": {"scheme": "trbdf2", "step": h} for h in (1e-3, 0.01, 0.05, 0.2)},
    **{f"Euler {1e3 * h:g} ms": {"scheme": "euler", "step": h} for h in (1e-3, 0.01, 0.05, 0.2)},
    **{f"explicit {1e3 * h:g} ms": {"scheme": "explicit", "step": h} for h in (1e-4, 1e-3, 0.01)},
}
"""What every value is run with: the [time] table of a scene."""

STEP = "step"
STEP_COLUMNS: dict[str, dict[str, Any]] = {
    **ADAPTIVE,
    "TR-BDF2": {"scheme": "trbdf2"},
    "Euler": {"scheme": "euler"},
    "explicit": {"scheme": "explicit"},
}
"""Of the axis whose values are the step; for steps that adapt it is the first one."""


@dataclass(frozen=True)
class Value:
    """A point of an axis.

    Attributes:
        label: what it is called.
        numbers: parameters of the scene that differ; those do not compile anew.
        tables: of the scene file; those may.
        unchecked: parameters that are put in after the file was checked.
        motor: times (s) and rates (rpm) of a motor table.
        end: length of the run, s.
    """

    label: str
    numbers: dict[str, Any] = field(default_factory=dict)
    tables: dict[str, dict[str, Any]] = field(default_factory=dict)
    unchecked: dict[str, Any] = field(default_factory=dict)
    motor: Sequence[tuple[float, float]] = ()
    end: float = END


class Case(NamedTuple):
    """One run of the map."""

    axis: str
    value: Value
    column: str

    @property
    def key(self) -> tuple[str, str, str]:
        return self.axis, self.value.label, self.column

    @property
    def time(self) -> dict[str, Any]:
        """Its [time] table."""
        if self.axis == STEP:
            return STEP_COLUMNS[self.column] | {"step": float(self.value.label.split()[0]) / 1e3}
        return COLUMNS[self.column]


EDGE = 0.0107
"""Makes a flagellum of 12 edges."""
R_0, LENGTH, CONTOUR = 1.6e-3, 95.4e-3, 128.8e-3
HEAD_MASS = 4 / 3 * math.pi * 31e-3**3 * 1260.0
"""Of the default robot; m, m, m, kg."""

HOMES = {
    "youngs_modulus": "material",
    "viscosity": "fluid",
    "regularization": "fluid",
    "rpm": "motor",
    "C_t": "head",
    "C_r": "head",
}
"""Tables of the parameters that are not in [robot]."""

TABLE_POINTS = 24
"""Of every motor table, so that they share a program."""

ABRUPT = 1e-6
"""How long (s) a motor takes to do what it does suddenly."""


def jumps(*rates: float, every: float) -> list[tuple[float, float]]:
    """A motor table whose rate jumps from one to the next (rpm), at equal distances (s)."""
    points = [(0.0, rates[0])]
    for k, (before, after) in enumerate(itertools.pairwise(rates), start=1):
        points += [(k * every, before), (k * every + ABRUPT, after)]
    return points


COLLIDING = {
    "robot": {"kind": "two_flagella", "separation": 14e-3},
    "motor": {"rpm": [60.0, -60.0]},
    "contact": {"capacity": 10**6},
}
"""Flagella that turn against each other, so close that each is in the other's way."""
PARALLEL = {
    "robot": {"kind": "two_flagella", "shape": "straight", "separation": 10e-3},
    "contact": {"capacity": 10**6},
}
"""Straight flagella side by side: their distance is the separation."""
TIGHT = {"robot": {"pitch": 20e-3, "axial_length": 60e-3, "edge_length": 2.7e-3}}
"""A helix of three turns, of 16 edges each at least."""
INERTIALESS = {"time": {"inertia": False}}


def tight(pitch: float) -> dict[str, float]:
    """Three turns of a helix."""
    return {"pitch": pitch, "axial_length": 3 * pitch}


def meshed(nodes: int) -> Value:
    """A flagellum of so many nodes, those of its motor's shaft included."""
    edge = CONTOUR / (nodes - 3.0)
    return Value(
        f"{nodes}", tables={"robot": {"edge_length": edge}}, end=END if nodes < 150 else SHORT
    )


def powers(first: int, last: int, by: int = 1) -> list[float]:
    return [10.0**k for k in range(first, last + 1, by)]


def rods_apart(overlap: float) -> Value:
    """Straight rods that overlap by so much of their diameter, which no scene file may ask for."""
    where = {"separation": (1.0 - overlap) * 2 * R_0}
    return Value(f"rods overlap by {100 * overlap:g} %", tables=PARALLEL, unchecked=where)


AXES: dict[str, list[Value]] = {
    STEP: [
        Value(f"{1e3 * h:g} ms") for h in (1e-4, 1e-3, 5e-3, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
    ],
    "Young's modulus, Pa": [Value(f"{x:.0e}", {"youngs_modulus": x}) for x in powers(4, 10)],
    "rod radius / axial length": [
        Value(f"{x:g}", {"rod_radius": x * LENGTH, "regularization": 1.04 * x * LENGTH})
        for x in (1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3)
    ],
    "viscosity, Pa s": [Value(f"{x:.0e}", {"viscosity": x}) for x in powers(-3, 3)],
    "motor, rpm": [
        Value(f"{x:g}", {"rpm": x}, end=END if x < 500 else SHORT)
        for x in (1.0, 10.0, 60.0, 200.0, 500.0, 1000.0, 2000.0)
    ],
    "regularization / rod radius": [
        Value(f"{x:g}", {"regularization": x * R_0})
        for x in (1e-3, 0.01, 0.1, 1.0, 3.0, 10.0, 27.0, 30.0)
    ],
    "contact stiffness, N/m": [
        Value(f"{x:.0e}", {"contact_stiffness": x}, COLLIDING) for x in powers(0, 7)
    ],
    "nodes of the flagellum": [meshed(n) for n in (10, 20, 40, 80, 160, 400)],
    "inertia": [
        Value(f"{said}, {name}", numbers, tables, end=end)
        for name, numbers, end in (
            ("as it is", {}, END),
            ("viscosity 1e-3 Pa s", {"viscosity": 1e-3}, END),
            ("1000 rpm", {"rpm": 1000.0}, SHORT),
            ("E = 1e9 Pa", {"youngs_modulus": 1e9}, END),
        )
        for said, tables in (("with", {}), ("without", INERTIALESS))
    ],
    "motor over time": [
        Value("stalled all the time", motor=jumps(0.0, every=1.0)),
        Value("60 rpm, stalls", motor=jumps(60.0, 0.0, every=0.5)),
        Value("600 rpm, stalls", motor=jumps(600.0, 0.0, every=0.5)),
        Value("starts late", motor=jumps(0.0, 60.0, every=0.5)),
        Value("60 rpm, reversed", motor=jumps(60.0, -60.0, every=0.5)),
        Value("200 rpm, reversed", motor=jumps(200.0, -200.0, every=0.5)),
        Value("600 rpm, reversed", motor=jumps(600.0, -600.0, every=0.5)),
        Value("60 rpm, ten reversals", motor=jumps(*(60.0, -60.0) * 5, 60.0, every=0.09)),
        Value("600 rpm, ten reversals", motor=jumps(*(600.0, -600.0) * 5, 600.0, every=0.09)),
    ],
    "shape": [
        *(
            Value(f"helix radius {1e3 * x:g} mm", {"helix_radius": x})
            for x in (1e-9, 1e-6, 1e-4, 1e-3)
        ),
        *(
            Value(f"pitch {1e3 * x:g} mm", tight(x), TIGHT)
            for x in (20e-3, 10e-3, 6e-3, 4e-3, 3.3e-3, 3.1e-3)
        ),
    ],
    "overlap at the start": [
        Value("rods 1 % of their diameter apart", {"separation": 1.01 * 2 * R_0}, PARALLEL),
        Value("rods overlap by 3 %, in the file", {"separation": 0.97 * 2 * R_0}, PARALLEL),
        Value(
            "helices through each other, in the file",
            tables={"robot": {"kind": "two_flagella", "separation": 14e-3}},
        ),
        *(rods_apart(x) for x in (1e-3, 5e-3, 0.02, 0.1, 0.5)),
        Value("helices through each other", tables=COLLIDING, unchecked={"separation": 3e-3}),
    ],
    "head": [
        *(
            Value(f"{name}", tables={"head": {"mass": HEAD_MASS * x}})
            for name, x in (("100 x lighter", 0.01), ("100 x heavier", 100.0))
        ),
        *(Value(f"{x:g} x the drag", {"C_t": 4.8 * x, "C_r": 0.36 * x}) for x in (0.01, 100.0)),
    ],
}


ACCURATE_, ROUGH, FAR_OFF, UNKNOWN = "accurate", "rough", "far off", "no reference"
FAILED, REFUSED, SLOW, SILENT = "failed", "refused", "slow", "silent NaN"
OUTCOMES = {
    ACCURATE_: "#009e73",
    ROUGH: "#f0e442",
    FAR_OFF: "#e69f00",
    UNKNOWN: "#56b4e9",
    FAILED: "#d55e00",
    REFUSED: "#bbbbbb",
    SLOW: "#0072b2",
    SILENT: "#000000",
}
"""And their colours, which differ for all eyes."""


class Run(NamedTuple):
    """How a run went.

    Attributes:
        state: at its end, on the host.
        report: how the steps went.
        seconds: of processor time.
        slow: whether it was stopped for that.
    """

    state: State
    report: RolloutStats
    seconds: float
    slow: bool

    @property
    def finished(self) -> bool:
        return self.report.ok and not self.slow

    @property
    def finite(self) -> bool:
        return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(self.state))


@jax.jit
def _tries(scene: Scene, now: _Run, most: int) -> _Run:
    """What `march_frames` does in a frame, but not more than so many tries of it.

    A try may take half a minute where everything goes wrong, and a frame has up to 1,024.
    """

    def wanted(carry):
        count, now = carry
        return _going(now) & (count < most)

    def another(carry):
        count, now = carry
        return count + 1, _attempt(scene, now)

    return lax.while_loop(wanted, another, (jnp.zeros((), jnp.int32), now))[1]


def run(scene: Scene, state: State, file: SceneFile, limit: float) -> Run:
    """Frames up to the end, to the first step that fails, or until the time is up."""
    adapts, per_frame = scene.control is not None, file.steps_per_frame
    whole = np.float64(per_frame * file.step) if adapts else np.int32(per_frame)
    few = 64 if scene.rod.topology.n_nodes < 100 else 1
    now = jax.tree.map(np.asarray, _Run(state, new_stats(), whole))
    _tries(scene, now, 0)  # compiles
    began = time.process_time()
    for _ in range(file.n_frames):
        now, tries = replace(now, left=whole), 0
        while now.left > 0 and now.report.ok:
            if adapts and tries >= MOST_TRIES:
                status = np.int32(Status.TOO_MANY)
                report = replace(now.report, status=status, failed_at=now.state.time)
                now = replace(now, report=report)
                break
            now = jax.tree.map(np.asarray, _tries(scene, now, few))
            tries += few
            if time.process_time() - began > limit and now.left > 0 and now.report.ok:
                return Run(now.state, now.report, time.process_time() - began, True)
        if not now.report.ok:
            break
    return Run(now.state, now.report, time.process_time() - began, False)


def scene_of(value: Value, times: dict[str, Any]) -> tuple[SceneFile, Scene, State]:
    """A checked scene, and what it is built to.

    Raises:
        InputError: it is refused.
    """
    tables = {name: dict(keys) for name, keys in value.tables.items()}
    tables["robot"] = {"edge_length": EDGE} | tables.get("robot", {})
    tables["time"] = tables.get("time", {}) | times | {"end": value.end}
    given = {name: dict(keys) for name, keys in tables.items()}
    for name, number in value.numbers.items():
        home, key = HOMES.get(name, "robot"), name
        if name == "contact_stiffness":
            home, key = "contact", "stiffness"
        given.setdefault(home, {})[key] = number
    checked = check(SceneFile, given, Path("scene.toml"))
    if checked.touching:
        touching_pairs(checked)  # refuses what overlaps
    plain = SceneFile.model_validate(tables)
    if value.motor:
        ends = range(TABLE_POINTS - len(value.motor))
        padded = [*value.motor, *((value.end + 1.0 + k, value.motor[-1][1]) for k in ends)]
        instants, rates = zip(*padded, strict=True)
        plain = plain.model_copy(update={"motor_table": RateTable(time=instants, rpm=rates)})
    scene = build_unchecked(plain, value.numbers | value.unchecked)
    state = scene.start
    return checked, scene, state


def simulate(value: Value, times: dict[str, Any], limit: float = LIMIT) -> tuple[Scene, Run]:
    """A run of a value with some [time] table."""
    file, scene, state = scene_of(value, times)
    return scene, run(scene, state, file, limit)


def distance(scene: Scene, first: State, second: State) -> float:
    """The farthest that a node is apart in two states, in circles as long as a flagellum."""
    topology = scene.rod.topology
    contour = float(np.sum(scene.rod.rest_length)) / max(1, len(topology.filaments))
    with np.errstate(all="ignore"):
        gap = np.linalg.norm(
            np.asarray(derjax.positions(topology, first.q))
            - np.asarray(derjax.positions(topology, second.q)),
            axis=1,
        )
    worst = float(gap.max()) / (contour / (2 * math.pi))
    return worst if math.isfinite(worst) else math.inf


class Reference(NamedTuple):
    """Where a run should end, and by how much (relative) that is uncertain."""

    state: State | None
    uncertainty: float


def reference(value: Value) -> Reference:
    """From runs at small tolerances."""
    times = {"scheme": "trbdf2", "step": FIRST_STEP}
    coarse, fine = ({**times, "tolerance": tolerance} for tolerance in REFERENCE)
    try:
        scene, end = simulate(value, fine, 3 * LIMIT)
    except InputError:
        return Reference(None, math.nan)
    if not end.finished:
        return Reference(None, math.nan)
    _, other = simulate(value, coarse, 3 * LIMIT)
    apart = distance(scene, other.state, end.state) if other.finished else math.inf
    return Reference(end.state, apart)


def judge(case: Case, known: Reference) -> dict[str, Any]:
    """The row of a case."""
    row = {"axis": case.axis, "value": case.value.label, "scheme": case.column}
    try:
        scene, found = simulate(case.value, case.time)
    except (InputError, ValidationError) as error:
        return row | {"outcome": REFUSED, "message": str(error).removeprefix("scene.toml: ")}
    report = found.report
    row |= {
        "status": Status(int(report.status)).name,
        "reached": float(found.state.time) / case.value.end,
        "steps": int(report.steps),
        "rejected": int(report.rejected),
        "iterations": int(report.iterations),
        "finite": found.finite,
        "seconds": found.seconds,
        "uncertainty": known.uncertainty,
    }
    if not found.finite and report.ok:
        return row | {"outcome": SILENT, "message": "a number that is not finite"}
    if not report.ok:
        return row | {"outcome": FAILED, "message": report.message()}
    if found.slow:
        left = f"stopped after {LIMIT:g} s, at {100 * row['reached']:.2g} % of the run"
        return row | {"outcome": SLOW, "message": left}
    if known.state is None or not known.uncertainty < ACCURATE:
        return row | {"outcome": UNKNOWN, "message": report.message()}
    error = distance(scene, found.state, known.state)
    outcome = ACCURATE_ if error < ACCURATE else ROUGH if error < FAR else FAR_OFF
    return row | {"outcome": outcome, "error": error, "message": report.message()}


def cases(axes: Iterable[str]) -> list[Case]:
    """All cases of some axes."""
    return [
        Case(axis, value, column)
        for axis in axes
        for value in AXES[axis]
        for column in (STEP_COLUMNS if axis == STEP else COLUMNS)
        # Drag that lags behind needs inertia.
        if not (column.startswith("explicit") and "time" in value.tables)
    ]


def judged(pending: Sequence[Case]) -> Iterator[dict[str, Any]]:
    """The rows of cases, those of one value one after the other."""
    before = None
    for _, group in itertools.groupby(pending, key=lambda case: case.key[:2]):
        of_one = list(group)
        value = of_one[0].value
        if value.tables != before:  # other programs: a process cannot hold all of them
            jax.clear_caches()
            before = value.tables
        known = reference(value)
        for case in of_one:
            yield judge(case, known)


def sorted_table(rows: Iterable[dict[str, Any]]) -> pd.DataFrame:
    """In the order of the map."""
    order = {case.key: k for k, case in enumerate(cases(AXES))}
    ranked = [(order.get((r["axis"], r["value"], r["scheme"])), r) for r in rows]
    kept = sorted(((k, r) for k, r in ranked if k is not None), key=lambda pair: pair[0])
    columns = ["axis", "value", "scheme", "outcome", "status", "error", "uncertainty", "reached"]
    columns += ["steps", "rejected", "iterations", "seconds", "finite", "message"]
    return pd.DataFrame([r for _, r in kept], columns=columns)


def save(rows: Iterable[dict[str, Any]], path: Path) -> pd.DataFrame:
    """The rows so far as a CSV file, whole or not at all."""
    table = sorted_table(rows)
    with atomic_path(path) as temporary:
        table.to_csv(temporary, index=False, float_format="%.6g")
    return table


def load(path: Path) -> list[dict[str, Any]]:
    """The rows of an earlier run, if there was one."""
    return pd.read_csv(path, dtype={"value": str}).to_dict("records") if path.exists() else []


def _rows(header: Sequence[str], body: Iterable[Sequence[Any]]) -> list[str]:
    lines = ["| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
    return lines + ["| " + " | ".join(str(cell) for cell in row) + " |" for row in body]


def _percent(share: float) -> str:
    return f"{100 * share:.1g} %" if share < 0.1 else f"{100 * share:.0f} %"


def _cell(row: dict[str, Any] | None) -> str:
    """A case in a few letters."""
    if row is None:
        return ""
    outcome = row["outcome"]
    if outcome == FAILED:
        return row["status"]
    if outcome in (ACCURATE_, ROUGH):
        said = _percent(row["error"])
        return said if outcome == ACCURATE_ else f"**{said}**"
    return outcome


def markdown(table: pd.DataFrame) -> str:
    """How often what happens; what fails and why; and a map for each axis."""
    kinds = [name for name in OUTCOMES if name == SILENT or (table["outcome"] == name).any()]
    schemes = [c for c in dict.fromkeys([*COLUMNS, *STEP_COLUMNS]) if (table["scheme"] == c).any()]
    longest = table["seconds"].max()
    lines = [
        f"{len(table)} cases; none took more than {longest:.0f} s of processor time, "
        f"{(table['outcome'] == SILENT).sum()} gave a number that is not finite without saying so.",
        "",
        "## How often",
        "",
    ]
    counts = [
        [scheme, *((of_scheme == kind).sum() for kind in kinds)]
        for scheme in schemes
        for of_scheme in [table.loc[table["scheme"] == scheme, "outcome"]]
    ]
    total = ["all", *((table["outcome"] == kind).sum() for kind in kinds)]
    lines += _rows(["scheme", *kinds], [*counts, total])
    lines += ["", f"## What stops the default ({DEFAULT}), and why", ""]
    stopped = table[(table["scheme"] == DEFAULT) & table["outcome"].isin([FAILED, REFUSED, SLOW])]
    if len(stopped):
        told = [(r["axis"], r["value"], r["outcome"], r["message"]) for r in _dicts(stopped)]
        lines += _rows(["axis", "value", "outcome", "message"], told)
    else:
        lines += ["Nothing."]
    lines += ["", "## Why the others fail", ""]
    failed = table[(table["outcome"] == FAILED) & (table["scheme"] != DEFAULT)]
    if len(failed):
        grouped = failed.groupby(["scheme", "status"], sort=False)
        lines += _rows(
            ["scheme", "status", "cases", "axes"],
            [[*key, len(rows), ", ".join(rows["axis"].unique())] for key, rows in grouped],
        )
    else:
        lines += ["They do not."]
    lines += [
        "",
        "## Maps",
        "",
        "Errors of what finished, bold from 1 % on; the status of what failed; other outcomes by "
        "name.",
    ]
    for axis, rows in table.groupby("axis", sort=False):
        columns = list(STEP_COLUMNS if axis == STEP else COLUMNS)
        found = {(r["value"], r["scheme"]): r for r in _dicts(rows)}
        lines += ["", f"### {axis}", ""]
        lines += _rows(
            ["", *columns],
            [[v, *(_cell(found.get((v, c))) for c in columns)] for v in rows["value"].unique()],
        )
    return "\n".join(lines) + "\n"


def _dicts(table: pd.DataFrame) -> list[dict[str, Any]]:
    return table.to_dict("records")


def figure(table: pd.DataFrame, path: Path) -> None:
    """A panel for each axis: values against schemes, coloured by outcome."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    axes = list(table["axis"].unique())
    across = min(3, len(axes))
    down = math.ceil(len(axes) / across)
    fig, panels = plt.subplots(
        down, across, figsize=(5.6 * across, 3.6 * down + 0.6), squeeze=False, layout="constrained"
    )
    names = list(OUTCOMES)
    colours = ListedColormap(list(OUTCOMES.values()))
    for panel, axis in itertools.zip_longest(panels.flat, axes):
        if axis is None:
            panel.axis("off")
            continue
        columns = list(STEP_COLUMNS if axis == STEP else COLUMNS)
        rows = table[table["axis"] == axis]
        values = list(rows["value"].unique())
        codes = np.full((len(values), len(columns)), np.nan)
        for row in _dicts(rows):
            place = values.index(row["value"]), columns.index(row["scheme"])
            codes[place] = names.index(row["outcome"])
        panel.imshow(codes, cmap=colours, vmin=-0.5, vmax=len(names) - 0.5, aspect="auto")
        panel.set_xticks(np.arange(len(columns) + 1) - 0.5, minor=True)
        panel.set_yticks(np.arange(len(values) + 1) - 0.5, minor=True)
        panel.grid(which="minor", color="white", lw=1.5)
        panel.tick_params(which="both", length=0)
        panel.set_xticks(range(len(columns)), columns, rotation=60, ha="right", fontsize=7)
        panel.set_yticks(range(len(values)), values, fontsize=8)
        panel.set_title(axis, fontsize=10)
        panel.spines[:].set_visible(False)
    shown = [name for name in names if (table["outcome"] == name).any()]
    handles = [plt.Rectangle((0, 0), 1, 1, color=OUTCOMES[name]) for name in shown]
    labels = [f"{name} ({(table['outcome'] == name).sum()})" for name in shown]
    fig.legend(handles, labels, loc="outside lower center", ncols=len(shown), frameon=False)
    fig.savefig(path, dpi=130)
    plt.close(fig)


def write(table: pd.DataFrame, directory: Path) -> None:
    """stability.md and .png."""
    (directory / "stability.md").write_text(markdown(table), encoding="utf-8")
    figure(table, directory / "stability.png")


def faults(table: pd.DataFrame) -> list[str]:
    """What must not be in the map."""
    silent = table[table["outcome"] == SILENT]
    mute = table[table["outcome"].isin([FAILED, REFUSED]) & (table["message"].fillna("") == "")]
    return [
        f"{row['axis']}, {row['value']}, {row['scheme']}: {what}"
        for what, rows in (("silent NaN", silent), ("failed without a message", mute))
        for row in _dicts(rows)
    ]


def main() -> int:
    parser = command_line(__doc__)
    parser.add_argument("--only", nargs="+", choices=list(AXES), metavar="AXIS")
    parser.add_argument("--resume", action="store_true", help="skip the cases in stability.csv")
    parser.add_argument("--redraw", action="store_true", help="from stability.csv, no simulation")
    options = parser.parse_args()
    path = options.output / "stability.csv"
    if options.redraw:
        table = sorted_table(load(path))
        write(table, options.output)
        return 0
    wanted = cases(options.only or AXES)
    again = set() if options.resume else {case.key for case in wanted}
    rows = [r for r in load(path) if (r["axis"], r["value"], r["scheme"]) not in again]
    done = {(r["axis"], r["value"], r["scheme"]) for r in rows}
    pending = [case for case in wanted if case.key not in done]
    finished, saved = len(wanted) - len(pending), time.monotonic()
    with (
        Progress(len(wanted), "cases", finished) as progress,
        interruptible("stopping after this case; --resume goes on") as stopping,
    ):
        for row in judged(pending):
            rows.append(row)
            finished += 1
            progress.update(finished)
            if time.monotonic() - saved > BETWEEN_WRITES:
                save(rows, path)
                saved = time.monotonic()
            if stopping():
                break
    table = save(rows, path)
    write(table, options.output)
    print(markdown(table).partition("## Maps")[0])
    for fault in (found := faults(table)):
        print(fault, file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
