"""Who runs scenes: single runs with checkpoints, batches and sweeps."""
