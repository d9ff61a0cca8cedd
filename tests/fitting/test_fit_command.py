"""What a fit leaves behind, and the command that does it all."""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from derjax import InputError
from fitting import cli
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
    json_path, figure_path = write(fit, tmp_path)
    content = json.loads(json_path.read_text())
    assert content["status"] == "converged"
    for name, estimate in fit.estimates.items():
        said = content["parameters"][name]
        assert said["value"] == estimate.value
        assert said["std"] == estimate.std
        assert said["ci95"] == list(estimate.ci95)
        assert said["start"] == 1.0
    assert np.array(content["correlation"]["matrix"]) == pytest.approx(fit.correlation)
    assert [run["rms_position"] for run in content["runs"]] == [
        pytest.approx(one.rms["position"]) for one in fit.runs
    ]
    assert content["iterations"] == fit.iterations
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


SCENE = """
[robot]
edge_length = 0.03
[head]
C_t = 1.0
C_r = 1.0
[time]
step = 0.05
end = 2.0
inertia = false
"""


@pytest.fixture
def files(dataset, tmp_path) -> Path:
    """The synthetic dataset as files."""
    (tmp_path / "scene.toml").write_text(SCENE)
    text = 'scene = "scene.toml"\n'
    for run in dataset.runs:
        content = np.c_[run.time, run.values]
        np.savetxt(
            tmp_path / f"{run.name}.csv", content, "%.12g", ",", header="t,x,y,z,a", comments=""
        )
        text += f'[[runs]]\ntrack = "{run.name}.csv"\nmotor_rpm = {run.motor_rpm}\n'
        text += 'columns = { t = "t", x = "x", y = "y", z = "z", head_angle = "a" }\n'
    (tmp_path / "dataset.toml").write_text(text)
    return tmp_path


def run_command(*words: str) -> int:
    parser = argparse.ArgumentParser()
    cli.configure(parser)
    return cli.run(parser.parse_args(list(words)))


def test_the_command_fits_writes_and_prints(files, capsys) -> None:
    words = [str(files / "dataset.toml"), "-o", str(files / "out"), "--start", "C_t=3", "C_r=0.5"]
    assert run_command(*words) == 0
    content = json.loads((files / "out" / "fit.json").read_text())
    assert content["parameters"]["C_t"]["value"] == pytest.approx(4.8, rel=2e-4)
    assert content["parameters"]["C_t"]["start"] == 3.0
    said = capsys.readouterr().out
    assert "fit  0: loss" in said
    assert "steps/s, about" in said
    assert "converged after" in said
    assert "C_t = 4." in said
    assert str(files / "out" / "fit.png") in said
    with pytest.raises(InputError, match="--overwrite"):
        run_command(*words)
    assert run_command(*words, "--overwrite", "--max-iterations", "1") == 2
    assert json.loads((files / "out" / "fit.json").read_text())["status"] == "max_iterations"


def test_an_interrupted_command_keeps_the_best(files, monkeypatch) -> None:
    calls = 0

    def interrupt(self, progress) -> None:
        nonlocal calls
        calls += progress.latest is not None
        if calls == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(cli._Printer, "__call__", interrupt)
    assert run_command(str(files / "dataset.toml"), "-o", str(files / "out")) == 130
    assert json.loads((files / "out" / "fit.json").read_text())["status"] == "interrupted"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--start", "C_t"], "--start C_t: should be NAME=VALUE"),
        (["--start", "C_t=much"], "NAME=VALUE"),
        (["--start", "C_t=-1"], "C_t = -1: must be positive"),
        (["--parameters", "C_x"], "no parameter 'C_x'"),
        (["--max-iterations", "0"], "at least 1"),
    ],
)
def test_wrong_arguments(files, words, says) -> None:
    with pytest.raises(InputError, match=says):
        run_command(str(files / "dataset.toml"), "-o", str(files / "out"), *words)
    assert not (files / "out" / "fit.json").exists()


def test_the_output_must_not_be_a_file(files) -> None:
    (files / "out").write_text("")
    with pytest.raises(InputError, match="not a directory"):
        run_command(str(files / "dataset.toml"), "-o", str(files / "out"))
