"""Fitting parameters of derjax scenes to tracked motions, and designing robots by gradients.

dataset file --load_dataset--> Dataset --calibrate--> Fit --write--> fit.json, figure
"""

import derjax  # noqa: F401  (switches JAX to 64-bit floating point)

from .calibrate import calibrate as calibrate
from .outcome import Fit as Fit
from .tracks import Dataset as Dataset
from .tracks import Run as Run
from .tracks import load_dataset as load_dataset
