"""Tracks that begin after the transient, what else is not known, and all data at once."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import TIMES as SHORT
from conftest import synthetic_run

from derjax import InputError, SceneFile, build, rollout
from derjax.rods.head import head_angle, head_position
from fitting.joint.assemble import assemble
from fitting.joint.file import KnownPrior, NoiseFile, Nuisances, Shared
from fitting.joint.fit import calibrate_jointly
from fitting.joint.gait import Gait, swum
from fitting.joint.parts import TrackPart
from fitting.joint.posterior import predicted_by
from fitting.joint.rates import Rates
from fitting.joint.sources import source
from fitting.tracks import Dataset, Run

TRUTH = {"C_t": 4.8, "C_r": 0.36}
TIMES = np.arange(0.0, 120.0, 2.0)
NOISE = np.array([1e-4, 1e-4, 1e-4, 0.02])
RATES = (45.0, 65.0)


@pytest.fixture(scope="module")
def gaits(scene: SceneFile) -> dict[float, np.ndarray]:
    """The gait with the true parameters, by the rate of the motor."""
    return {rpm: source(scene, rpm, tuple(TRUTH))(np.array([4.8, 0.36])).gait for rpm in RATES}


def track(gait: np.ndarray, seed: int, roll: float = 1.0) -> np.ndarray:
    """(f, 4) what a camera sees."""
    exact = swum(Gait.of(jnp.asarray(gait)), jnp.asarray(TIMES), 0.0, roll)
    return np.asarray(exact) + NOISE * np.random.default_rng(seed).normal(size=(len(TIMES), 4))


def nuisances(**tables) -> Nuisances:
    return Nuisances.model_validate(tables)


@pytest.fixture(scope="module")
def dataset(scene, gaits) -> Dataset:
    runs = tuple(
        Run(
            f"rpm{rpm:g}",
            TIMES + 30.0,
            (0, 1, 2, 3),
            track(gaits[rpm], k),
            rpm,
            steady=True,
            free_origin=True,
        )
        for k, rpm in enumerate(RATES)
    )
    return Dataset(scene, runs)


def within(fit, name: str, errors: float = 4.0) -> bool:
    estimate = fit.estimates[name]
    return abs(estimate.value - TRUTH[name]) < errors * estimate.std


def changed(dataset: Dataset, change, **fields) -> Dataset:
    """The dataset with other values in its runs, `change(time, values)`, and other fields."""
    runs = tuple(
        replace(run, values=change(run.time - run.time[0], run.values), **fields)
        for run in dataset.runs
    )
    return replace(dataset, runs=runs)


@pytest.mark.slow
def test_a_gait_is_what_a_simulation_settles_to(scene, gaits) -> None:
    fine = scene.time.model_copy(update={"step": 0.01, "end": 16.0})
    fine_scene = scene.model_copy(update={"time": fine})
    built = build(fine_scene, {**scene.parameters, **TRUTH, "rpm": RATES[0]})
    run = rollout(built, end=16.0)
    topology = built.rod.topology
    late = np.asarray(run.time) > 8.0
    time = np.asarray(run.time)[late]
    place = np.asarray(head_position(topology, run.states))[late]
    angle = np.asarray(head_angle(topology, run.states))[late]
    gait = Gait.of(jnp.asarray(gaits[RATES[0]]))
    # Steps of 10 ms, of first order.
    assert np.polyfit(time, place[:, 0], 1)[0] == pytest.approx(float(gait.speed), rel=0.015)
    assert np.polyfit(time, angle, 1)[0] == pytest.approx(float(gait.head_rate), rel=0.015)


def test_derivatives_of_all_that_is_seen(dataset) -> None:
    unsure = nuisances(motor_rpm={"std": 1.0}, drift={"std": 1e-4}, viscosity={"std": 0.1})
    runs = tuple(replace(run, nuisances=unsure) for run in dataset.runs)
    noise = NoiseFile.model_validate({"discrepancy": {"way": 0.01, "angle": 0.01}})
    problem = assemble(replace(dataset, runs=runs, noise=noise), tuple(TRUTH), {"C_t": 4.0})
    free = problem.unknowns.start()
    free += 0.1 * np.random.default_rng(0).normal(size=free.size)
    exact = problem.evaluate(free).residuals.jacobian
    for k in range(free.size):
        step = 1e-4 * np.eye(free.size)[k]
        ends = [problem.evaluate(free + sign * step).residuals.value for sign in (-1, 1)]
        difference = (ends[1] - ends[0]) / 2e-4
        error = np.abs(difference - exact[:, k]).max()
        assert error < 1e-5 * max(np.abs(exact[:, k]).max(), 1e-6), problem.unknowns.names[k]


def test_an_exposed_track_is_the_mean_of_sharp_ones(dataset) -> None:
    problem = assemble(dataset, tuple(TRUTH), TRUTH)
    point = problem.evaluate(problem.unknowns.start()).model
    sharp, exposure = problem.parts[0], 0.4
    blurred = replace(sharp, run=replace(sharp.run, exposure=exposure))
    shifts = exposure * ((np.arange(40) + 0.5) / 40 - 0.5)
    each = [sharp.predicted(point, 0, TIMES + 30.0 + shift) for shift in shifts]
    for k, found in enumerate(blurred.predicted(point, 0)):
        mean = np.mean([one[k] for one in each], axis=0)
        np.testing.assert_allclose(found, mean, atol=1e-4 * np.abs(mean).max(), rtol=1e-4)
    solved: Any = SimpleNamespace(problem=SimpleNamespace(parts=(blurred, *problem.parts[1:])))
    made: Any = {k: lambda _, g=known.gait: jnp.asarray(g) for k, known in point.gaits.items()}
    drawn = predicted_by(solved, made)(jnp.zeros(0), jnp.asarray(point.values))
    expected = blurred.predicted(point, 0)[0].T.ravel()
    np.testing.assert_allclose(drawn[: expected.size], expected, atol=1e-12)
    # The head goes round the axis: its blurred circle is smaller.
    radius = [np.ptp(p.predicted(point, 0)[0][:, 1]) for p in (sharp, blurred)]
    assert radius[1] < 0.999 * radius[0]


def test_tracks_after_the_transient_give_the_truth(dataset) -> None:
    fit, _ = calibrate_jointly(dataset)
    assert fit.status == "converged"
    assert fit.goodness.good
    assert within(fit, "C_t")
    assert within(fit, "C_r")
    assert fit.estimates["C_t"].std < 0.05
    assert fit.noise["position"] == pytest.approx(1e-4, rel=0.15)
    assert fit.noise["head_angle"] == pytest.approx(0.02, rel=0.2)
    assert "without simulating the transient" in fit.said[0]


def rolled(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def test_a_robot_that_swims_askew(dataset) -> None:
    askew = changed(dataset, lambda t, v: np.c_[v[:, :3] @ rolled(0.2).T, v[:, 3]])
    fit, _ = calibrate_jointly(askew)
    assert within(fit, "C_t")
    assert fit.nuisances["rpm45: orientation about z"].value == pytest.approx(0.2, abs=0.02)


def test_a_drift_along_the_way_is_told_from_speed_by_its_prior(dataset) -> None:
    flow = np.array([1e-4, 0.0, 0.0, 0.0])
    drifting = changed(dataset, lambda t, v: v + t[:, None] * flow)
    ignored, _ = calibrate_jointly(drifting)
    assert not within(ignored, "C_t")
    known = replace(
        drifting,
        runs=tuple(replace(r, nuisances=nuisances(drift={"std": 1e-4})) for r in drifting.runs),
    )
    fit, _ = calibrate_jointly(known)
    assert within(fit, "C_t", 3.0)
    assert fit.estimates["C_t"].std > 3 * ignored.estimates["C_t"].std


@pytest.mark.slow
def test_a_motor_that_is_slower_than_it_says(dataset) -> None:
    said = tuple(replace(run, motor_rpm=run.motor_rpm * 1.02) for run in dataset.runs)
    wrong = replace(dataset, runs=said)
    ignored, _ = calibrate_jointly(wrong)
    assert not within(ignored, "C_r", 3.0)
    std = nuisances(motor_rpm={"std": 1.0})
    fit, _ = calibrate_jointly(
        replace(wrong, runs=tuple(replace(run, nuisances=std) for run in said))
    )
    assert within(fit, "C_t")
    assert within(fit, "C_r")


def test_all_at_once(dataset, scene, gaits) -> None:
    """A track, speeds and a prior: errors are smaller than those of each, and the truth inside."""
    speeds = np.array([gaits[rpm][0] for rpm in RATES])
    rates = np.array([gaits[rpm][2] for rpm in RATES])
    table = Rates(
        "speeds", np.array(RATES), speeds, 0.01 * np.abs(speeds), rates, 0.01 * np.abs(rates), scene
    )
    one = replace(dataset, runs=dataset.runs[:1])
    alone, _ = calibrate_jointly(one)
    fit, _ = calibrate_jointly(replace(one, rates=(table,)))
    assert within(fit, "C_t")
    assert within(fit, "C_r")
    assert fit.estimates["C_t"].std < alone.estimates["C_t"].std
    prior = {"C_t": KnownPrior(mean=4.8, std=0.001)}
    sure, _ = calibrate_jointly(replace(one, rates=(table,), priors=prior))
    assert sure.estimates["C_t"].std < 0.0011


@pytest.mark.slow
def test_a_viscosity_for_all_and_a_parameter_of_one_run(dataset) -> None:
    runs = (dataset.runs[0], replace(dataset.runs[1], own=("C_r",)))
    shared = Shared.model_validate({"viscosity": {"std": 0.02}})
    fit, _ = calibrate_jointly(replace(dataset, runs=runs, shared=shared))
    assert set(fit.estimates) == {"C_t", "C_r", "C_r of rpm65"}
    assert fit.nuisances["viscosity (of all)"].std == pytest.approx(0.02, rel=0.2)
    for name in ("C_r", "C_r of rpm65"):
        assert abs(fit.values[name] - 0.36) < 4 * fit.estimates[name].std


@pytest.mark.slow
def test_two_robots_with_a_drag_in_common(dataset, scene) -> None:
    """Another pitch in the second run, whose head spins against another drag."""
    robot = scene.robot.model_copy(update={"pitch": 0.06})
    other = scene.model_copy(update={"robot": robot})
    gait = source(other, RATES[1], tuple(TRUTH))(np.array([4.8, 0.5])).gait
    second = replace(dataset.runs[1], values=track(gait, 5), scene=other, own=("C_r",))
    fit, _ = calibrate_jointly(replace(dataset, runs=(dataset.runs[0], second)))
    assert set(fit.estimates) == {"C_t", "C_r", "C_r of rpm65"}
    for name, truth in {"C_t": 4.8, "C_r": 0.36, "C_r of rpm65": 0.5}.items():
        e = fit.estimates[name]
        assert abs(e.value - truth) < 4 * e.std
        assert e.std < 0.02 * truth


def test_speeds_and_drift_without_a_prior_are_not_identifiable(dataset) -> None:
    free = tuple(replace(run, nuisances=nuisances(drift={})) for run in dataset.runs)
    fit, _ = calibrate_jointly(replace(dataset, runs=free))
    assert fit.estimates["C_t"].std > 2.0
    assert fit.estimates["C_r"].std < 0.1


@pytest.mark.slow
def test_a_track_from_rest_joins(simulator, scene, gaits) -> None:
    """A track from rest, filmed some time after its motor started, and speeds."""
    late = synthetic_run(simulator, 45.0, SHORT, TRUTH, sigma=1e-5, sigma_angle=1e-3)
    offset = 0.1
    unsure = nuisances(time_offset={"std": 0.3})
    early = replace(late, time=late.time - offset, nuisances=unsure)
    early = replace(early, time=early.time[2:], values=early.values[2:])
    speeds = np.array([gaits[rpm][0] for rpm in RATES])
    none = np.full(2, np.nan)
    table = Rates("speeds", np.array(RATES), speeds, 0.05 * np.abs(speeds), none, none, scene)
    data = Dataset(scene, (early,), rates=(table,))
    fit, _ = calibrate_jointly(data, initial={"C_t": 4.5, "C_r": 0.4})
    assert fit.values["C_t"] == pytest.approx(4.8, rel=0.02)
    assert fit.values["C_r"] == pytest.approx(0.36, rel=0.02)
    assert fit.nuisances["rpm45: time_offset"].value == pytest.approx(offset, abs=0.01)


def test_the_other_way_round_is_told(dataset) -> None:
    backwards = changed(dataset, lambda t, v: v * np.array([-1.0, 1.0, 1.0, 1.0]))
    with pytest.raises(InputError, match="the other way"):
        calibrate_jointly(backwards)


def test_what_has_no_effect_is_refused(dataset) -> None:
    angles = tuple(
        replace(run, channels=(3,), values=run.values[:, 3:], nuisances=nuisances(drift={}))
        for run in dataset.runs
    )
    with pytest.raises(InputError, match=r"nuisances\.drift: has no effect"):
        assemble(replace(dataset, runs=angles), tuple(TRUTH), {})
    with pytest.raises(InputError, match="not among the parameters that are fitted"):
        assemble(replace(dataset, priors={"pitch": KnownPrior(mean=1, std=1)}), tuple(TRUTH), {})


def test_parts_know_their_tracks(dataset) -> None:
    problem = assemble(dataset, tuple(TRUTH), TRUTH)
    part = problem.parts[0]
    assert isinstance(part, TrackPart)
    rows = part.rows(problem.point(problem.unknowns.start()))
    assert part.table(rows.value).shape == dataset.runs[0].values.shape
