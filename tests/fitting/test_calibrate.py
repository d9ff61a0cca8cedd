"""Calibration against synthetic tracks with known parameters."""

from dataclasses import replace

import numpy as np
import pytest

from derjax import InputError, SolverError
from fitting.calibrate import calibrate
from fitting.causes import likely_causes
from fitting.levenberg import minimise
from fitting.model import Model
from fitting.simulate import Simulator
from fitting.tracks import Dataset

TRUTH = {"C_t": 4.8, "C_r": 0.36}
"""Of the synthetic tracks."""


@pytest.fixture(scope="module")
def fit(dataset):
    return calibrate(dataset, tolerance=1e-6)


def test_parameters_are_recovered_from_perfect_tracks(fit) -> None:
    assert fit.status == "converged"
    assert fit.start == {"C_t": 1.0, "C_r": 1.0}
    assert fit.values == pytest.approx(TRUTH, rel=1e-5)
    assert fit.iterations <= 12
    assert fit.warnings == ()
    assert fit.goodness.good
    assert fit.causes == fit.alternatives == ()
    for one in fit.runs:
        assert one.rms["position"] < 1e-8
        assert one.rms["head_angle"] < 1e-5


def test_before_is_the_simulation_of_the_start(fit, simulator) -> None:
    expected = simulator.run(np.zeros(2), np.asarray(45.0), 2 * simulator.steps_per_call)
    assert np.allclose(fit.runs[0].before.observed, expected.observed, rtol=0, atol=1e-12)
    assert np.abs(fit.runs[0].before.observed - fit.runs[0].after.observed).max() > 1e-3


def noisy(dataset: Dataset, seed: int, **fields) -> Dataset:
    rng = np.random.default_rng(seed)
    sigma = np.array([5e-5, 5e-5, 5e-5, 0.01])
    runs = [
        replace(run, values=run.values + sigma * rng.normal(size=run.values.shape), **fields)
        for run in dataset.runs
    ]
    return replace(dataset, runs=tuple(runs))


def test_noise_is_estimated_and_explains_the_error(dataset) -> None:
    fit = calibrate(noisy(dataset, 7), compare=False)
    assert fit.noise["position"] == pytest.approx(5e-5, rel=0.3)
    assert fit.noise["head_angle"] == pytest.approx(0.01, rel=0.4)
    for name, estimate in fit.estimates.items():
        assert 0 < estimate.std < 0.2 * estimate.value
        assert abs(estimate.value - TRUTH[name]) < 4 * estimate.std
        assert estimate.ci95[0] < estimate.value < estimate.ci95[1]
    assert fit.runs[0].before is None


def test_errors_are_those_of_repeated_fits(dataset) -> None:
    start = TRUTH
    fits = [
        calibrate(
            noisy(dataset, seed, sigma=5e-5, sigma_angle=0.01),
            (*TRUTH,),
            start,
            compare=False,
            explored=False,
        )
        for seed in range(16)
    ]
    for name in TRUTH:
        spread = np.std([fit.values[name] for fit in fits], ddof=1)
        claimed = np.mean([fit.estimates[name].std for fit in fits])
        # 16 fits know a standard deviation to 18 %.
        assert claimed == pytest.approx(spread, rel=0.5)


def test_given_noise_is_taken_as_given(dataset) -> None:
    once = calibrate(noisy(dataset, 3, sigma=5e-5, sigma_angle=0.01), compare=False)
    more = calibrate(noisy(dataset, 3, sigma=5.8e-5, sigma_angle=0.0116), compare=False)
    assert once.noise == pytest.approx({"position": 5e-5, "head_angle": 0.01})
    assert once.goodness.good
    assert more.goodness.good
    for name in TRUTH:
        assert more.values[name] == pytest.approx(once.values[name], rel=1e-3)
        ratio = more.estimates[name].std / once.estimates[name].std
        assert ratio == pytest.approx(1.16, rel=1e-2)


def test_only_displacements_count_with_a_free_origin(dataset) -> None:
    shift = np.array([0.4, -0.1, 0.02, 0.0])
    runs = [replace(run, values=run.values + shift, free_origin=True) for run in dataset.runs]
    fit = calibrate(replace(dataset, runs=tuple(runs)), compare=False, tolerance=1e-6)
    assert fit.values == pytest.approx(TRUTH, rel=1e-5)


def test_one_coordinate_and_the_angle_are_enough(dataset) -> None:
    runs = [replace(run, channels=(0, 3), values=run.values[:, [0, 3]]) for run in dataset.runs]
    fit = calibrate(replace(dataset, runs=tuple(runs)), compare=False, tolerance=1e-6)
    assert fit.values == pytest.approx(TRUTH, rel=1e-5)


@pytest.mark.slow
def test_a_common_scale_of_all_forces_is_reported(dataset) -> None:
    run = dataset.runs[1]
    names = ("C_t", "C_r", "youngs_modulus", "viscosity")
    fit = calibrate(
        replace(dataset, runs=(run,)), names, TRUTH, compare=False, explored=False, max_iterations=4
    )
    (warning,) = [w for w in fit.warnings if "not identifiable" in w]
    assert "youngs_modulus and viscosity" in warning
    assert "scale" in warning
    assert np.isinf(fit.estimates["viscosity"].std)
    assert np.isinf(fit.estimates["youngs_modulus"].std)


def test_progress_tells_rate_and_time_left(dataset, short_previews) -> None:
    seen = []
    fit = calibrate(dataset, initial={"C_t": 4.0, "C_r": 0.4}, progress=seen.append)
    done = [progress for progress in seen if progress.latest is not None]
    assert sum(progress.stage == "fit" for progress in done) == len(fit.history)
    assert done[-1].values == pytest.approx(fit.values)
    assert all(p.rate > 0 and p.seconds_left >= 0 for p in done)
    assert all(0 <= p.done <= 1 for p in seen)
    assert {p.stage for p in seen} == {"compile", "explore", "fit", "compare"}
    stages = [p.stage for p in seen]
    assert stages.index("explore") < stages.index("fit") < stages.index("compare")
    assert seen[-1].seconds_left == 0


@pytest.mark.parametrize("at", [1, 2])
def test_an_interruption_keeps_the_best(dataset, at) -> None:
    count = 0

    def interrupt(progress) -> None:
        nonlocal count
        count += progress.latest is not None
        if count == at:
            raise KeyboardInterrupt

    fit = calibrate(dataset, progress=interrupt, explored=False)
    assert fit.status == "interrupted"
    assert len(fit.history) == at
    assert fit.loss == min(iteration.loss for iteration in fit.history)
    assert fit.runs[0].before is None
    assert np.isfinite([e.std for e in fit.estimates.values()]).all()


@pytest.mark.parametrize("explored", [True, False])
def test_an_interruption_before_any_result_is_passed_on(dataset, explored) -> None:
    def interrupt(progress) -> None:
        if progress.stage != "compile":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        calibrate(dataset, progress=interrupt, explored=explored)


def test_a_start_that_cannot_be_simulated_is_explained(dataset, fails_below) -> None:
    fails_below(1.1)
    says = r"with C_t = 1, C_r = 1: run 'rpm45': .* t = 0.5 s failed: .* line search"
    with pytest.raises(SolverError, match=says):
        calibrate(dataset)


def test_steps_to_where_the_simulation_fails_are_rejected(dataset, fails_below) -> None:
    fails_below(0.3)
    fit = calibrate(dataset, compare=False, explored=False, tolerance=1e-6)
    assert fit.status == "converged"
    assert fit.values == pytest.approx(TRUTH, rel=1e-5)
    assert not all(iteration.accepted for iteration in fit.history)


def test_a_start_for_something_else_is_refused(dataset) -> None:
    with pytest.raises(InputError, match="viscosity, which is not among"):
        calibrate(dataset, initial={"viscosity": 2.0})


def test_a_preview_stays_one_when_the_whole_is_known(dataset, simulator, short_previews) -> None:
    call = simulator.steps_per_call
    model = Model(dataset, simulator.parameters)
    free = simulator.parameters.free({"C_t": 4.0, "C_r": 0.4})
    preview, whole, again = model.preview(free), model.whole(free), model.preview(free)
    assert preview is not None
    assert whole is not None
    assert again is not None
    assert [len(one.time) for one in preview.model] == [call + 1, call + 1]
    assert [len(one.time) for one in whole.model] == [2 * call + 1, 2 * call + 1]
    assert again.model is preview.model


def test_an_interrupted_search_gives_the_best_of_its_previews(dataset) -> None:
    count = 0

    def interrupt(progress) -> None:
        nonlocal count
        count += progress.stage == "explore" and progress.latest is not None
        if count == 3:
            raise KeyboardInterrupt

    fit = calibrate(dataset, progress=interrupt)
    assert fit.status == "interrupted"
    assert len(fit.history) == 3
    assert fit.loss == min(iteration.loss for iteration in fit.history)
    assert fit.loss < fit.history[0].loss
    assert fit.runs[0].before is None


def test_what_is_stored_is_not_simulated_again(
    dataset, tmp_path, monkeypatch, short_previews
) -> None:
    first = calibrate(dataset, store=tmp_path)
    taken = []
    true_run = Simulator.run

    def run(self, free, rpm, n_steps, *args):
        taken.append(n_steps)
        return true_run(self, free, rpm, n_steps, *args)

    monkeypatch.setattr(Simulator, "run", run)
    again = calibrate(dataset, store=tmp_path)
    assert taken == [1]  # to compile
    assert again.values == first.values
    assert again.loss == first.loss
    assert again.previews == first.previews


def test_the_best_of_several_optima_is_found_whatever_the_start(dataset) -> None:
    for start in ({"C_t": 1.0, "C_r": 1.5}, {"C_t": 20.0, "C_r": 0.08}):
        fit = calibrate(noisy(dataset, 5), initial=start, compare=False)
        assert fit.status == "converged"
        for name, estimate in fit.estimates.items():
            assert abs(estimate.value - TRUTH[name]) < 4 * estimate.std
            assert estimate.std < 0.2 * estimate.value


@pytest.mark.slow
def test_another_zero_of_the_angle_is_a_likely_cause(dataset, simulator) -> None:
    """As of a film that begins after the motor, or of a body that was mounted askew."""
    turned = noisy(dataset, 5)
    runs = tuple(replace(run, values=run.values + np.array([0, 0, 0, 0.6])) for run in turned.runs)
    model = Model(replace(turned, runs=runs), simulator.parameters)
    best = minimise(model.preview, np.zeros(2))
    assert best is not None
    found = likely_causes(model, np.zeros(2), best)
    assert "with another zero of the head angle the fit would be much better" in found[0].sentence
    assert "nuisances = { angle_origin = {} }" in found[0].sentence
    assert "time_offset" in found[0].sentence
    freed = tuple(replace(run, free_angle=True) for run in runs)
    again = minimise(lambda free: model.preview(free, freed), np.zeros(2))
    assert again is not None
    assert model.values(again.free) == pytest.approx(TRUTH, rel=0.05)
    assert model.values(best.free)["C_r"] != pytest.approx(TRUTH["C_r"], rel=0.05)
    assert again.trial.residuals.origins == 2  # one for each run
