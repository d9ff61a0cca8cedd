"""Speeds over the rate of the motor as data: read in any form, fitted to steady states."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from derjax import InputError
from fitting import load_dataset
from fitting.joint.fit import calibrate_jointly
from fitting.tracks import Dataset

pytestmark = pytest.mark.optimised

SPEEDS = Path(__file__).parents[2] / "data" / "speeds"
TRUTH = {"C_t": (4.8, 0.01), "C_r": (0.36, 0.02)}
"""With how far off they may be, as the other code has another motor, and solves another matrix."""


@pytest.fixture(scope="module")
def speeds():
    return load_dataset(SPEEDS / "dataset.toml")


@pytest.fixture(scope="module")
def fit(speeds):
    return calibrate_jointly(speeds)[0]


@pytest.mark.slow
def test_speeds_of_another_code_give_its_parameters(speeds, fit) -> None:
    assert fit.status == "converged"
    for name, (truth, within) in TRUTH.items():
        assert fit.values[name] == pytest.approx(truth, rel=within)
    begun = time.process_time()
    calibrate_jointly(speeds)
    assert time.process_time() - begun < 5.0


@pytest.mark.slow
def test_tracks_cut_to_after_the_transient_give_the_same(speeds) -> None:
    """Tracks of the other code from 10 s on, times counted from there."""
    data = load_dataset(SPEEDS.parent / "reference" / "dataset.toml")
    runs = []
    for run in data.runs:
        late = run.time >= 10.0
        time, values = run.time[late] - 10.0, run.values[late]
        runs.append(replace(run, time=time, values=values, steady=True, free_origin=True))
    fit, _ = calibrate_jointly(Dataset(speeds.scene, tuple(runs)))
    for name, (truth, within) in TRUTH.items():
        assert fit.values[name] == pytest.approx(truth, rel=within)


@pytest.mark.slow
def test_the_decision_is_told(fit) -> None:
    assert fit.said == ("reference code: 3 rates, compared with steady states",)


@pytest.mark.slow
def test_sizes_without_sign_give_the_same(speeds, fit) -> None:
    (rates,) = speeds.rates
    sizes = replace(rates, speed=np.abs(rates.speed), head_rate=np.abs(rates.head_rate))
    other, _ = calibrate_jointly(replace(speeds, rates=(sizes,)))
    assert other.values == pytest.approx(fit.values, rel=1e-6)
    assert "v and head_rate have the opposite sign" in other.said[-1]


@pytest.mark.slow
def test_speeds_alone_do_not_determine_the_rotation(speeds) -> None:
    (rates,) = speeds.rates
    alone = replace(rates, head_rate=np.full(3, np.nan))
    fit, _ = calibrate_jointly(replace(speeds, rates=(alone,)))
    estimate = fit.estimates["C_t"]
    assert abs(estimate.value - 4.8) < 0.05 * 4.8
    assert not fit.estimates["C_r"].std < 0.5 * fit.values["C_r"]
    assert any("C_r is not determined" in warning for warning in fit.warnings)


@pytest.mark.slow
def test_a_viscosity_that_is_not_known_widens_the_errors(speeds) -> None:
    (rates,) = speeds.rates
    rates = replace(
        rates,
        speed_std=0.003 * np.abs(rates.speed),
        head_rate_std=0.003 * np.abs(rates.head_rate),
    )
    fit, _ = calibrate_jointly(replace(speeds, rates=(rates,)))
    std = 0.02
    fields = {"viscosity": {"std": std}}
    unsure = replace(rates, nuisances=type(rates.nuisances).model_validate(fields))
    other, _ = calibrate_jointly(replace(speeds, rates=(unsure,)))
    assert other.estimates["C_t"].value == pytest.approx(fit.values["C_t"], rel=0.02)
    assert other.estimates["C_t"].std > 1.1 * fit.estimates["C_t"].std
    assert other.nuisances["reference code: viscosity"].std <= 1.3 * std


def written(directory: Path, table: str, **files: str) -> Path:
    (directory / "scene.toml").write_text("")
    for name, text in files.items():
        (directory / f"{name}.csv").write_text(text)
    path = directory / "dataset.toml"
    path.write_text(f'scene = "scene.toml"\n[[rates]]\n{table}\n')
    return path


FORMS = {
    "inline": ("motor_rpm = [30, 60]\nv = [0.2, 0.4]\nv_std = 0.01\nlength_unit = 'mm'", {}),
    "names of keys": (
        "file = 'a.csv'\nlength_unit = 'mm'",
        {"a": "motor_rpm,v,v_std\n30,0.2,0.01\n60,0.4,0.01\n"},
    ),
    "decimal commas": (
        "file = 'a.csv'\ncolumns = { motor_rpm = 'Motor', v = 'Speed' }\n"
        "v_std = 0.01\nlength_unit = 'mm'",
        {"a": "Motor;Speed\n30;0,2\n60;0,4\n"},
    ),
    "per minute": (
        "motor_rpm = [30, 60]\nv = [1.2, 2.4]\nv_std = [0.06, 0.06]\n"
        "length_unit = 'cm'\ntime_unit = 'min'",
        {},
    ),
}


@pytest.mark.parametrize("name", FORMS)
def test_all_forms_give_the_same_numbers(name, tmp_path) -> None:
    table, files = FORMS[name]
    (rates,) = load_dataset(written(tmp_path, table, **files)).rates
    assert rates.motor_rpm == pytest.approx([30, 60])
    assert rates.speed == pytest.approx([2e-4, 4e-4])
    assert rates.speed_std == pytest.approx([1e-5, 1e-5])
    assert np.isnan(rates.head_rate).all()


WRONG = {
    "nothing": ("", "give motor_rpm, and v or head_rate or both; or a file"),
    "no speed": ("motor_rpm = [30]", "besides motor_rpm give v or head_rate or both"),
    "counts": ("motor_rpm = [30, 60]\nv = [1e-4]", "v: has 1 numbers, but motor_rpm has 2"),
    "both": ("file = 'a.csv'\nv = [1e-4]", "v: is in the file already"),
    "no file": ("file = 'b.csv'", "b.csv: no such file"),
    "column": ("file = 'a.csv'", "no column 'motor_rpm' (the columns are 'rate', 'v')"),
    "unit": ("motor_rpm = [30]\nv = [0.2]", "are the units right?"),
    "degrees": ("motor_rpm = [30]\nhead_rate = [5.0]", "is angle_unit right?"),
    "rest": ("motor_rpm = [0]\nv = [1e-4]", "motor_rpm: must not be 0"),
    "drift": (
        "motor_rpm = [30]\nv = [1e-4]\nnuisances = { drift = {} }",
        "nuisances.drift: speeds do not depend on it",
    ),
    "std": (
        "motor_rpm = [30]\nv = [1e-4]\nhead_rate_std = 1.0",
        "is only for rates with head_rate",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_bad_input_is_named(name, tmp_path) -> None:
    table, words = WRONG[name]
    path = written(tmp_path, table, a="rate,v\n30,1e-4\n")
    with pytest.raises(InputError) as raised:
        load_dataset(path)
    assert words in str(raised.value)


def test_a_dataset_needs_something(tmp_path) -> None:
    (tmp_path / "scene.toml").write_text("")
    path = tmp_path / "dataset.toml"
    path.write_text('scene = "scene.toml"\n')
    with pytest.raises(InputError, match=r"give \[\[runs\]\] or \[\[rates\]\]"):
        load_dataset(path)
