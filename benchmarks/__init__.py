"""Comparisons with experiments and exact results; run each as `python -m benchmarks.<name>`."""
