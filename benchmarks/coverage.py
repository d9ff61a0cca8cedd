"""How often the 95 % intervals of a fit contain the truth, for what a camera measures.

Simulates the runs of data/camera with the true parameters, takes the sensitivities, and adds
camera noise a hundred times (`fitting.uncertainty.coverage`):

    python -m benchmarks.coverage
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from fitting import load_dataset
from fitting.model import Model
from fitting.transforms import select_parameters
from fitting.uncertainty import coverage, uncertainty

DATASET = Path(__file__).parents[1] / "data" / "camera" / "dataset.toml"
TRUTH = {"C_t": 4.8, "C_r": 0.36}
NOISE = (1e-4, 0.02)
"""Of positions (m) and of the head angle (rad)."""
SEEDS = range(100)


def main() -> None:
    """Print how often each interval contains the truth, and how wide it is."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    dataset = load_dataset(DATASET)
    parameters = select_parameters(tuple(TRUTH), dataset.scene.parameters)
    model = Model(dataset, parameters)
    trial = model.whole(parameters.free(TRUTH))
    if trial is None:
        raise SystemExit(model.failure)
    perfect = trial.residuals
    noise = np.array(NOISE)[perfect.kind]
    fractions = coverage(perfect, noise, SEEDS)
    known = uncertainty(replace(perfect, sigma=noise), parameters.names)
    for name, fraction, std in zip(parameters.names, fractions, known.std, strict=True):
        print(f"{name}: {fraction:.0%} of {len(SEEDS)} trials; standard error {std:.3%}")


if __name__ == "__main__":
    main()
