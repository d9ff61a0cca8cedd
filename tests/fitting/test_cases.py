"""Calibrations as people do them, from files: what is not known, or said wrongly, is named."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.calibration import NOISE, TRUTH, track
from derjax import load_scene
from derjax.commands.main import main
from fitting.observe import interpolation

pytestmark = [pytest.mark.slow, pytest.mark.optimised]

SCENE = """
[robot]
edge_length = 0.02
[fluid]
hydrodynamics = "rft"
[time]
step = 0.05
end = 60.0
"""
START = ["--start", "C_t=3", "C_r=0.6"]
TIMES = 0.5 * np.arange(1, 31)
"""s, of frames."""

MOTOR = """
scene = "scene.toml"

[[runs]]
track = "track.csv"
motor_rpm = 60.0
"""


@pytest.fixture(scope="module")
def seen(tmp_path_factory) -> np.ndarray:
    """(f, 4) mm and rad: what a camera sees of the robot of `SCENE`, with its noise."""
    path = tmp_path_factory.mktemp("scene") / "scene.toml"
    path.write_text(SCENE)
    scene = load_scene(path)
    perfect = interpolation(TIMES, scene.step)(track(scene, TIMES[-1] + scene.step))
    noise = NOISE * np.random.default_rng(2).normal(size=perfect.shape)
    return (perfect + noise) * [1e3, 1e3, 1e3, 1.0]


def fitted(directory: Path, table: str, keys: str) -> dict:
    """fit.json of a track and the keys that say how to read it."""
    (directory / "scene.toml").write_text(SCENE)
    (directory / "track.csv").write_text(table)
    (directory / "dataset.toml").write_text(MOTOR + keys)
    out = directory / "out"
    main(["fit", str(directory / "dataset.toml"), "-o", str(out), *START, "--quiet"])
    return json.loads((out / "fit.json").read_text())


def table_of(columns: dict[str, np.ndarray], digits: str = "%.6g") -> str:
    """A table as text, separated by commas."""
    rows = [",".join(columns)]
    for row in zip(*columns.values(), strict=True):
        rows.append(",".join(digits % cell for cell in row))
    return "\n".join(rows) + "\n"


def assert_found(content: dict, *names: str) -> None:
    """These parameters are the true ones, by the errors that are claimed, which are small."""
    assert content["status"] == "converged"
    for name in names:
        found = content["parameters"][name]
        assert abs(found["value"] - TRUTH[name]) <= 3.0 * found["std"]
        assert found["std"] < 0.1 * TRUTH[name]


def test_an_angle_alone_gives_the_spin_and_says_what_it_does_not(seen, tmp_path) -> None:
    keys = 'columns = { t = "t", head_angle = "th" }\n'
    content = fitted(tmp_path, table_of({"t": TIMES, "th": seen[:, 3]}), keys)
    assert_found(content, "C_r")
    assert content["goodness"]["good"]
    assert content["parameters"]["C_t"]["std"] is None
    assert content["parameters"]["C_t"]["value"] == pytest.approx(3.0)
    (warning,) = [w for w in content["warnings"] if w.startswith("C_t")]
    assert "C_t hardly matters for these tracks: it was held at its start, 3" in warning


def test_a_fit_that_runs_away_says_so(seen, tmp_path) -> None:
    """With the angle reversed no head turns slowly enough."""
    channels = dict(zip(("x", "y", "z", "th"), (seen * [1, 1, 1, -1]).T, strict=True))
    keys = ALL.replace("sigma = 0.1\nsigma_angle = 0.02\n", "")
    content = fitted(tmp_path, table_of({"t": TIMES, **channels}), keys)
    assert content["status"] == "diverged"
    assert content["whole_simulations"] == 0
    assert content["previews"] <= 25
    assert content["parameters"]["C_r"]["std"] is None
    first = content["warnings"][0]
    assert "The loss keeps falling as C_r grows without end: at " in first
    assert "it began at 0.6" in first
    assert "a minus before the name of a column" in first
    assert "head_angle reversed" in content["likely_causes"][0]["sentence"]
    said = " ".join(content["warnings"])
    assert "not identifiable" not in said
    assert "not determined" not in said


DRIFT = np.array([0.1, 0.06, 0.0])
"""mm/s."""

ALL = """
columns = { t = "t", x = "x", y = "y", z = "z", head_angle = "th" }
length_unit = "mm"
origin = "track"
sigma = 0.1
sigma_angle = 0.02
"""


def test_noise_that_is_given_too_large_is_one_sentence(seen, tmp_path, monkeypatch) -> None:
    monkeypatch.delattr("fitting.causes._tried")
    large = ALL.replace("= 0.1", "= 1.0").replace("= 0.02", "= 0.2")
    channels = dict(zip(("x", "y", "z", "th"), seen.T, strict=True))
    content = fitted(tmp_path, table_of({"t": TIMES, **channels}), large)
    assert_found(content, "C_r")
    assert content["goodness"]["good"]
    said = [w for w in content["warnings"] if "times larger than the residuals" in w]
    assert len(said) == 1
    assert "about 10 times" in said[0]
    assert not any("do not rely on them" in w for w in content["warnings"])


@pytest.fixture(scope="module")
def drifting(seen) -> str:
    """The table of a robot in a tank that flows."""
    moved = seen[:, :3] + TIMES[:, None] * DRIFT
    return table_of({"t": TIMES, **dict(zip("xyz", moved.T, strict=True)), "th": seen[:, 3]})


def test_a_drift_is_noticed_and_named(drifting, tmp_path) -> None:
    content = fitted(tmp_path, drifting, ALL)
    assert not content["goodness"]["good"]
    said = " ".join(content["warnings"])
    assert "does not describe these tracks" in said
    assert "chi^2" in said
    assert "Likely cause: with a steady drift" in content["warnings"][1]
    assert "say drift = true in [[runs]]" in content["likely_causes"][0]["sentence"]
    assert "do not rely on them" in said


def test_a_drift_that_is_fitted_leaves_the_truth(drifting, tmp_path) -> None:
    content = fitted(tmp_path, drifting, ALL + "drift = true\n")
    assert content["goodness"]["good"]
    assert_found(content, "C_r")
    drift = content["runs"][0]["drift_m_per_s"]
    # 30 frames in 15 s with noise of 0.1 mm know a slope to 0.004 mm/s.
    assert drift["y"] == pytest.approx(1e-3 * DRIFT[1], abs=1.5e-5)
    assert drift["z"] == pytest.approx(1e-3 * DRIFT[2], abs=1.5e-5)
    # How fast it swims and how fast it is carried along only differ in the first turns.
    c_t = content["parameters"]["C_t"]
    assert c_t["std"] is None or abs(c_t["value"] - TRUTH["C_t"]) <= 3.0 * c_t["std"]


PIXEL = 0.08
"""mm."""


@pytest.fixture(scope="module")
def pixels(seen) -> str:
    """A table as ImageJ writes it: y downwards, frames counted from 1, first column unnamed."""
    x, y = 1500.0 + seen[:, 0] / PIXEL, 900.0 - seen[:, 1] / PIXEL
    count = np.arange(1, len(x) + 1)
    fixed = dict(zip(("Area", "Mean"), np.tile([[0.0], [15.0]], len(x)), strict=True))
    return table_of({" ": count, **fixed, "X": x, "Y": y, "Slice": count}, "%.8g")


IMAGEJ = """
columns = { t = "Slice", x = "X", y = "-Y" }
length_unit = "mm"
origin = "track"
fps = 2
first_frame = 0
"""


def test_pixels_that_are_taken_for_millimetres_are_named(pixels, tmp_path) -> None:
    content = fitted(tmp_path, pixels, IMAGEJ)
    assert not content["goodness"]["good"]
    assert any("pixel_size = " in cause["sentence"] for cause in content["likely_causes"])
    assert any("pixel_size = " in warning for warning in content["warnings"])


def test_pixels_with_their_size_give_the_truth(pixels, tmp_path) -> None:
    """Positions in a plane say how the robot is dragged, and these hardly how it spins."""
    content = fitted(tmp_path, pixels, IMAGEJ + f"pixel_size = {PIXEL}\n")
    assert content["goodness"]["good"]
    assert_found(content, "C_t")
    c_r = content["parameters"]["C_r"]
    if c_r["std"] is None:
        assert any(warning.startswith("C_r") for warning in content["warnings"])
    else:
        assert abs(c_r["value"] - TRUTH["C_r"]) <= 3.0 * c_r["std"]
