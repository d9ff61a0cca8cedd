"""Comparisons with experiments and exact results; run each as `python -m benchmarks.<name>`."""

import derjax as derjax  # before JAX, whose settings it makes
