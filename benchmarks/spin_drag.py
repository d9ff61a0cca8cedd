"""What the drag on the spin of the flagellum changes, and how much of it a fitted C_r takes in.

    python -m benchmarks.spin_drag [-o docs/figures]

The default robot at 60 and at 100 rpm, without that drag, as in the published model, and with it.
Then C_r is sought with which the model without it turns its head as fast as the one with it: that
is what a fit to tracks of a real robot finds. Writes spin_drag.csv and .md.
"""

import jax
import numpy as np
import pandas as pd
from scipy.optimize import brentq

import derjax
from derjax import SceneFile
from derjax.integrate.frames import march_frames
from derjax.results.dataset import to_dataset
from derjax.results.summary import summarise
from derjax.rods.kinematics import positions

from .command import command_line
from .tables import write

RPM = (60.0, 100.0)

_march = jax.jit(march_frames, static_argnums=(2, 3))


def scene(rpm: float, spin_drag: bool) -> SceneFile:
    """The default robot; steps of a tenth of the usual error."""
    tables = {"motor": {"rpm": rpm}, "fluid": {"spin_drag": spin_drag}}
    return SceneFile.model_validate(tables | {"time": {"tolerance": 2e-4}})


def motion(file: SceneFile, C_r: float) -> dict[str, float]:
    """Speed (m/s), head rate (rad/s), motor torque (N m), and the part of it that spin drag makes.

    Without inertia to speak of the torque of the motor is that of the drag on the head. That of
    spin drag about the axis is the sum of 4 pi mu r_0^2 l t_x^2 times the flagellum's rate.
    """
    built = derjax.build(file, {"C_r": C_r})
    state = built.start
    states, report = _march(built, state, file.n_frames, file.steps_per_frame)
    report.raise_if_failed()
    summary = summarise(to_dataset(built, jax.tree.map(np.asarray, states)))
    rate, p = summary["head_rate_rad_per_s"], file.parameters
    torque = 8 * np.pi * p["viscosity"] * p["head_radius"] ** 3 * C_r * abs(rate)
    topology = built.rod.topology
    x = np.asarray(positions(topology, states.q))[-1, list(topology.filaments[0])]
    edges = np.diff(x, axis=0)
    length = np.linalg.norm(edges, axis=1)
    turning = 2 * np.pi / 60 * abs(p["rpm"]) - abs(rate)
    zeta = 4 * np.pi * p["viscosity"] * p["rod_radius"] ** 2
    spun = zeta * turning * float(np.sum(edges[:, 0] ** 2 / length))
    share = spun / torque if file.fluid.spin_drag else 0.0
    return {"v_x": summary["v_x_m_per_s"], "head rate": rate, "torque": torque, "share": share}


def measure() -> pd.DataFrame:
    """Three rows for each rate of the motor."""
    rows = []
    for rpm in RPM:
        without, with_it = scene(rpm, False), scene(rpm, True)
        usual = with_it.head.C_r
        truth = motion(with_it, usual)

        def excess(
            C_r: float, file: SceneFile = without, rate: float = truth["head rate"]
        ) -> float:
            return motion(file, C_r)["head rate"] / rate - 1

        fitted = float(brentq(excess, 0.7 * usual, usual, xtol=1e-5))
        base = motion(without, usual)
        for name, C_r, found in (
            ("without", usual, base),
            ("with", usual, truth),
            ("without, C_r fitted", fitted, motion(without, fitted)),
        ):
            changes = {
                f"{key} change": found[key] / base[key] - 1
                for key in ("v_x", "head rate", "torque")
            }
            rows.append({"rpm": rpm, "spin drag": name, "C_r": C_r, **found, **changes})
            print(rows[-1], flush=True)
    return pd.DataFrame(rows)


def main() -> None:
    arguments = command_line(__doc__).parse_args()
    table = measure()
    formats = {
        "rpm": ".0f",
        "spin drag": "",
        "C_r": ".4f",
        "v_x": ".4e",
        "head rate": ".4f",
        "torque": ".4e",
        "share": ".1%",
        "v_x change": ".1%",
        "head rate change": ".1%",
        "torque change": ".1%",
    }
    note = (
        "The default robot: speed (m/s), head rate (rad/s), torque of the motor (N m), the share "
        "of it that the drag on the spin of the flagellum makes, and changes against the "
        "published model, which has none. `C_r fitted` is that with which it turns its head as "
        "fast as the model with spin drag."
    )
    write(table, arguments.output / "spin_drag.csv", formats, note)
    print((arguments.output / "spin_drag.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
