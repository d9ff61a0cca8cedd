"""Steady states and their modes against simulations in time.

    python -m benchmarks.steady_in_time [-o docs/figures] [--workers 1]

The robot without inertia, its pitch 5, 7 or 9 times 6.36 mm, in steps of second order:

* *rest*: 30 s from rest at 30, 60, 100 and 200 rpm in steps of 5 and of 2.5 ms. Speed along the
  axis of rotation, rate of the head and shape over the last second, against the steady state; the
  error of the steps is a third of what differs between the two. A steady state that is unstable is
  not what a simulation from rest ends in: there it starts from the steady state, for 1 s.
* *mode*: from the steady state with and without a small part of its leading mode, in steps of
  2.5 ms: rate of growth and frequency of the difference of both, against the eigenvalue.

Writes steady_in_time.csv and .md.
"""

from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pandas as pd

import derjax as dj
from derjax.core.pytree import replace
from derjax.steady.turn import fitted

from .buckling import robot
from .command import command_line
from .parallel import in_parallel
from .tables import markdown

RADIUS = 6.4e-3
"""m, of the helix, in which shapes are compared."""
FROM_REST = [(pitch, rpm) for pitch in (5, 7, 9) for rpm in (30.0, 60.0, 100.0, 200.0)]
MODES = [(5, 140.0), (5, 170.0), (5, 180.0), (7, 240.0), (7, 260.0), (9, 200.0)]
STEPS = (5e-3, 2.5e-3)
END, LAST, FRAME = 30.0, 1.0, 0.05
"""s, of a run, of its last part, and of a frame."""
SIZE, FOLLOWED, BEGIN = 1e-3, 4.0, 1.0
"""Of the mode over the helix's radius; s, of a run, and of its first part that does not count."""


def scene(pitch: int, rpm: float, step: float) -> dj.Scene:
    time = {"inertia": False, "scheme": "trbdf2", "step": step, "end": END, "frame": FRAME}
    return dj.build(robot(pitch, time=time), {"rpm": rpm})


def moved(x: np.ndarray, to: np.ndarray) -> np.ndarray:
    """A shape, turned and moved as a whole so that it is near another one."""
    turn, shift = (np.asarray(a) for a in fitted(jnp.asarray(x), jnp.asarray(to)))
    return x @ turn.T + shift


def speed(x: np.ndarray) -> float:
    """m/s, along the axis about which a shape turns from frame to frame."""
    along = []
    for before, after in pairwise(x):
        turn, shift = (np.asarray(a) for a in fitted(jnp.asarray(before), jnp.asarray(after)))
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        along.append(shift @ axis / np.linalg.norm(axis) / FRAME)
    return float(np.mean(along))


def from_rest(pitch: int, rpm: float) -> list[dict]:
    """A row for each length of step."""
    steady = dj.steady(scene(pitch, rpm, STEPS[0]))
    steady.raise_if_failed()
    stable = dj.stability(steady).is_stable
    rows = []
    for step in STEPS:
        built = scene(pitch, rpm, step)
        state = built.start if stable else steady.state
        end = END if stable else LAST
        run = dj.rollout(built, end, frame=FRAME, state=state, reverse_mode=False)
        run.raise_if_failed()
        late = np.asarray(run.time) > end - LAST - 0.5 * FRAME
        x, angle = np.asarray(run.positions)[late], np.asarray(run.head_angle)[late]
        rate = float(np.polyfit(np.asarray(run.time)[late], angle, 1)[0])
        shape = np.asarray(steady.positions)
        away = np.linalg.norm(moved(x[-1], shape) - shape, axis=1).max()
        rows.append(
            {
                "stable": stable,
                "step_s": step,
                "v": speed(x) / float(steady.speed) - 1.0,
                "head_rate": rate / float(steady.head_rate) - 1.0,
                "shape": away / RADIUS,
            }
        )
    return rows


def mode(pitch: int, rpm: float) -> list[dict]:
    """One row: growth and frequency of a small displacement, and the eigenvalue."""
    steady = dj.steady(scene(pitch, rpm, STEPS[-1]))
    steady.raise_if_failed()
    found = dj.stability(steady)
    vector = found.modes[0]
    vector = vector / np.abs(vector).max()
    q = steady.state.q + SIZE * RADIUS * jnp.asarray(vector.real)
    runs = [
        dj.rollout(steady.scene, FOLLOWED, frame=FRAME, state=start, reverse_mode=False)
        for start in (steady.state, replace(steady.state, q=q))
    ]
    for run in runs:
        run.raise_if_failed()
    shape = np.asarray(steady.positions)
    rigid = rigid_motions(shape)
    nodes = vector[: shape.size]
    nodes = nodes - rigid @ (rigid.T @ nodes)
    # What of a displacement is this mode, and how far it has gone on its way around.
    basis = np.stack([nodes.real, -nodes.imag], axis=1)
    time = np.asarray(runs[0].time)
    parts = []
    for plain, displaced in zip(*(np.asarray(run.positions) for run in runs), strict=True):
        turn, _ = (np.asarray(a) for a in fitted(jnp.asarray(plain), jnp.asarray(shape)))
        away = ((displaced - plain) @ turn.T).ravel()
        real, imaginary = np.linalg.lstsq(basis, away - rigid @ (rigid.T @ away))[0]
        parts.append(real + 1j * imaginary)
    late = time > BEGIN
    amplitude = np.array(parts)[late]
    growth = np.polyfit(time[late], np.log(np.abs(amplitude)), 1)[0]
    turning = np.polyfit(time[late], np.unwrap(np.angle(amplitude)), 1)[0]
    value = found.eigenvalues[0]
    return [
        {
            "growth_per_s": value.real,
            "simulated_growth_per_s": growth,
            "frequency_per_s": value.imag / (2 * np.pi),
            "simulated_frequency_per_s": turning / (2 * np.pi),
        }
    ]


def rigid_motions(x: np.ndarray) -> np.ndarray:
    """(3 n, 6) orthonormal displacements of nodes in rigid motions of a shape."""
    ways = [np.broadcast_to(way, x.shape) for way in np.eye(3)]
    ways += [np.cross(way, x - x.mean(axis=0)) for way in np.eye(3)]
    return np.linalg.qr(np.stack([way.ravel() for way in ways], axis=1))[0]


STUDIES = {"rest": (from_rest, FROM_REST), "mode": (mode, MODES)}


def study(case: tuple[str, int, float]) -> list[dict]:
    """The rows of one case."""
    name, pitch, rpm = case
    where = {"study": name, "pitch_over_radius": pitch, "rpm": rpm}
    return [where | row for row in STUDIES[name][0](pitch, rpm)]


def text(table: pd.DataFrame) -> str:
    """Both tables, to be read."""
    rest, modes = (table[table["study"] == name] for name in STUDIES)
    where = {"pitch_over_radius": "d", "rpm": "g"}
    differences = dict.fromkeys(("v", "head_rate", "shape"), ".1e")
    rates = [name for name in table if str(name).endswith("_per_s")]
    return (
        "# Steady states against simulations in time\n\n"
        "`python -m benchmarks.steady_in_time`. Simulated speed and rate of the head over those of "
        "the steady state, less one, and the largest distance of a node from the steady shape, in "
        "radii of the helix:\n\n"
        f"{markdown(rest, where | {'stable': '', 'step_s': 'g'} | differences)}\n"
        "How a displacement along the leading mode grows and turns, against the eigenvalue:\n\n"
        f"{markdown(modes, where | dict.fromkeys(rates, '.4f'))}"
    )


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--workers", type=int, default=1, help="processes")
    options = parser.parse_args()
    cases = [(name, *case) for name, (_, cases) in STUDIES.items() for case in cases]
    rows = [row for found in in_parallel(study, cases, options.workers) for row in found]
    order = ["study", "pitch_over_radius", "rpm", "step_s"]
    table = pd.DataFrame(rows).sort_values(order, ascending=[True, True, True, False])
    table.to_csv(options.output / "steady_in_time.csv", index=False, float_format="%.6g")
    (options.output / "steady_in_time.md").write_text(text(table), encoding="utf-8")
    print(text(table))


if __name__ == "__main__":
    main()
