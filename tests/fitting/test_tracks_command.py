"""The command `derjax tracks`: what it shows, what it writes, what it refuses."""

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from derjax.commands.main import main
from derjax.commands.new import template
from derjax.io.locking import locked
from fitting.datasetfile import RunFile
from fitting.show.understood import outliers
from fitting.tracks import load_dataset

FORMATS = Path(__file__).parents[2] / "data" / "formats"
ALL = sorted(FORMATS.glob("*.[ctx]*"))
NEEDED = {"pixel_size": "0.05", "fps": "2.5", "track_id": '"head"', "length_unit": '"mm"'}


def filled(text: str) -> str:
    """A dataset file with what it marks as needed, a rate of the motor, and units."""
    for key, value in NEEDED.items():
        text = re.sub(rf"^# {key} = .*$", f"{key} = {value}", text, flags=re.MULTILINE)
    return re.sub(r"^# motor_rpm = .*$", "motor_rpm = 70", text, flags=re.MULTILINE)


def test_what_was_understood_of_all_formats_makes_a_dataset(tmp_path, capsys):
    """One dataset of all files, filled in, is the same track each time."""
    assert len(ALL) == 18
    assert main(["tracks", *map(str, ALL), "-o", str(tmp_path), "--no-figures"]) == 0
    out, err = capsys.readouterr()
    assert [line for line in out.splitlines() if line in map(str, ALL)] == list(map(str, ALL))
    assert len(re.findall(r"outliers +none", out)) == len(ALL)
    assert "to be said yet, in [[runs]]: fps, pixel_size, track_id" in err
    text = (tmp_path / "dataset.toml").read_text()
    (tmp_path / "scene.toml").write_text(template("scene.toml"))
    dataset = tmp_path / "dataset.toml"
    assert main(["fit", str(dataset), "-o", str(tmp_path / "fit"), "--quiet"]) == 2
    assert "fps says how many frames" in capsys.readouterr().err
    assert not (tmp_path / "fit").exists()
    # In files without a unit whose numbers are millimetres, pixel_size stays off.
    parts = re.split(r"(?m)^(?=\[\[runs\]\])", text)
    pixels = ("imagej.csv", "imagej_tabs", "manual", "_old.csv", "deeplab", "sleap", "trackpy")
    for k, part in enumerate(parts[1:], 1):
        seen = filled(part)
        if not any(name in part for name in pixels) or "kinovea" in part:
            seen = re.sub(r"(?m)^pixel_size.*\n", "", seen)
        parts[k] = seen
    dataset.write_text("".join(parts))
    runs = load_dataset(dataset).runs
    assert len(runs) == len(ALL)
    for run in runs:
        np.testing.assert_allclose(run.time, runs[0].time, atol=1e-9)
        np.testing.assert_allclose(
            run.values[:, :2] - run.values[0, :2],
            runs[0].values[:, :2] - runs[0].values[0, :2],
            atol=2e-7,
        )
        assert run.free_origin


def test_the_table_names_format_clock_columns_gaps_and_units(capsys):
    assert main(["tracks", str(FORMATS / "imagej.csv"), "--set", "fps=2.5"]) == 0
    out, err = capsys.readouterr()
    assert "imagej: Results (ImageJ, Fiji)" in out
    assert "column 'Slice', frames, 2.5 in a second" in out
    assert re.search(r"x +column 'X', 391\.19 to 683\.186, no unit: they look like pixels", out)
    assert "57 from 0 to 23.6 s, usually 0.4 s apart" in out
    assert "3 frames: 2 after 6.4 s, 1 after 12 s" in out
    assert "the largest is taken" in out
    assert "  ? the file has no unit" in out
    assert "pixel_size" in err


def test_a_dataset_file_is_shown_as_it_is_read(capsys):
    camera = FORMATS.parent / "camera" / "dataset.toml"
    assert main(["tracks", str(camera)]) == 0
    out, err = capsys.readouterr()
    assert out.count("outliers") == 3
    assert re.search(r"head_angle +column 'head_angle', .* rad \(1\.6 turns\)", out)
    assert not err


def test_pictures_and_existing_results(tmp_path, capsys):
    command = ["tracks", str(FORMATS / "motive.csv"), "-o", str(tmp_path), "--quiet"]
    assert main(command) == 0
    assert capsys.readouterr().out == ""
    assert (tmp_path / "motive.csv.png").stat().st_size > 10_000
    (tmp_path / "dataset.toml").write_text("mine")
    assert main(command) == 2
    assert "dataset.toml: exists already; use --overwrite" in capsys.readouterr().err
    assert (tmp_path / "dataset.toml").read_text() == "mine"
    assert main([*command, "--overwrite"]) == 0
    with locked(tmp_path):
        assert main([*command, "--overwrite"]) == 2


def test_what_cannot_be_read_leaves_nothing_behind(tmp_path, capsys):
    (tmp_path / "empty.csv").write_text("")
    files = [str(FORMATS / "motive.csv"), str(tmp_path / "empty.csv")]
    assert main(["tracks", *files, "-o", str(tmp_path / "out")]) == 2
    assert f"{tmp_path / 'empty.csv'}: the file is empty" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("fps", "should be KEY=VALUE"),
        ("fsp=3", "unknown key. Did you mean 'fps'"),
        ("fps=fast", "--set: "),
        ("track_id=5", "track_id = 5"),
    ],
)
def test_keys_that_are_wrong(word, said, capsys):
    assert main(["tracks", str(FORMATS / "trackmate.csv"), "--set", word]) == 2
    assert said in capsys.readouterr().err


def test_keys_that_are_set_are_written(tmp_path):
    words = ["track_id=0", "length_unit=mm", "axes={right='z', up='-x'}", "point=silhouette"]
    options = [option for word in words for option in ("--set", word)]
    file = str(FORMATS / "trackmate.csv")
    assert main(["tracks", file, "-o", str(tmp_path), "--no-figures", "--quiet", *options]) == 0
    (run,) = tomllib.loads((tmp_path / "dataset.toml").read_text())["runs"]
    assert run["axes"] == {"right": "z", "up": "-x"}
    assert run["point"] == "silhouette"
    assert run["track_id"] == 0
    RunFile.model_validate(run)


def test_outliers_are_far_from_their_neighbours(rng):
    time = np.arange(80)
    values = np.stack([-0.5 * time, np.sin(1.9 * time)], 1) + 0.02 * rng.normal(size=(80, 2))
    assert not outliers(time, values).any()
    values[33, 0] += 4.0
    values[0, 1] += 25.0
    assert np.argwhere(outliers(time, values)).tolist() == [[0, 1], [33, 0]]
    assert not outliers(time[:20], np.zeros((20, 1))).any()


def test_the_page_shows_what_is_printed(monkeypatch, capsys):
    root = FORMATS.parents[1]
    monkeypatch.chdir(root)
    assert main(["tracks", "data/formats/imagej.csv"]) == 0
    page = (root / "docs" / "from_film_to_parameters.md").read_text(encoding="utf-8")
    assert capsys.readouterr().out.strip() in page
