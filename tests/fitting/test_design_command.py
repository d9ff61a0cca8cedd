"""The command `derjax design`, from its file to its figures."""

import json
import os
import signal
import threading

import numpy as np
import pandas as pd
import pytest

import derjax as dj
from derjax.commands.main import main
from fitting.design.file import load_design

SCENE = """
[robot]
edge_length = 0.02
pitch = 31.8e-3
[fluid]
hydrodynamics = "rft"
[motor]
rpm = 80
"""
DESIGN = """
scene = "scene.toml"
[vary]
pitch = { low = 0.02, high = 0.06 }
helix_radius = { low = 4e-3, high = 9e-3 }
[objective]
maximise = "speed"
[constraints]
torque = { max = 1.2e-4 }
[search]
starts = 2
[output]
landscape = 4
"""
FIT = {
    "parameters": {"C_t": {"value": 4.5, "std": 0.3}, "C_r": {"value": 0.35, "std": 0.01}},
    "correlation": {"names": ["C_t", "C_r"], "matrix": [[1.0, 0.2], [0.2, 1.0]]},
}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "design.toml").write_text(DESIGN)
    (tmp_path / "fit.json").write_text(json.dumps(FIT))
    return tmp_path


def command(folder, *more, file="design.toml"):
    return main(["design", str(folder / file), "-o", str(folder / "out"), *more])


@pytest.mark.slow
def test_from_the_file_to_the_figures_and_back(folder, capsys):
    assert command(folder) == 0
    said = capsys.readouterr()
    assert "start 2 of 2: converged" in said.out
    assert "limits that bind: torque <= 0.00012" in said.out
    out = folder / "out"
    names = "design.json best.toml landscape.csv landscape.png shapes.png tolerances.png best.gif"
    assert {path.name for path in out.iterdir()} == set(names.split())
    report = json.loads((out / "design.json").read_text())
    best = report["objective"]["value"]
    assert best > report["objective"]["start"]
    # Edges as long as a fifth of a turn are too long, and that is told.
    assert abs(report["objective"]["value_on_a_finer_mesh"] / best - 1) > 0.02
    assert "the mesh is coarse" in said.err
    assert report["constraints"][0]["value"] == pytest.approx(1.2e-4, rel=1e-4)
    # The best design is a scene file like any other.
    state = dj.steady(dj.build(dj.load_scene(out / "best.toml")))
    assert abs(float(state.speed)) == pytest.approx(best, rel=1e-7)
    around = pd.read_csv(out / "landscape.csv")
    assert len(around) == 16
    assert around.loc[around.margin >= 0, "objective"].max() <= best
    # Nothing of it is replaced unless that is asked for.
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert command(folder) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


@pytest.mark.slow
def test_a_search_that_is_interrupted_goes_on(folder, capsys):
    """Ctrl-C after some designs; those are not looked at again."""
    (folder / "scene.toml").write_text(SCENE)
    problem = load_design(folder / "design.toml")
    assert problem.search.starts == 2
    ledger = folder / "out" / "evaluations.jsonl"

    def interrupt():
        while not (ledger.exists() and ledger.read_text().count("\n") > 3):
            if done.wait(0.01):
                return
        os.kill(os.getpid(), signal.SIGINT)

    done = threading.Event()
    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        code = command(folder, "--no-figures")
    finally:  # or a test that fails would never end
        done.set()
        thread.join()
    said = capsys.readouterr()
    assert code == 130
    assert "--resume" in said.err
    known = ledger.read_text().splitlines()[1:]
    assert (folder / "out" / "design.json").exists()
    ledger.write_text(ledger.read_text() + '{"x": [0.1, ')  # as if the power had failed
    assert command(folder, "--no-figures", "--resume") == 0
    assert not ledger.exists()
    report = json.loads((folder / "out" / "design.json").read_text())
    assert report["status"] == "converged"
    assert report["evaluations"] > len(known)
    assert command(folder, "--resume") == 2
    assert "no unfinished search" in capsys.readouterr().err


def test_only_the_same_search_is_resumed(folder, capsys):
    (folder / "out").mkdir()
    (folder / "out" / "evaluations.jsonl").write_text('{"version": "0.0"}\n')
    assert command(folder, "--resume") == 2
    assert "of another problem" in capsys.readouterr().err
    assert command(folder) == 2
    assert "--resume goes on" in capsys.readouterr().err


def test_what_a_fit_has_found_is_uncertain(folder):
    text = (
        DESIGN + '[uncertain]\nfit = "fit.json"\nquantile = 0.1\nstd = { youngs_modulus = 1e5 }\n'
    )
    (folder / "design.toml").write_text(text)
    problem = load_design(folder / "design.toml").problem
    assert problem.uncertain is not None
    assert problem.uncertain.names == ("C_t", "C_r", "youngs_modulus")
    np.testing.assert_allclose(problem.uncertain.mean, [4.5, 0.35, 1.255e6])
    np.testing.assert_allclose(
        problem.uncertain.covariance[:2, :2], [[0.09, 0.0006], [0.0006, 0.0001]]
    )
    assert problem.scene.number("C_t") == 4.5
    assert problem.uncertain.quantile == 0.1


def test_a_programme_of_the_motor_is_made_in_the_file(folder):
    text = DESIGN.replace("pitch = {", "rpm = { entries = 5,").replace('"speed"', '"distance"')
    text = text.replace("helix_radius = { low = 4e-3, high = 9e-3 }\n", "")
    text = text.replace("low = 0.02, high = 0.06", "low = 0, high = 100")
    text = text.replace("torque = { max", "energy = { max")
    (folder / "design.toml").write_text(text)
    problem = load_design(folder / "design.toml").problem
    assert problem.through == "run"
    assert problem.variables.labels == [f"rpm[{k}]" for k in range(5)]
    np.testing.assert_allclose(problem.variables.start["rpm"], 80.0)


OWN = """
import jax.numpy as jnp

def slip(state):
    return jnp.abs(state.speed) / state.head_rate

def broken(state):
    return state.no_such_thing
"""


@pytest.mark.slow
def test_a_function_of_ones_own(folder):
    (folder / "own.py").write_text(OWN)
    (folder / "design.toml").write_text(DESIGN.replace('"speed"', '"own.py:slip"'))
    problem = load_design(folder / "design.toml").problem
    assert problem.objective.name == "own.py:slip"
    evaluation = problem.evaluator()({"pitch": 0.0318, "helix_radius": 6.4e-3})
    state = dj.steady(problem.scene)
    slip = abs(float(state.speed)) / float(state.head_rate)
    assert evaluation.values["own.py:slip"] == pytest.approx(slip)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[vary]", "[varry]", "varry"),
        ('"speed"', '"sped"', "did you mean 'speed'"),
        ('"speed"', '"own.py:slope"', "has no function 'slope'"),
        ('"speed"', '"other.py:slip"', "no such file"),
        ('"speed"', '"own.py:broken"', "AttributeError"),
        ('maximise = "speed"', "", "one of maximise and minimise"),
        ("low = 0.02,", "low = 0.04,", "the scene has 0.0318"),
        ("low = 0.02,", "low = '2 cm',", "pitch"),
        ("pitch = {", "pich = {", "no parameter 'pich'"),
        ("pitch = {", "pitch = { entries = 5,", "entries is for rpm"),
        ("max = 1.2e-4", "min = 2e-4, max = 1.2e-4", "contradict each other"),
        ("{ max = 1.2e-4 }", "{}", "give min, max or both"),
        ("[constraints]\ntorque", "[constraints]\nclearance", "two flagella or more"),
        ("scene.toml", "scenes.toml", "no such file"),
        ("starts = 2", "starts = 0", "starts"),
        ("starts = 2", "method = 'newton'", "method"),
        ("[search]", '[uncertain]\nfit = "fits.json"\n[search]', "no such file"),
        ("[search]", '[uncertain]\nfit = "scene.toml"\n[search]', "is no fit.json"),
        ("[search]", "[uncertain]\nstd = { C_x = 1.0 }\n[search]", "no such parameter"),
        ("[search]", "[uncertain]\nstd = { pitch = 1e-3 }\n[search]", "uncertain as well"),
        ("[constraints]", "at = { torque = -1.0 }\n[constraints]", "at"),
        ("[constraints]", "direction = [0, 0, 0]\n[constraints]", "has no direction"),
    ],
)
def test_what_is_wrong_is_told_with_file_and_key(folder, capsys, old, new, message):
    (folder / "own.py").write_text(OWN)
    assert old in DESIGN
    (folder / "design.toml").write_text(DESIGN.replace(old, new))
    assert command(folder) == 2
    said = capsys.readouterr().err
    assert message in said
    assert "Traceback" not in said
    assert not (folder / "out").exists()
