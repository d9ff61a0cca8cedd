"""What a fit leaves behind: files, figures and tables."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from derjax.io.output import output_directory
from fitting.calibrate import calibrate
from fitting.report import as_dict, figure, table, write


@pytest.fixture(scope="module")
def fit(dataset):
    rng = np.random.default_rng(5)
    runs = [
        replace(run, values=run.values + 1e-5 * rng.normal(size=run.values.shape))
        for run in dataset.runs
    ]
    return calibrate(replace(dataset, runs=tuple(runs), path=Path("tiny.toml")))


def test_json_says_what_was_found(fit, tmp_path) -> None:
    with output_directory(tmp_path) as output:
        json_path, figure_path = write(fit, output)
    content = json.loads(json_path.read_text())
    assert content["status"] == "converged"
    for name, estimate in fit.estimates.items():
        said = content["parameters"][name]
        assert said["value"] == estimate.value
        assert said["std"] == estimate.std
        assert said["ci95"] == list(estimate.ci95)
        assert said["start"] == 1.0
        assert said["unit"] == "1"
        assert said["widened"] == estimate.widened
    assert np.array(content["correlation"]["matrix"]) == pytest.approx(fit.correlation)
    assert [run["rms_position"] for run in content["runs"]] == [
        pytest.approx(one.rms["position"]) for one in fit.runs
    ]
    assert content["iterations"] == fit.iterations
    assert content["previews"] == fit.previews > 0
    assert content["goodness"]["good"] is True
    assert content["goodness"]["chi2"] is None  # the noise was not given
    assert content["goodness"]["error_bars_inflated_by"] == 1.0
    assert content["goodness"]["rms_over_robot_length"] == fit.goodness.relative_rms
    assert content["likely_causes"] == content["other_optima"] == content["warnings"] == []
    assert [run["drift_m_per_s"] for run in content["runs"]] == [{}, {}]
    assert [run["frames_left_out"] for run in content["runs"]] == [0, 0]
    assert content["loss_history"][-1] == fit.loss
    assert content["dataset"] == "tiny.toml"
    assert content["wall_time_s"] > 0
    assert figure_path.read_bytes().startswith(b"\x89PNG")
    assert {path.name for path in tmp_path.iterdir()} == {"fit.json", "fit.png"}


def test_what_is_not_finite_is_null(fit) -> None:
    endless = replace(fit.estimates["C_t"], std=np.inf, ci95=(0.0, np.inf))
    unsure = replace(fit, estimates={**fit.estimates, "C_t": endless})
    said = as_dict(unsure)["parameters"]["C_t"]
    assert said["std"] is None
    assert said["ci95"] == [0.0, None]
    json.dumps(as_dict(unsure), allow_nan=False)
    assert "not determined" in table(unsure)


def test_the_table_shows_as_many_digits_as_are_known(fit) -> None:
    estimate = replace(fit.estimates["C_t"], value=4.81234, std=0.0123, ci95=(4.78823, 4.83645))
    text = table(replace(fit, estimates={"C_t": estimate}))
    assert text == "C_t = 4.812 +- 0.012 (95 %: 4.788 to 4.836)"


def test_the_figure_shows_track_before_and_after(fit) -> None:
    axes = np.array(figure(fit).axes).reshape(3, 2)
    one = fit.runs[1]
    before, after, track = axes[0, 1].get_lines()
    assert np.allclose(track.get_ydata(), 1e3 * (one.run.values[:, 0] - one.after.observed[0, 0]))
    shown = after.get_ydata()
    assert np.allclose(np.interp(one.run.time, after.get_xdata(), shown), track.get_ydata(), atol=1)
    assert np.abs(before.get_ydata()[-1] - shown[-1]) > 0.01
    residuals = axes[2, 1].get_lines()[1:]
    assert np.allclose(residuals[3].get_ydata(), 10 * one.residuals[:, 3])


@pytest.mark.parametrize("channels", [(3,), (1,), (0, 3)])
def test_figures_of_partial_tracks(fit, channels) -> None:
    runs = [
        replace(
            one,
            run=replace(
                one.run, channels=channels, values=one.run.values[:, channels], free_origin=True
            ),
            residuals=one.residuals[:, channels],
            before=None,
        )
        for one in fit.runs
    ]
    partial = figure(replace(fit, runs=tuple(runs)))
    angle, place = 3 in channels, any(c != 3 for c in channels)
    assert len(partial.axes) == 2 * (1 + angle + place)


def test_a_track_lies_on_a_simulation_that_was_stopped_early(fit) -> None:
    """Displacements are shown from where the simulation is, as far as it goes."""
    one = fit.runs[1]
    steps = slice(0, len(one.after.time) // 3)
    short = replace(one.after, time=one.after.time[steps], observed=one.after.observed[steps])
    moved = replace(one.run, values=one.run.values + np.array([0.3, 0, 0, 0]), free_origin=True)
    early = replace(one, run=moved, after=short, before=None)
    axes = figure(replace(fit, runs=(early,))).axes
    after, track = axes[0].get_lines()
    shown = track.get_xdata() <= short.time[-1]
    there = np.interp(track.get_xdata()[shown], after.get_xdata(), after.get_ydata())
    assert np.allclose(track.get_ydata()[shown], there, rtol=0, atol=0.05)
    whole = np.ptp(1e3 * one.run.values[:, 0])
    assert np.ptp(track.get_ydata()) == pytest.approx(whole)
    assert whole > 0.3
