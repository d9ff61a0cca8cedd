"""Gaits of robots that come back to what they were once in a turn of their motors."""

import numpy as np
import pytest

from derjax import SceneFile
from fitting.joint.fit import calibrate_jointly
from fitting.joint.gait import Gait, swum
from fitting.joint.periodogram import turning
from fitting.joint.posterior import posterior
from fitting.joint.sources import OrbitSource, source
from fitting.tracks import Dataset, Run

pytestmark = pytest.mark.slow

TRUTH = {"C_t": 4.8, "C_r": 0.36}
VALUES = np.array(list(TRUTH.values()))
NAMES = tuple(TRUTH)


@pytest.fixture(scope="module")
def limping(scene: SceneFile) -> SceneFile:
    """The coarse robot on a shaft that goes limp once in every turn."""
    return scene.model_copy(update={"motor": scene.motor.model_copy(update={"hinge": "published"})})


@pytest.fixture(scope="module")
def found(limping: SceneFile) -> OrbitSource:
    made = source(limping, 45.0, NAMES)
    assert isinstance(made, OrbitSource)
    return made


def test_derivatives_are_those_of_differences(limping, monkeypatch) -> None:
    monkeypatch.setattr("fitting.joint.sources.TOLERANCE", 1e-9)
    monkeypatch.setattr("fitting.joint.sources.ACCURACY", 1e-7)
    found = source(limping, 45.0, NAMES)
    known = found(VALUES)
    assert known.gait[3] == pytest.approx(45.0 * 2 * np.pi / 60)
    for k in range(len(NAMES)):
        step = 1e-2 * VALUES[k] * np.eye(2)[k]
        ends = [found(VALUES + sign * step).gait for sign in (-1, 1)]
        difference = (ends[1] - ends[0]) / (2e-2 * VALUES[k])
        assert difference[:3] == pytest.approx(known.jacobian[:3, k], rel=1e-3)
        of_path = np.abs(known.jacobian[4:, k]).max()
        assert np.abs(difference - known.jacobian[:, k])[4:].max() < 1e-2 * of_path


def test_derivatives_of_a_fit_are_good_enough(found, monkeypatch) -> None:
    quick = found(VALUES).jacobian
    monkeypatch.setattr("fitting.joint.sources.ACCURACY", 1e-8)
    exact = found(VALUES).jacobian
    size = np.abs(exact).max(axis=1, keepdims=True)
    assert np.all(np.abs(quick - exact)[:3] <= 2e-3 * size[:3])


def test_the_same_is_found_from_elsewhere(found) -> None:
    """From the last orbit as from rest: there is one."""
    elsewhere = found(np.array([4.0, 0.45])).gait
    again = found(VALUES)
    fresh = OrbitSource(found.scene, NAMES)(VALUES)
    assert np.abs(elsewhere[:3] - fresh.gait[:3]).max() > 0.05 * np.abs(fresh.gait[:3]).max()
    assert again.gait[:3] == pytest.approx(fresh.gait[:3], rel=1e-4)
    assert again.jacobian[:3] == pytest.approx(fresh.jacobian[:3], rel=2e-3)


def side_view(found: OrbitSource, noise: float) -> Run:
    """x and y of a robot whose head is 25 micrometres from its way."""
    frames = np.arange(0.0, 60.0)
    track = np.asarray(swum(Gait.of(found(VALUES).gait), frames, 1.0, 0.7))[:, :2]
    values = track + noise * np.random.default_rng(0).normal(size=track.shape)
    return Run("side", frames, (0, 1), values, 45.0, steady=True, free_origin=True)


def test_a_side_view_gives_the_truth(limping, found) -> None:
    """How the head goes round its way tells how fast the robot turns."""
    run = side_view(found, 3e-6)
    elsewhere = found(np.array([4.3, 0.4])).gait
    assert turning(run, elsewhere) == pytest.approx(found(VALUES).gait[1], rel=0.01)
    fit, solved = calibrate_jointly(Dataset(limping, (run,)), NAMES, {"C_t": 4.3, "C_r": 0.4})
    assert fit.status == "converged"
    assert fit.goodness.good
    assert fit.said == (
        "side: compared with a periodic orbit from the first frame on, without simulating the "
        "transient; also estimated: phase, roll, orientation about z, origin x, origin y",
    )
    for name, truth in TRUTH.items():
        assert abs(fit.values[name] - truth) < 4 * fit.estimates[name].std
        assert fit.estimates[name].std < 0.01 * truth
    assert fit.noise["position"] == pytest.approx(3e-6, rel=0.3)
    assert solved.problem.evaluations < 15


def test_a_posterior_over_orbits(limping, found) -> None:
    _, solved = calibrate_jointly(Dataset(limping, (side_view(found, 3e-6),)), NAMES, TRUTH)
    drawn = posterior(solved, draws=300, chains=2)
    known = dict(zip(solved.problem.unknowns.names, solved.known.std, strict=True))
    for name, std in drawn.std().items():
        assert std / drawn.mean()[name] == pytest.approx(known[name], rel=0.3)
        assert drawn.mean()[name] == pytest.approx(TRUTH[name], rel=4 * known[name])


def test_a_motion_below_the_noise_has_no_phase(limping, found) -> None:
    """Then one speed is all there is, and this is said: a search does not follow the noise."""
    run = side_view(found, 1e-4)
    fit, solved = calibrate_jointly(Dataset(limping, (run,)), NAMES, {"C_t": 4.3, "C_r": 0.4})
    assert fit.status == "converged"
    assert "in a turn of the motors and round its way is too little to be seen" in fit.said[-1]
    assert not np.isfinite(fit.nuisances["side: roll"].std)
    assert "C_t and C_r are not identifiable together" in fit.warnings[0]
    assert solved.problem.evaluations < 8
