"""How often the 95 % intervals of a fit contain the truth, for what a camera measures.

Simulates the runs of data/camera with the true parameters, takes the sensitivities, and adds
camera noise a hundred times (`fitting.uncertainty.coverage`):

    python -m benchmarks.coverage
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from fitting import load_dataset
from fitting.calibrate import residuals
from fitting.observe import interpolation
from fitting.simulate import Simulator, motor_rate, steps_per_call
from fitting.transforms import choose
from fitting.uncertainty import coverage, uncertainty

DATASET = Path(__file__).parents[1] / "data" / "camera" / "dataset.toml"
TRUTH = {"C_t": 4.8, "C_r": 0.36}
NOISE = (1e-4, 0.02)
"""Of positions (m) and of the head angle (rad)."""
SEEDS = range(100)


def main() -> None:
    """Print how often each interval contains the truth, and how wide it is."""
    dataset = load_dataset(DATASET)
    scene = dataset.scene
    parameters = choose(tuple(TRUTH), scene.parameters)
    steps = [interpolation(run.time, scene.step).n_steps for run in dataset.runs]
    simulator = Simulator(scene, parameters, steps_per_call(max(steps)))
    free = parameters.free(TRUTH)
    rates = [motor_rate(scene, run) for run in dataset.runs]
    simulator.compile(free, rates[0])
    simulated = simulator.runs(free, rates, steps)
    perfect = residuals(dataset.runs, simulated, scene.step)
    noise = np.array(NOISE)[perfect.kind]
    fractions = coverage(perfect, noise, SEEDS)
    known = uncertainty(replace(perfect, sigma=noise), parameters.names)
    for name, fraction, std in zip(parameters.names, fractions, known.std, strict=True):
        print(f"{name}: {fraction:.0%} of {len(SEEDS)} trials; standard error {std:.3%}")


if __name__ == "__main__":
    main()
