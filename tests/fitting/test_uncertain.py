"""Profiles, posteriors, plans and reports of fits that use gaits."""

import argparse
import csv
import re
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from conftest import TIMES as SHORT
from conftest import synthetic_run

from derjax import InputError
from derjax.io.output import output_directory
from fitting.joint.fit import calibrate_jointly
from fitting.joint.posterior import posterior
from fitting.joint.profile import profiles
from fitting.joint.rates import Rates
from fitting.joint.sources import source
from fitting.netcdf import write_netcdf
from fitting.page import page
from fitting.plan.cli import configure, words
from fitting.plan.information import plan
from fitting.tracks import Dataset

TRUTH = {"C_t": 4.8, "C_r": 0.36}
RPM = np.array([30.0, 45.0, 65.0])


def rates(scene, noise: float, seed: int = 0) -> Rates:
    """Speeds with relative noise."""
    gaits = [source(scene, rpm, tuple(TRUTH))(np.array([4.8, 0.36])).gait for rpm in RPM]
    exact = np.array([[gait[0], gait[2]] for gait in gaits])
    off = 1 + noise * np.random.default_rng(seed).normal(size=exact.shape)
    speed, head_rate = (exact * off).T
    return Rates(
        "speeds",
        RPM,
        speed,
        noise * np.abs(exact[:, 0]),
        head_rate,
        noise * np.abs(exact[:, 1]),
        scene,
    )


@pytest.fixture(scope="module")
def linear(scene):
    """Speeds known to 0.3 %."""
    return calibrate_jointly(Dataset(scene, (), rates=(rates(scene, 0.003),)))


@pytest.fixture(scope="module")
def drawn(linear):
    return posterior(linear[1], draws=600, chains=2)


def test_profile_and_covariance_agree_where_the_model_is_linear(linear) -> None:
    fit, solved = linear
    for one in profiles(solved):
        e = fit.estimates[one.name]
        assert one.ci95 == pytest.approx(e.ci95, abs=0.1 * e.std)
        assert one.rise.min() == 0.0


@pytest.mark.slow
def test_posterior_and_covariance_agree_where_the_model_is_linear(linear, drawn) -> None:
    fit, _ = linear
    assert drawn.ok
    for name, std in drawn.std().items():
        e = fit.estimates[name]
        assert std == pytest.approx(e.std, rel=0.15)
        assert drawn.mean()[name] == pytest.approx(e.value, abs=0.15 * e.std)


@pytest.mark.slow
def test_a_profile_of_the_only_parameter(scene) -> None:
    """Nothing that costs a simulation is left to search."""
    known = scene.model_copy(update={"head": scene.head.model_copy(update={"C_r": 0.36})})
    fit, solved = calibrate_jointly(Dataset(known, (), rates=(rates(known, 0.003),)), ("C_t",))
    assert fit.goodness.good
    (one,) = profiles(solved)
    e = fit.estimates["C_t"]
    assert one.ci95 == pytest.approx(e.ci95, abs=0.1 * e.std)


def test_a_profile_is_no_parabola_where_the_model_is_not_linear(scene) -> None:
    """Speeds known to 30 %: the loss hardly rises to one side, and the interval is longer there."""
    _, solved = calibrate_jointly(Dataset(scene, (), rates=(rates(scene, 0.3, 3),)))
    (one,) = profiles(solved, ["C_r"])
    k = int(np.argmin(one.rise))
    low, high = np.log(one.values[k] / one.ci95[0]), np.log(one.ci95[1] / one.values[k])
    assert abs(high - low) > 0.15 * (high + low)


@pytest.fixture(scope="module")
def from_rest(simulator, scene):
    """A track from rest beside speeds."""
    run = synthetic_run(simulator, 45.0, SHORT, TRUTH, sigma=1e-5, sigma_angle=1e-3)
    data = Dataset(scene, (run,), rates=(rates(scene, 0.01),))
    return calibrate_jointly(data, initial=TRUTH)


@pytest.mark.slow
def test_a_posterior_of_tracks_from_rest_is_refused(from_rest) -> None:
    with pytest.raises(InputError, match="tracks from rest would have to be simulated"):
        posterior(from_rest[1])


@pytest.mark.slow
def test_a_profile_and_a_plan_from_a_track_from_rest(from_rest) -> None:
    fit, solved = from_rest
    (one,) = profiles(solved, ["C_r"])
    e = fit.estimates["C_r"]
    assert one.ci95 == pytest.approx(e.ci95, abs=0.15 * e.std)
    further = plan(solved, [45.0], [60.0], 2.0)
    assert further.now["C_r"] == pytest.approx(e.std / e.value, rel=0.05)
    assert further.best("C_t").std["C_t"] < further.now["C_t"]


def test_the_page_needs_nothing_else(linear, drawn) -> None:
    fit, solved = linear
    text = page(fit, solved.robot, profiles(solved, ["C_t"]), drawn)
    for heading in ("Parameters", "Data as read", "Profiles", "Posterior", "The robot"):
        assert f"<h2>{heading}</h2>" in text
    # What a browser would load from elsewhere; plotly.js names addresses that nothing here uses.
    body = re.sub(r"<script[^>]*>.*?</script>", "", text, flags=re.S)
    assert not re.search(r'(src|href)="(?!data:)', body)
    assert "<script src" not in text
    assert body.count("data:image/png;base64") == 3
    assert f"{fit.values['C_t']:.6g}" in text


def test_the_data_set_is_labelled(linear, tmp_path) -> None:
    fit, _ = linear
    with output_directory(tmp_path) as output:
        write_netcdf(fit, output)
    with xr.open_dataset(tmp_path / "fit.nc", engine="h5netcdf") as read:
        assert float(read.value.sel(parameter="C_r")) == fit.values["C_r"]
        assert read.correlation.sel(fitted_parameter="C_t").shape == (2,)
        assert read.measured_0.sel(what_0="speed").values == pytest.approx(fit.rates[0].data[:, 0])
        assert read.attrs["status"] == "converged"


def test_a_plan_tells_what_a_further_run_then_gives(linear, scene) -> None:
    """The errors that are announced are those of a fit to such a run."""
    fit, solved = linear
    found = plan(solved, [45.0], [60.0], 2.0)
    now = {name: e.std / e.value for name, e in fit.estimates.items()}
    assert found.now == pytest.approx(now, rel=0.01)
    best = next(one for one in found.candidates if one.channels == "x, y, z, angle")
    assert all(best.std[name] <= found.now[name] for name in TRUTH)
    from fitting.joint.gait import Gait, swum
    from fitting.tracks import Run

    gait = source(scene, 45.0, tuple(TRUTH))(np.array([4.8, 0.36])).gait
    time = np.arange(0.0, 61.0, 2.0)
    noise = np.array([1e-4, 1e-4, 1e-4, 0.02])
    values = np.asarray(swum(Gait.of(gait), time, 0.0, 1.0))
    values = values + noise * np.random.default_rng(1).normal(size=values.shape)
    run = Run("next", time, (0, 1, 2, 3), values, 45.0, sigma=1e-4, sigma_angle=0.02, steady=True)
    after, _ = calibrate_jointly(replace(fit.dataset, runs=(replace(run, free_origin=True),)))
    for name in TRUTH:
        told = after.estimates[name].std / after.values[name]
        assert told == pytest.approx(best.std[name], rel=0.1)
    assert "C_t: best known after 60 s at 45 rpm" in words(found)


def test_the_command_plans(tmp_path, capsys) -> None:
    from fitting.plan.cli import run

    (tmp_path / "scene.toml").write_text(
        "[robot]\nedge_length = 0.03\n[time]\nstep = 0.05\nend = 3.0\ninertia = false\n"
    )
    (tmp_path / "dataset.toml").write_text(
        'scene = "scene.toml"\n[[rates]]\nmotor_rpm = [45, 65]\nv = [0.13, 0.2]\n'
        'head_rate = [-0.41, -0.59]\nlength_unit = "mm"\nv_std = 0.002\nhead_rate_std = 0.004\n'
    )
    parser = argparse.ArgumentParser()
    configure(parser)
    words = [str(tmp_path / "dataset.toml"), "-o", str(tmp_path / "out")]
    args = parser.parse_args([*words, "--rates", "45", "--durations", "30", "60"])
    assert run(args) == 0
    rows = list(csv.DictReader((tmp_path / "out" / "plan.csv").open()))
    assert len(rows) == 10
    assert (tmp_path / "out" / "plan.png").read_bytes().startswith(b"\x89PNG")
    assert "best known after 60 s" in capsys.readouterr().out
    with pytest.raises(InputError, match="use --overwrite"):
        run(args)
    few = parser.parse_args([*words, "--overwrite", "--rates", "45", "--durations", "3"])
    with pytest.raises(InputError, match="fewer than 10 frames"):
        run(few)


def test_a_fit_that_was_stopped_goes_on_from_its_gaits(scene, tmp_path, monkeypatch) -> None:
    """Gaits that were found before are not solved for again, and the outcome is the same."""
    from fitting.joint.sources import SteadySource

    data = Dataset(scene, (), rates=(rates(scene, 0.01),))
    asked: list[float] = []
    solve = SteadySource.__call__

    def counted(self, values):
        asked.append(float(values[0]))
        return solve(self, values)

    monkeypatch.setattr(SteadySource, "__call__", counted)
    first, _ = calibrate_jointly(data, store=tmp_path)
    count = len(asked)
    assert count > 3
    again, solved = calibrate_jointly(data, store=tmp_path)
    assert len(asked) == count
    assert again.values == pytest.approx(first.values, rel=1e-9)
    assert solved.robot is None
