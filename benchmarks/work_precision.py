"""How large the error of a run is, and what it costs, for every way of stepping in time.

    python -m benchmarks.work_precision [-o DIR] [--quick] [--only single|two] [--rounds 3]
                                        [--cache DIR]

Runs the robot with one flagellum (pitch / radius = 7, 60 rpm, 20 s) and that with two (pitch /
radius = 5, antiphase, 60 rpm, 10 s, with contact) with every scheme, in steps of several lengths
and in steps that adapt at several tolerances, with Stokeslet segments (RSS) and local drag (RFT),
on several meshes, and with explicit drag in steps of 0.1 ms. The speed v_x and the head rate are
those that `derjax simulate` writes, over the second half of a run; the nodes of the helices are
compared in every frame (0.1 s), in units of the helix radius R.

The error in time is against TR-BDF2 in steps of 1/1280 s on the same mesh; the whole error is
against that on the finest mesh. The cost is processor time for a simulated second, without
compilation, the least of several rounds over all runs in turn (long runs are timed once). Results
are kept in a directory of temporary files that is named after the contents of derjax, so that a
benchmark that was stopped goes on where it was; `--cache` names another one.

The order in the length of the steps is measured apart, over one turn of the motor from a developed
state: over 20 s from rest, steps that are small enough for it would be too costly.

Writes work_precision.csv (all runs), .md and .png, work_precision_mesh.png, work_precision_two.png,
work_precision_order.csv and .png.
"""

import hashlib
import json
import tempfile
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from scipy.interpolate import CubicSpline

import derjax
from derjax.core.pytree import replace
from derjax.core.status import Status
from derjax.integrate.frames import march_frames, new_stats
from derjax.integrate.schemes.euler import euler
from derjax.integrate.schemes.trbdf2 import trbdf2
from derjax.integrate.step import enlarge
from derjax.results.dataset import to_dataset
from derjax.results.summary import summarise
from derjax.rods.kinematics import positions
from derjax.scenes.file import SceneFile
from derjax.scenes.ingredients.time import TOLERANCES as DEFAULTS

from .command import command_line
from .tables import markdown

FRAME = 0.1
FINEST_STEP = 0.05 / 64
STEPS = (0.1, 0.05, 0.1 / 3, 0.025, 0.0125, 0.00625, 0.003125)
TOLERANCES = (1e-2, 5e-3, 3e-3, 2e-3, 1e-3, 5e-4, 3e-4, 1e-4, 3e-5, 1e-5)
EXPLICIT = (1e-4, 2.5e-4, 5e-4, 1e-3, 2e-3)
MESHES = {"single": (10e-3, 5e-3, 2.5e-3), "two": (10e-3, 5e-3)}
FINEST_MESH = 2.5e-3
MESH_TOLERANCE = 3e-4
"""Of implicit Euler, with which meshes are compared: what it adds is the same on all of them."""

NOISE = 1e-3
"""Difference between meshes that is not clear of what the error in time may make of it."""

CASES: dict[str, dict[str, Any]] = {
    "single": {"robot": {"pitch": 44.5e-3}, "end": 20.0},
    "two": {
        "robot": {"kind": "two_flagella", "pitch": 31.8e-3, "phase": [np.pi, 0.0]},
        "end": 10.0,
    },
}
ENOUGH = 0.005
"""Error in speed and head rate that a user will put up with."""

ROUNDS, LONG = 3, 8.0
"""Rounds of timing, and processor time (s) above which a run is timed once."""

GOAL = 0.06
"""Seconds for a simulated second that the default may take."""

COUNTS = (40, 80, 160, 320, 640, 1280)
FINEST_COUNT = 5120
"""Steps in one turn of the motor, for the order of the schemes."""

ASYMPTOTIC = 1 / 75
"""s, longest step from which orders are fitted."""

QUANTITIES = {
    "v_x": "error of $v_x$",
    "head rate": "error of head rate",
    "nodes": "RMS of nodes / R",
}
STYLES = {
    ("trbdf2", "fixed"): ("#0b3c5d", "o-"),
    ("trbdf2", "adaptive"): ("#328cc1", "s-"),
    ("euler", "fixed"): ("#8c4a1f", "o--"),
    ("euler", "adaptive"): ("#d9883b", "s--"),
    ("explicit", "fixed"): ("#5b8c3a", "^:"),
}


@dataclass(frozen=True)
class Setting:
    """One run: what is simulated, and how.

    Attributes:
        case: of `CASES`.
        drag: "rss" or "rft".
        mesh: m, shortest that an edge may be.
        scheme: as in scene files.
        step: s; of the first step only, if there is a tolerance.
        tolerance: of steps that adapt.
    """

    case: str
    drag: str
    mesh: float
    scheme: str
    step: float
    tolerance: float | None = None

    @property
    def name(self) -> str:
        """For files and for people."""
        how = f"{self.step:.6g}" if self.tolerance is None else f"tol{self.tolerance:g}"
        return f"{self.case}-{self.drag}-{1e3 * self.mesh:g}mm-{self.scheme}-{how}"

    @property
    def file(self) -> SceneFile:
        """The scene."""
        case = CASES[self.case]
        times = {"step": self.step, "end": case["end"], "frame": FRAME, "scheme": self.scheme}
        if self.tolerance is not None:
            times["tolerance"] = self.tolerance
        return SceneFile.model_validate(
            {
                "robot": case["robot"] | {"edge_length": self.mesh},
                "fluid": {"hydrodynamics": self.drag},
                "time": times,
            }
        )

    @property
    def program(self) -> tuple[Any, ...]:
        """What decides which program is compiled."""
        return self.case, self.drag, self.mesh, self.scheme, self.tolerance is None


def default(case: str, drag: str = "rss", mesh: float = 5e-3) -> Setting:
    """What a scene file that says nothing of steps gets."""
    times = SceneFile().time
    return Setting(case, drag, mesh, times.scheme, times.step, times.tolerance)


def reference(case: str, drag: str, mesh: float) -> Setting:
    """The run in the finest steps."""
    return Setting(case, drag, mesh, "trbdf2", FINEST_STEP)


def settings(case: str, quick: bool) -> list[Setting]:
    """All runs of a case."""
    chosen: list[Setting] = []
    drags = ("rss",) if quick else ("rss", "rft")
    steps = STEPS[:5] if quick else STEPS
    tolerances = sorted({*DEFAULTS.values(), *((3e-3,) if quick else TOLERANCES)})
    for drag in drags:
        for mesh in (5e-3,) if quick else MESHES[case]:
            fixed = [Setting(case, drag, mesh, s, h) for s in ("trbdf2", "euler") for h in steps]
            adaptive = [
                Setting(case, drag, mesh, s, SceneFile().step, tolerance)
                for s in ("trbdf2", "euler")
                for tolerance in tolerances
            ]
            chosen += [reference(case, drag, mesh), *fixed, *adaptive]
        if not quick:
            explicit = EXPLICIT if case == "single" else EXPLICIT[:1]
            chosen += [Setting(case, drag, 5e-3, "explicit", h) for h in explicit]
            finer = (1.25e-3,) if case == "single" else (FINEST_MESH,)
            start = SceneFile().step
            chosen += [Setting(case, drag, m, "euler", start, MESH_TOLERANCE) for m in finer]
    return chosen


# Runs -----------------------------------------------------------------------------------------


class Run(NamedTuple):
    """What a run gave.

    Attributes:
        numbers: v_x, head rate, counts of steps, message, seconds of every round.
        moved: (t, f, n, 3) m, displacement of the nodes of every helix in every frame.
        along: (n,) m, where these nodes are on the helix, along the rod.
    """

    numbers: dict[str, Any]
    moved: np.ndarray
    along: np.ndarray


class Runs:
    """Runs that are made once, and kept in a directory."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._robot: tuple[Any, ...] = ()
        self._programs: dict[tuple[Any, ...], tuple[Any, float]] = {}
        directory.mkdir(parents=True, exist_ok=True)

    def _path(self, setting: Setting) -> Path:
        return self.directory / f"{setting.name}.npz"

    def __contains__(self, setting: Setting) -> bool:
        return self._path(setting).exists()

    def __getitem__(self, setting: Setting) -> Run:
        with np.load(self._path(setting)) as file:
            return Run(json.loads(str(file["numbers"])), file["moved"], file["along"])

    def _keep(self, setting: Setting, run: Run) -> None:
        with tempfile.NamedTemporaryFile(dir=self.directory, delete=False) as file:
            np.savez(file, numbers=json.dumps(run.numbers), moved=run.moved, along=run.along)
        Path(file.name).rename(self._path(setting))

    def make(self, setting: Setting) -> None:
        """A run, if there is none yet."""
        if setting in self:
            return
        file = setting.file
        scene = derjax.build(file)
        state = scene.start
        states, report, seconds, compiling = self._run(setting, scene, state)
        frames = jax.tree.map(lambda a, b: np.concatenate([a[None], b]), state, states)
        summary = dict.fromkeys(("v_x_m_per_s", "head_rate_rad_per_s"), np.nan)
        if report.ok:
            summary = summarise(to_dataset(scene, frames))
        nodes = np.asarray(jax.vmap(lambda q: positions(scene.rod.topology, q))(frames.q))
        helices = [path[2:] for path in scene.rod.topology.filaments]  # after the motor's shaft
        moved = np.stack([(nodes - nodes[:1])[:, path] for path in helices], axis=1)
        edge = float(scene.rod.rest_length[0])
        numbers = {
            **asdict(setting),
            "edge": edge,
            "v_x": summary["v_x_m_per_s"],
            "head rate": summary["head_rate_rad_per_s"],
            "steps": int(report.steps),
            "rejected": int(report.rejected),
            "iterations": int(report.iterations),
            "factorings": int(report.factorings),
            "message": "" if report.ok else report.message(),
            "compile_s": compiling,
            "seconds": [seconds],
        }
        self._keep(setting, Run(numbers, moved, edge * np.arange(len(helices[0]))))
        print(f"{setting.name}: {seconds:.3g} s {numbers['message']}", flush=True)

    def again(self, setting: Setting, rounds: int) -> None:
        """Another round of timing, if the run is short and there were fewer than that."""
        run = self[setting]
        seconds = run.numbers["seconds"]
        if run.numbers["message"] or min(seconds) > LONG or len(seconds) >= rounds:
            return
        scene = derjax.build(setting.file)
        seconds.append(self._run(setting, scene, scene.start)[2])
        self._keep(setting, run)

    def _run(self, setting: Setting, scene: derjax.Scene, state: derjax.State) -> tuple:
        """The states, the report, and seconds for the run and for compiling.

        A run whose list of contacts is too short is made again with a longer one, as
        `derjax simulate` does.
        """
        if setting.program[:3] != self._robot:  # a process cannot hold all programs
            self._robot = setting.program[:3]
            self._programs.clear()
            jax.clear_caches()
        scene = replace(scene, source=None)  # settings share programs, and their files differ
        times = setting.file
        steps, start = jnp.asarray(times.steps_per_frame), new_stats()
        for enlarged in range(6):
            program = (*setting.program, enlarged)
            if program not in self._programs:
                began = time.process_time()
                compiled = _march.lower(scene, state, times.n_frames, steps, start).compile()
                self._programs[program] = compiled, time.process_time() - began
            compiled, compiling = self._programs[program]
            began = time.process_time()
            states, report = jax.block_until_ready(compiled(scene, state, steps, start))
            seconds = time.process_time() - began
            if report.status != Status.CAPACITY:
                break
            scene = enlarge(scene)
        return states, report, seconds, compiling


_march = jax.jit(march_frames, static_argnums=2)


# Errors ---------------------------------------------------------------------------------------


def row(runs: Runs, setting: Setting) -> dict[str, Any]:
    """A run with its errors."""
    run = runs[setting]
    numbers = dict(run.numbers)
    seconds = min(numbers.pop("seconds"))
    return {
        **numbers,
        "name": setting.name,
        "stepping": "fixed" if setting.tolerance is None else "adaptive",
        "default": setting == default(setting.case, setting.drag, setting.mesh),
        "cost": seconds / CASES[setting.case]["end"],
        **_errors(runs, setting, setting.mesh, ""),
        **_errors(runs, setting, FINEST_MESH, "whole "),
    }


def _errors(runs: Runs, setting: Setting, mesh: float, which: str) -> dict[str, float]:
    """Of speed and head rate, relative, and of nodes, in helix radii."""
    run, finest = runs[setting], reference(setting.case, setting.drag, mesh)
    if finest not in runs or finest == setting or run.numbers["message"]:
        return {}
    exact = runs[finest]
    moved = exact.moved
    if len(exact.along) != len(run.along):
        moved = CubicSpline(exact.along, moved, axis=2)(run.along)
    square = np.sum((run.moved - moved) ** 2, axis=-1).mean(axis=(1, 2))
    radius = SceneFile().robot.helix_radius
    return {
        **{
            f"{which}error {name}": abs(run.numbers[name] / exact.numbers[name] - 1)
            for name in ("v_x", "head rate")
        },
        f"{which}error nodes": float(np.sqrt(square.mean())) / radius,
        f"{which}error nodes at end": float(np.sqrt(square[-1])) / radius,
    }


def slope(x: Iterable[float], y: Iterable[float]) -> float:
    """Of the straight line through the logarithms."""
    return float(np.polyfit(np.log(np.asarray(x)), np.log(np.asarray(y)), 1)[0])


def orders(quick: bool) -> pd.DataFrame:
    """Errors of the nodes over one turn of the motor, from a developed state, in fixed steps."""
    rows = []
    for drag in ("rss",) if quick else ("rss", "rft"):
        for inertia in (True,) if quick else (True, False):
            times = {"scheme": "trbdf2", "step": 0.01, "end": 2.0, "inertia": inertia}
            file = SceneFile.model_validate(
                {"fluid": {"hydrodynamics": drag}, "time": times, "solver": {"tolerance": 1e-12}}
            )
            jax.clear_caches()
            scene = derjax.build(file)
            state = scene.start
            start = _end(scene, state, 200)

            def nodes(scheme, count, scene=scene, start=start):
                timed = replace(scene, scheme=scheme, step_length=jnp.asarray(1.0 / count))
                end = _end(timed, start, count)
                return np.asarray(positions(scene.rod.topology, end.q))

            exact = nodes(trbdf2, FINEST_COUNT)
            for scheme in (trbdf2, euler):
                for count in COUNTS:
                    error = np.mean(np.sum((nodes(scheme, count) - exact) ** 2, axis=-1)) ** 0.5
                    rows.append(
                        {
                            "drag": drag,
                            "inertia": inertia,
                            "scheme": scheme.__name__,
                            "step": 1.0 / count,
                            "error nodes": error / SceneFile().robot.helix_radius,
                        }
                    )
                    print(rows[-1], flush=True)
    return pd.DataFrame(rows)


def _end(scene: derjax.Scene, state: derjax.State, count: int) -> derjax.State:
    """The state after so many steps."""
    states, report = _march(scene, state, 1, jnp.asarray(count), new_stats())
    report.raise_if_failed()
    return jax.tree.map(lambda leaf: leaf[-1], states)


# Results --------------------------------------------------------------------------------------


def fitted(table: pd.DataFrame, fine: pd.DataFrame | None) -> pd.DataFrame:
    """Orders of convergence, and over which range they were fitted."""
    rows = []

    def add(what: str, quantity: str, x: pd.Series, y: pd.Series) -> None:
        if len(x) < 2 or not (y > 0).all():
            return
        span = f"{x.min():.3g} to {x.max():.3g}"
        rows.append({"of": what, "quantity": quantity, "range": span, "order": slope(x, y)})

    if fine is not None:
        for (drag, inertia, scheme), part in fine.groupby(
            ["drag", "inertia", "scheme"], sort=False
        ):
            part = part[part.step <= ASYMPTOTIC]
            what = f"{scheme}, {drag.upper()}{', inertia' if inertia else ', no inertia'}, one turn"
            add(f"step (s): {what}", "nodes", part.step, part["error nodes"])
    runs = table[(table.case == "single") & (table.stepping == "fixed") & (table.mesh == 5e-3)]
    runs = runs[(runs.step <= ASYMPTOTIC) & (runs.scheme != "explicit")]
    for (scheme, drag), part in runs.dropna(subset="error nodes").groupby(["scheme", "drag"]):
        for quantity in QUANTITIES:
            what = f"step (s): {scheme}, {drag.upper()}, 20 s from rest"
            add(what, quantity, part.step, part[f"error {quantity}"])
    meshes = table[(table.scheme == "euler") & (table.tolerance == MESH_TOLERANCE)]
    for drag, part in meshes[meshes.case == "single"].groupby("drag"):
        part = part.sort_values("edge")
        finest, rest = part.iloc[0], part.iloc[1:]
        for quantity in ("v_x", "head rate"):
            error = rest[quantity] / finest[quantity] - 1
            clear = error.abs() > NOISE
            if (np.sign(error[clear]) == np.sign(error[clear].iloc[-1])).all():
                what = f"edge (m): {drag.upper()}, 20 s from rest"
                add(what, quantity, rest.edge[clear], error[clear].abs())
    return pd.DataFrame(rows)


def by_mesh(table: pd.DataFrame) -> pd.DataFrame:
    """Speed and head rate on every mesh, with the same tolerance, and by how much they differ."""
    chosen = table[(table.scheme == "euler") & (table.tolerance == MESH_TOLERANCE)]
    chosen = chosen.sort_values(["case", "drag", "edge"])
    rows = []
    for (case, drag), part in chosen.groupby(["case", "drag"], sort=False):
        finest = part.iloc[0]
        for _, run in part.iterrows():
            rows.append(
                {
                    "robot": case,
                    "drag": drag.upper(),
                    "edge, mm": 1e3 * run.edge,
                    "v_x, mm/s": 1e3 * run.v_x,
                    "head rate, rad/s": run["head rate"],
                    "v_x, % off finest": 100 * (run.v_x / finest.v_x - 1),
                    "head rate, % off finest": 100 * (run["head rate"] / finest["head rate"] - 1),
                    "s per simulated s": run.cost,
                }
            )
    return pd.DataFrame(rows)


def across_meshes(table: pd.DataFrame) -> pd.DataFrame:
    """Whether a tolerance, or a step, that is good enough on one mesh is so on the others."""
    rows = []
    runs = table[(table.case == "single") & (table.scheme != "explicit")]
    runs = runs[runs["error v_x"].notna() | (runs.message != "")]
    runs = runs.fillna({"tolerance": 0.0})
    for (drag, scheme, tolerance), group in runs.groupby(["drag", "scheme", "tolerance"]):
        for step, part in group.groupby("step"):
            adaptive = tolerance > 0
            how = f"tolerance {tolerance:g}" if adaptive else f"steps of {1e3 * step:.3g} ms"
            row: dict[str, Any] = {"drag": str(drag).upper(), "setting": f"{scheme}, {how}"}
            for _, run in part.iterrows():
                mesh = f"{1e3 * run.mesh:g} mm"
                row[f"{mesh}: error, %"] = 100 * max(run["error v_x"], run["error head rate"])
                row[f"{mesh}: s"] = run.cost
            rows.append(row)
    return pd.DataFrame(rows)


COLUMNS = {
    "robot": "",
    "drag": "",
    "setting": "",
    "v_x error, %": ".3f",
    "head rate error, %": ".3f",
    "nodes, RMS / R": ".2g",
    "nodes at end / R": ".2g",
    "steps": "d",
    "iterations a step": ".2f",
    "s per simulated s": ".3g",
    "faster than explicit 0.1 ms": ".0f",
}


def chosen(table: pd.DataFrame) -> pd.DataFrame:
    """The default, the explicit runs, and of every scheme the cheapest that is good enough."""
    rows = []
    for (case, drag), part in table[table.mesh == 5e-3].groupby(["case", "drag"], sort=False):
        good = (part[["error v_x", "error head rate"]] <= ENOUGH).all(axis=1)
        explicit = part[part.scheme == "explicit"]
        base = explicit.cost[np.isclose(explicit.step, EXPLICIT[0])]
        best = [
            ("cheapest within 0.5 %: ", some.cost.idxmin())
            for _, some in part[good & (part.scheme != "explicit")].groupby(["scheme", "stepping"])
        ]
        rest = [("", index) for index in explicit.index]
        for label, index in [("default: ", i) for i in part.index[part.default]] + best + rest:
            run = part.loc[index]
            how = "" if np.isnan(run.tolerance) else f"tolerance {run.tolerance:g}"
            shown = how or f"steps of {1e3 * run.step:.3g} ms"
            shown += f" ({run.message})" if run.message else ""
            rows.append(
                {
                    "robot": case,
                    "drag": drag.upper(),
                    "setting": f"{label}{run.scheme}, {shown}",
                    "v_x error, %": 100 * run["error v_x"],
                    "head rate error, %": 100 * run["error head rate"],
                    "nodes, RMS / R": run["error nodes"],
                    "nodes at end / R": run["error nodes at end"],
                    "steps": int(run.steps),
                    "iterations a step": run.iterations / max(run.steps, 1),
                    "s per simulated s": np.nan if run.message else run.cost,
                    "faster than explicit 0.1 ms": np.nan
                    if base.empty or run.message
                    else base.iloc[0] / run.cost,
                }
            )
    return pd.DataFrame(rows)


def findings(table: pd.DataFrame) -> str:
    """What was to be shown, in sentences."""
    lines = []
    single = table[(table.case == "single") & (table.mesh == 5e-3) & (table.drag == "rss")]
    ours = single[single.default].iloc[0]
    worst = max(ours["error v_x"], ours["error head rate"])
    lines.append(
        f"The default (one flagellum, RSS, 20 s) takes {ours.cost:.3g} s for a simulated second, "
        f"{'within' if ours.cost <= GOAL else 'more than'} the goal of {GOAL:g} s, and is off by "
        f"{100 * worst:.2g} % in the worse of speed and head rate."
    )
    explicit = single[(single.scheme == "explicit") & np.isclose(single.step, EXPLICIT[0])]
    if len(explicit):
        ratio = explicit.cost.iloc[0] / ours.cost
        lines.append(f"It is {ratio:.0f} times as fast as explicit drag in steps of 0.1 ms.")
    failed = table[table.message != ""]
    if len(failed):
        names = ", ".join(sorted(failed.name))
        lines.append(f"Runs that failed, or blew up, and are in no figure: {names}.")
    return " ".join(lines)


def curves(axes: plt.Axes, part: pd.DataFrame, quantity: str) -> None:
    """Error against cost, a line for each way of stepping."""
    column = f"error {quantity}"
    for how, (colour, line) in STYLES.items():
        runs = part[(part.scheme == how[0]) & (part.stepping == how[1])].dropna(subset=column)
        runs = runs.sort_values("tolerance" if how[1] == "adaptive" else "step")
        label = f"{how[0]}, {'adaptive' if how[1] == 'adaptive' else 'steps of one length'}"
        label = "explicit drag" if how[0] == "explicit" else label
        axes.plot(runs.cost, runs[column], line, color=colour, ms=4, lw=1.2, label=label)
    ours = part[part.default].dropna(subset=column)
    axes.plot(ours.cost, ours[column], "*", color="#c1272d", ms=13, label="default", zorder=5)
    if quantity != "nodes":
        axes.axhline(ENOUGH, color="black", lw=0.8, ls=":")
    if "single" in set(part.case):
        axes.axvline(GOAL, color="0.6", lw=0.8, ls=":")
    axes.set(xscale="log", yscale="log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.25, which="major")


def draw(table: pd.DataFrame, case: str) -> plt.Figure:
    """Error against cost on the mesh of 5 mm: a row for each quantity, a column for each drag."""
    part = table[(table.case == case) & (table.mesh == 5e-3) & (table.message == "")]
    drags = list(dict.fromkeys(part.drag))
    figure, axes = plt.subplots(
        len(QUANTITIES),
        len(drags),
        figsize=(4.6 * len(drags) + 0.6, 8.6),
        sharex=True,
        sharey="row",
        squeeze=False,
        layout="constrained",
    )
    for column, drag in enumerate(drags):
        axes[0, column].set_title({"rss": "Stokeslet segments", "rft": "local drag"}[drag])
        for line, (quantity, label) in enumerate(QUANTITIES.items()):
            curves(axes[line, column], part[part.drag == drag], quantity)
            if column == 0:
                axes[line, 0].set_ylabel(label)
        axes[-1, column].set_xlabel("processor seconds per simulated second")
    handles, names = axes[0, 0].get_legend_handles_labels()
    columns = 3 if len(drags) > 1 else 2
    figure.legend(handles, names, loc="outside lower center", ncols=columns, frameon=False)
    return figure


def draw_meshes(table: pd.DataFrame) -> plt.Figure:
    """Errors of the head rate against cost, a line for each mesh, in steps that adapt."""
    part = table[(table.case == "single") & (table.stepping == "adaptive") & (table.message == "")]
    rows = {"error head rate": "error in time", "whole error head rate": "whole error"}
    drags = list(dict.fromkeys(part.drag))
    figure, axes = plt.subplots(
        2,
        len(drags),
        figsize=(4.9 * len(drags), 7.0),
        sharex=True,
        sharey=True,
        squeeze=False,
        layout="constrained",
    )
    colours = plt.get_cmap("viridis")(np.linspace(0.1, 0.8, len(MESHES["single"])))
    for column, drag in enumerate(drags):
        axes[0, column].set_title({"rss": "Stokeslet segments", "rft": "local drag"}[drag])
        for panel, quantity in zip(axes[:, column], rows, strict=True):
            for mesh, colour in zip(MESHES["single"], colours, strict=True):
                for scheme, line in (("trbdf2", "o-"), ("euler", "s--")):
                    runs = part[(part.drag == drag) & (part.mesh == mesh)]
                    runs = runs[runs.scheme == scheme].sort_values("tolerance")
                    label = f"{scheme}, edges of {1e3 * mesh:g} mm"
                    error = runs[quantity]
                    panel.plot(runs.cost, error, line, ms=4, lw=1.2, color=colour, label=label)
                    ours = runs.default
                    panel.plot(runs.cost[ours], error[ours], "*", color="#c1272d", ms=12, zorder=5)
            panel.set(xscale="log", yscale="log")
            panel.axhline(ENOUGH, color="black", lw=0.8, ls=":")
            panel.grid(alpha=0.25)
        axes[1, column].set_xlabel("processor seconds per simulated second")
    for panel, label in zip(axes[:, 0], rows.values(), strict=True):
        panel.set_ylabel(f"{label}, head rate")
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False)
    return figure


def draw_orders(fine: pd.DataFrame) -> plt.Figure:
    """Error over one turn of the motor against the length of the steps."""
    count = fine.inertia.nunique()
    figure, axes = plt.subplots(
        1, count, figsize=(4.8 * count, 4.2), sharey=True, squeeze=False, layout="constrained"
    )
    for panel, (inertia, part) in zip(axes[0], fine.groupby("inertia", sort=False), strict=True):
        for (drag, scheme), runs in part.groupby(["drag", "scheme"], sort=False):
            colour = STYLES[scheme, "fixed" if drag == "rss" else "adaptive"][0]
            close = runs[runs.step <= ASYMPTOTIC]
            order = slope(close.step, close["error nodes"])
            label = f"{scheme}, {drag.upper()}: order {order:.2f}"
            line = "o-" if scheme == "trbdf2" else "s--"
            panel.plot(runs.step, runs["error nodes"], line, color=colour, ms=4, label=label)
        panel.axvspan(fine.step.min() * 0.9, ASYMPTOTIC * 1.05, color="0.94", zorder=0)
        panel.set(xscale="log", yscale="log", xlabel="step, s")
        panel.set_title("with inertia" if inertia else "without inertia")
        panel.legend(frameon=False, fontsize="small")
        panel.grid(alpha=0.25)
    axes[0, 0].set_ylabel("RMS of nodes / R after one turn")
    return figure


def write(table: pd.DataFrame, fine: pd.DataFrame | None, output: Path) -> None:
    """All files."""
    table.to_csv(output / "work_precision.csv", index=False, float_format="%.6g")
    parts = [findings(table)] if "single" in set(table.case) else []
    parts.append(markdown(chosen(table), COLUMNS))
    parts.append("Orders of convergence, fitted over a range of steps or of edges:")
    formats = {"of": "", "quantity": "", "range": "", "order": ".2f"}
    parts.append(markdown(fitted(table, fine), formats))
    meshes = by_mesh(table)
    if len(meshes) > 1:
        parts.append(
            f"Meshes, with implicit Euler at a tolerance of {MESH_TOLERANCE:g}, which adds the "
            "same error on all of them. Shaft and links of the head are as long as an edge, so "
            "that a robot of a finer mesh is also a slightly shorter one:"
        )
        texts = ("robot", "drag")
        parts.append(markdown(meshes, {c: "" if c in texts else ".3f" for c in meshes}))
    if (table[table.case == "single"].groupby("scheme").mesh.nunique() > 1).any():
        across = across_meshes(table)
        parts.append(
            "The same setting on several meshes, one flagellum: the worse of the errors of speed "
            "and head rate against the finest steps on that mesh, and the cost of a second:"
        )
        texts = ("drag", "setting")
        parts.append(markdown(across, {c: "" if c in texts else ".3g" for c in across}))
    text = "\n\n".join(part.strip() for part in parts) + "\n"
    (output / "work_precision.md").write_text(text, encoding="utf-8")
    if "single" in set(table.case):
        draw(table, "single").savefig(output / "work_precision.png", dpi=150)
        if len(set(table.mesh)) > 2:
            draw_meshes(table).savefig(output / "work_precision_mesh.png", dpi=150)
    if "two" in set(table.case):
        draw(table, "two").savefig(output / "work_precision_two.png", dpi=150)
    if fine is not None:
        fine.to_csv(output / "work_precision_order.csv", index=False, float_format="%.6g")
        draw_orders(fine).savefig(output / "work_precision_order.png", dpi=150)
    print(text)


def contents() -> str:
    """A few digits that change with the sources of derjax."""
    digest = hashlib.sha256()
    for path in sorted(Path(derjax.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--quick", action="store_true", help="few runs: RSS, one mesh")
    parser.add_argument("--only", choices=list(CASES), help="this robot only")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="of timing")
    parser.add_argument("--cache", type=Path, help="where runs are kept")
    arguments = parser.parse_args()
    kept = Path(tempfile.gettempdir()) / f"derjax_work_precision_{contents()}"
    runs = Runs(arguments.cache or kept)
    cases = [arguments.only] if arguments.only else list(CASES)
    wanted = [setting for case in cases for setting in settings(case, arguments.quick)]
    for setting in wanted:
        runs.make(setting)
    for _ in range(1, arguments.rounds):
        for setting in wanted:
            runs.again(setting, arguments.rounds)
    table = pd.DataFrame([row(runs, setting) for setting in wanted])
    kept_orders = runs.directory / f"orders{'-quick' if arguments.quick else ''}.csv"
    if not kept_orders.exists():
        orders(arguments.quick).to_csv(kept_orders, index=False)
    write(table, pd.read_csv(kept_orders), arguments.output)


if __name__ == "__main__":
    main()
