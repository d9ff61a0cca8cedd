"""What contact and friction cost in a step, when nothing touches and in a full bundle.

    python -m benchmarks.contact_cost [-o docs/figures]

Takes the two-flagella robot (pitch / radius = 5, antiphase, 60 rpm, steps of 5 ms) at the start and
after 10 s, when the flagella are bundled, and times the same number of steps from either state with
and without contact, alternately, on the processor time of one process. Writes contact_cost.csv and
contact_cost.md.
"""

import time

import jax
import numpy as np
import pandas as pd

import derjax
from derjax.scenes.file import SceneFile

from .command import command_line
from .tables import write

STEPS, ROUNDS, BUNDLED = 40, 7, 10.0
VARIANTS = {
    "no contact": {"contact": {"method": "none"}},
    "contact": {},
    "contact and friction": {"friction": {"coefficient": 0.3}},
}


def scene(**tables: dict) -> SceneFile:
    """The two-flagella robot."""
    robot = {"kind": "two_flagella", "pitch": 31.8e-3, "phase": [np.pi, 0.0]}
    time = {"step": 5e-3, "end": BUNDLED, "frame": STEPS * 5e-3}
    return SceneFile.model_validate({"robot": robot, "time": time, **tables})


_rollout = jax.jit(derjax.roll_frames, static_argnums=(2, 3))


def bundled() -> derjax.State:
    """The state after some time with contact."""
    file = scene(contact={"capacity": 400})
    built = derjax.build(file)
    state = built.start
    states, report = _rollout(built, state, file.n_frames, STEPS)
    report.raise_if_failed()
    return jax.tree.map(lambda leaf: leaf[-1], states)


def seconds(built: derjax.Scene, state: derjax.State) -> tuple[float, float]:
    """Processor time (s) of a step from `state`, and its Newton iterations."""
    began = time.process_time()
    _, report = jax.block_until_ready(_rollout(built, state, 1, STEPS))
    report.raise_if_failed()
    return (time.process_time() - began) / STEPS, int(report.iterations) / STEPS


def main() -> None:
    arguments = command_line(__doc__).parse_args()
    scenes = {name: derjax.build(scene(**tables)) for name, tables in VARIANTS.items()}
    states = {"nothing touches": scenes["contact"].start, "bundle": bundled()}
    rows = []
    for where, state in states.items():
        samples = {name: [] for name in scenes}
        iterations = {}
        for k in range(ROUNDS + 1):
            for name, built in scenes.items():
                spent, iterations[name] = seconds(built, state)
                if k:  # the first round compiles
                    samples[name].append(spent)
        base = np.array(samples["no contact"])
        for name, spent in samples.items():
            rows.append(
                {
                    "state": where,
                    "scene": name,
                    "ms per step": 1e3 * min(spent),
                    "relative": float(np.median(np.array(spent) / base)),
                    "iterations per step": iterations[name],
                }
            )
            print(rows[-1], flush=True)
    formats = {"state": "", "scene": "", "ms per step": ".2f", "relative": ".2f"}
    formats["iterations per step"] = ".2f"
    write(pd.DataFrame(rows), arguments.output / "contact_cost.csv", formats)


if __name__ == "__main__":
    main()
