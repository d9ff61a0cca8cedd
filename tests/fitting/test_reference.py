"""Calibration against the trajectories of an independent code, whose parameters are known."""

from pathlib import Path

import pytest

from fitting import calibrate, load_dataset

DATA = Path(__file__).parents[2] / "data"


@pytest.mark.parametrize(("name", "frames"), [("reference", 200), ("camera", 40)])
def test_shipped_datasets_can_be_read(name, frames) -> None:
    dataset = load_dataset(DATA / name / "dataset.toml")
    assert [run.motor_rpm for run in dataset.runs] == [30, 70, 100]
    assert all(run.values.shape == (frames, 4) for run in dataset.runs)
    assert dataset.scene.head.C_t == dataset.scene.head.C_r == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["reference", "camera"])
def test_the_truth_is_recovered(name) -> None:
    """From C_t = C_r = 1 to within 1 % and 2 %, the difference between the two codes."""
    fit = calibrate(load_dataset(DATA / name / "dataset.toml"), compare=False)
    assert fit.status == "converged"
    assert fit.values["C_t"] == pytest.approx(4.8, rel=0.01)
    assert fit.values["C_r"] == pytest.approx(0.36, rel=0.02)
    if name == "camera":
        assert fit.noise["position"] == pytest.approx(1e-4, rel=0.15)
        assert fit.noise["head_angle"] == pytest.approx(0.02, rel=0.15)
