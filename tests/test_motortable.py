"""Logs of motor controllers: which rates they become, and what is said of those that do not fit."""

import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from derjax.core.errors import InputError, InputWarning
from derjax.integrate.motor import Motor as Rates
from derjax.runs.sweeps.file import load_sweep
from derjax.scenes.load import load_scene

LOG = "time, targetSpeed, leftSpeed, left, right\n" + "".join(
    f"{731250 + 100 * k}, 60, {20 * k}, {-30 * k * k}, {7 * k}\n" for k in range(11)
)
"""1 s of a log in milliseconds since the controller was switched on."""

KEYS = "columns = { time = 'time', rpm = 'leftSpeed' }\n"
COUNTS = "columns = { counts = 'left' }\ncounts_per_turn = 1200\n"
MS = "time_unit = 'ms'\ntime_offset = -731250\n"


@pytest.fixture
def scene(tmp_path: Path):
    """Writes a scene with a motor table; returns what is read."""

    def write(keys: str = "", log: str = LOG, end: float = 1.0, more: str = ""):
        (tmp_path / "log.csv").write_text(log)
        text = f"{more}\n[motor]\ntable = 'log.csv'\n{keys}[time]\nend = {end}\n"
        (tmp_path / "scene.toml").write_text(text)
        return load_scene(tmp_path / "scene.toml")

    return write


def test_units_offset_and_names_of_columns(scene):
    table = scene(KEYS + MS).motor_table
    np.testing.assert_allclose(table.time, np.arange(11) / 10, rtol=1e-15)
    np.testing.assert_array_equal(table.rpm, 20.0 * np.arange(11))
    minutes = scene("time_unit = 'min'\n", "time,rpm\n0,1\n1,1\n", 60).motor_table
    assert minutes.time == (0, 60)
    clock = scene("time_offset = -3600\n", "time;rpm\n1:00:00,0;1,5\n1:00:01,5;2,5\n").motor_table
    assert (clock.time, clock.rpm) == ((0, 1.5), (1.5, 2.5))


def test_one_motor_or_one_column_for_each(scene):
    two = "[robot]\nkind = 'two_flagella'"
    each = "columns = { time = 'time', rpm = ['leftSpeed', 'targetSpeed'] }\n"
    assert scene(each + MS, more=two).motor_table.rpm[2] == (40, 60)
    assert scene(KEYS + MS, more=two).motor_table.rpm[2] == 40
    with pytest.raises(InputError, match="2 columns are given, but motors there are 1"):
        scene(each + MS)


def test_counts_become_rates_that_keep_the_angle(scene):
    """At every sample the motor has turned by what the encoder has counted since the first."""
    table = scene(COUNTS + MS).motor_table
    motor = Rates(jnp.array(table.time), jnp.array(table.rpm)[:, None] * jnp.pi / 30)
    samples = jnp.arange(11) / 10
    turned = jax.vmap(motor.rotation, (None, 0))(jnp.zeros(()), samples)[:, 0]
    expected = 2 * np.pi * -30.0 * np.arange(11) ** 2 / 1200
    np.testing.assert_allclose(turned, expected, rtol=1e-12, atol=1e-12)
    halves = jax.vmap(motor.rotation)(samples[:-1], samples[:-1] + 0.05)[:, 0]
    np.testing.assert_allclose(halves, np.diff(expected) / 2, rtol=1e-9)


@pytest.mark.parametrize("start", [0.013, 0.1])
def test_a_log_that_starts_a_little_late_is_held(scene, start):
    table = scene("", f"time,rpm\n{start},30\n0.5,60\n0.95,60\n").motor_table
    motor = Rates(jnp.array(table.time), jnp.array(table.rpm)[:, None])
    np.testing.assert_allclose(motor.rate_at(jnp.array([0.0, 1.0]))[:, 0], [30, 60])


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        (KEYS, "did you mean [motor] time_unit = 'ms' and time_offset = -731250?"),
        (KEYS + "time_unit = 'ms'\n", "did you mean [motor] time_offset = -731250?"),
        (KEYS + "time_unit = 'us'\n", "time_unit = 'ms' and time_offset = -731250?"),
        (KEYS + "time_offset = -731250\ntime_unit = 'us'\n", "mean [motor] time_unit = 'ms'?"),
    ],
)
def test_advice_on_times_works_when_followed(scene, keys, expected):
    with pytest.raises(InputError) as caught:
        scene(keys)
    said = str(caught.value)
    assert expected in said
    advice = said.split("[motor] ")[-1].rstrip("?").split(" and ")
    kept = [k for k in keys.splitlines() if k.split(" =")[0] not in "".join(advice)]
    table = scene("\n".join([*kept, *advice]) + "\n").motor_table
    np.testing.assert_allclose(table.time, np.arange(11) / 10, atol=1e-12)


@pytest.mark.parametrize(
    ("keys", "log", "expected"),
    [
        ("", LOG, "[motor] columns = { time = 'time', rpm = 'targetSpeed' or 'leftSpeed' }"),
        ("", "t,encoder\n0,1\n1,2\n", "{ time = 't', counts = 'encoder' } and counts_per_turn"),
        ("columns = { counts = 'left' }\n", LOG, "counts_per_turn: must be given"),
        (KEYS + "counts_per_turn = 12\n", LOG, "counts_per_turn: is only for columns"),
        ("columns = { rpm = 'a', counts = 'b' }\n", LOG, "give either rpm or counts, not both"),
        (COUNTS, "time,left\n0,1\n", "covers 0 to 0 s"),
        (COUNTS, "time,left\n0,0\n0.5,1e7\n1,0\n", "line 3: rpm = 1e+06: beyond any motor"),
        ("", "time,rpm\n0,1\n0.5,\n1,1\n", "line 3, column 'rpm': has no number"),
        ("", "time,rpm\n0,1\n0.4,1\n0.3,1\n1,1\n", "line 4: times must increase"),
        ("", "time,rpm\n0,1\n0.8,1\n", "covers 0 to 0.8 s, but the run lasts from 0 to 1 s"),
        ("time_unit = 'h'\n", LOG, "'s', 'ms', 'us' or 'min'"),
    ],
)
def test_complaints(scene, tmp_path, keys, log, expected):
    with pytest.raises(InputError) as caught:
        scene(keys, log)
    assert str(caught.value).startswith(f"{tmp_path / 'scene.toml'}: [motor] ")
    assert expected in str(caught.value)


@pytest.mark.parametrize(
    "key",
    ["columns = { time = 't' }", "counts_per_turn = 2", "time_unit = 'ms'", "time_offset = 1"],
)
def test_keys_of_logs_need_a_table(tmp_path, key):
    (tmp_path / "scene.toml").write_text(f"[motor]\n{key}\n")
    with pytest.raises(InputError, match=f"{key.split()[0]}: is only for a table"):
        load_scene(tmp_path / "scene.toml")


def test_milliseconds_that_pass_for_seconds_are_told_of(scene):
    """A log from 0 on covers the run in either unit, but turns a thousand times too slowly."""
    with pytest.warns(InputWarning, match=r"lasts 2000 s, the run 1 s; .* time_unit = 'ms'"):
        scene("", "time,rpm\n0,0\n1000,60\n2000,60\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene("", "time,rpm\n0,0\n100,60\n")
        scene("time_unit = 'ms'\n", "time,rpm\n0,0\n1000,60\n2000,60\n")


def test_sweeps_read_logs_alike(scene, tmp_path):
    expected = scene(KEYS + MS).motor_table
    path = tmp_path / "sweep.toml"
    path.write_text("scene = 'scene.toml'\n[vary]\nC_t = [4.0]\n")
    assert load_sweep(path).file(0).motor_table == expected
