"""Tracks as trackers write them: units, axes, frames, objects and gaps."""

import re
import tomllib
import warnings
from pathlib import Path

import numpy as np
import pytest

from derjax import InputError
from derjax.commands.new import template
from derjax.core.errors import InputWarning
from fitting.datasetfile import Columns, DatasetFile, RunFile
from fitting.joint.file import NoiseFile, RatesFile, Shared
from fitting.tracks import load_dataset

FRAMES = 14
TIME = np.arange(FRAMES) / 2
X, Y = -10.0 - 0.4 * TIME, 0.3 * np.sin(TIME)
"""What the tracks below are of: s, and mm."""

PIXELS = " ,Area,X,Y,Slice\n" + "".join(
    f"{k + 1},0,{10 * X[k] + 900:.10g},{400 - 10 * Y[k]:.10g},{k + 1}\n" for k in range(FRAMES)
)
"""As ImageJ writes them: pixels of 0.1 mm, y downwards, frames from 1, a column without a name."""


@pytest.fixture
def read(tmp_path: Path):
    """The run of a dataset with one track."""

    def written(table: str | bytes, keys: str, scene: str = "", rpm: str = "motor_rpm = 60\n"):
        content = table.encode() if isinstance(table, str) else table
        (tmp_path / "track.csv").write_bytes(content)
        (tmp_path / "scene.toml").write_text(scene)
        origin = "" if "origin" in keys else 'origin = "track"\n'
        text = f'scene = "scene.toml"\n[[runs]]\ntrack = "track.csv"\n{rpm}{origin}{keys}\n'
        (tmp_path / "dataset.toml").write_text(text)
        return load_dataset(tmp_path / "dataset.toml").runs[0]

    return written


def assert_is_the_track(run) -> None:
    np.testing.assert_allclose(run.time, TIME, atol=1e-12)
    moved = run.values[:, :2] - run.values[0, :2]
    np.testing.assert_allclose(moved, 1e-3 * np.stack([X - X[0], Y - Y[0]], 1), atol=1e-12)


IMAGE = """
columns = { t = "Slice", x = "X", y = "-Y" }
length_unit = "mm"
pixel_size = 0.1
fps = 2
"""


def test_pixels_frames_and_an_axis_that_points_down(read):
    run = read(PIXELS, IMAGE + "sigma = 0.05")
    assert_is_the_track(run)
    assert run.sigma == pytest.approx(5e-5)  # in length_unit, not in pixels
    later = read(PIXELS, IMAGE + "first_frame = -1\n")
    np.testing.assert_allclose(later.time, TIME + 1)
    np.testing.assert_allclose(read(PIXELS, IMAGE + "time_offset = 3").time, TIME + 3)


def test_a_name_with_a_minus_is_a_name_first(read):
    table = "t,-y,y\n" + "".join(f"{TIME[k]},{2 * Y[k]},{Y[k]}\n" for k in range(FRAMES))
    keys = 'columns = { t = "t", y = "-y" }\nlength_unit = "mm"'
    np.testing.assert_allclose(read(table, keys).values[:, 0], 2e-3 * Y)
    with pytest.raises(InputError, match=r"no column '-z'; the columns are 't', '-y', 'y'"):
        read(table, keys.replace('"-y"', '"-z"'))


def test_frames_without_fps_are_told_of(read):
    """They are refused, unless a unit of time is named."""
    with pytest.raises(InputError, match=r"'Slice' seems to hold numbers of frames.* fps"):
        read(PIXELS, IMAGE.replace("fps = 2\n", ""))
    run = read(PIXELS, IMAGE.replace("fps = 2\n", 'time_unit = "s"\n'))
    np.testing.assert_allclose(run.time, np.arange(1, FRAMES + 1))
    times = PIXELS.replace("\n2,", "\n2,").replace(",3\n", ",2.5\n")
    with pytest.raises(InputError, match=r"does not hold numbers of frames but 2\.5; .* fps"):
        read(times, IMAGE)


def spots(order: np.ndarray | None = None, dust: bool = True) -> str:
    """A table of TrackMate with two objects, rows in any order."""
    header = (
        "LABEL,TRACK_ID,POSITION_X,POSITION_Y,POSITION_T\nLabel,Track ID,X,Y,T\n"
        "Label,Track ID,X,Y,T\n,,(mm),(mm),(sec)\n"
    )
    rows = [f"ID{k},4,{X[k]},{Y[k]},{TIME[k]}" for k in range(FRAMES)]
    rows += [f"ID{k},7,{5 * X[k]},1.0,{TIME[k]}" for k in range(FRAMES)]
    rows += [f"ID99,,1.0,1.0,{TIME[3]}"] * dust
    return header + "\n".join(rows[k] for k in (range(len(rows)) if order is None else order))


SPOTS = """
columns = { t = "POSITION_T", x = "POSITION_X", y = "POSITION_Y" }
length_unit = "mm"
"""


def test_one_object_of_several_in_any_order(read, rng):
    run = read(spots(rng.permutation(2 * FRAMES + 1)), SPOTS + "track_id = 4\n")
    assert_is_the_track(run)
    assert_is_the_track(read(spots(), SPOTS + 'track_id = ["4"]\ntrack_column = "Track ID"\n'))


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        (SPOTS, "column 'TRACK_ID' tells of several objects: 4, 7, nothing; choose with track_id"),
        (SPOTS + "track_id = 5\n", "track_id = 5.0: column 'TRACK_ID' has 4, 7, nothing"),
        (SPOTS + "track_id = [4, 7]\n", "the time of line 5 is repeated"),
        (SPOTS + 'track_column = "LABEL"\n', "track_column: is only for runs with track_id"),
        (SPOTS + "first_frame = 1\n", "first_frame: is only for runs with fps"),
        (SPOTS + "motor_rpm = [60, 50]\n", "motor_rpm has 2 rates, but the robot has 1 motors"),
    ],
)
def test_complaints(read, keys, expected):
    with pytest.raises(InputError) as caught:
        read(spots(), keys, rpm="" if "motor_rpm" in keys else "motor_rpm = 60\n")
    assert expected in str(caught.value)


def test_objects_without_a_column_that_tells_them_apart(read):
    twice = "t,x\n" + "".join(f"{k},1\n{k},2\n" for k in range(FRAMES))
    keys = 'columns = { t = "t", x = "x" }\nlength_unit = "mm"\n'
    with pytest.raises(InputError, match=r"line 3, column 't': .* line 2 is repeated; .*several"):
        read(twice, keys)
    with pytest.raises(InputError, match="set track_column to one of 't', 'x'"):
        read(twice, keys + "track_id = 1\n")


def test_frames_that_were_not_tracked_are_left_out_and_counted(read):
    rows = [f"{TIME[k]},{X[k]},{Y[k]}" for k in range(FRAMES)]
    rows[2] = f"{TIME[2]},null,NaN"
    rows[5] = f"{TIME[5]},{X[5]},"
    rows.insert(4, ",,")
    keys = 'columns = { t = "t", x = "x", y = "y" }\nlength_unit = "mm"\n'
    run = read("t,x,y\n" + "\n".join(rows), keys)
    assert run.dropped == 2
    np.testing.assert_allclose(run.time, np.delete(TIME, [2, 5]))
    assert np.isfinite(run.values).all()
    assert read("t,x,y\n" + "\n".join(rows), keys + "t_start = 1.5\n").dropped == 1


def test_times_of_a_clock(read):
    rows = [f"14:59:{55 + s:02.0f}" if s < 5 else f"15:00:{s - 5:04.1f}" for s in 2 * TIME]
    table = "t;x;y\n" + "".join(
        f"{clock};{x};{y}\n".replace(".", ",") for clock, x, y in zip(rows, X, Y, strict=True)
    )
    keys = 'columns = { t = "t", x = "x", y = "y" }\nlength_unit = "mm"\ntime_offset = -53995\n'
    np.testing.assert_allclose(read(table, keys).time, 2 * TIME)
    np.testing.assert_allclose(read(table, keys + "t_start = 53997\n").time, 2 * TIME[2:])


PLAIN = "t,x\n" + "".join(f"{TIME[k] - 1},{X[k]}\n" for k in range(FRAMES))
KEYS = 'columns = { t = "t", x = "x" }\nlength_unit = "mm"\n'


def test_a_start_at_zero_counts_and_the_advice_works(read):
    """Frames of before the motor has started are refused, or left out by a start of 0."""
    with pytest.raises(InputError, match=r"1 s before the motor starts; .* t_start = 0,"):
        read(PLAIN, KEYS)
    np.testing.assert_allclose(read(PLAIN, KEYS + "t_start = 0\n").time, TIME[2:] - 1)
    with pytest.raises(InputError, match=r"t_start = -0\.5,"):
        read(PLAIN, KEYS + "time_offset = 0.5\n")
    run = read(PLAIN, KEYS + "time_offset = 0.5\nt_start = -0.5\n")
    np.testing.assert_allclose(run.time, TIME[1:] - 0.5)


def test_a_motor_table_must_cover_the_track(read, tmp_path):
    (tmp_path / "motor.csv").write_text("time,rpm\n0,60\n5.2,60\n")
    scene = "[motor]\ntable = 'motor.csv'\n[time]\nend = 5\n"
    keys = KEYS + "time_offset = 1\n"
    with pytest.raises(
        InputError, match=r"last frame is from 6\.5 s .* covers 0 to 5\.2 s; .*"
    ) as c:
        read(PLAIN, keys, scene, rpm="")
    assert "t_end = 4," in str(c.value)
    assert read(PLAIN, keys + "t_end = 4\n", scene, rpm="").time[-1] == pytest.approx(5)


def test_rates_of_several_motors(read):
    two = "[robot]\nkind = 'two_flagella'\n"
    run = read(spots(), SPOTS + "track_id = 4\n", two, "motor_rpm = [60, -50.5]\n")
    assert run.motor_rpm == (60, -50.5)
    assert read(spots(), SPOTS + "track_id = 4\n", rpm="motor_rpm = [60]\n").motor_rpm == 60


@pytest.mark.parametrize("unit", ["um", "cm"])
def test_a_unit_in_the_header_that_is_another_one(read, unit):
    keys = SPOTS.replace('"mm"', f'"{unit}"') + "track_id = 4\n"
    with pytest.warns(
        InputWarning, match=f"the header says mm, the dataset length_unit = '{unit}'"
    ):
        read(spots(), keys)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(spots(), SPOTS + "track_id = 4\n")


def test_the_example_has_every_key():
    text = re.sub(r"^# (\w+ = \S|\[)", r"\1", template("dataset.toml"), flags=re.MULTILINE)
    dataset = tomllib.loads(text)
    assert set(dataset) == set(DatasetFile.model_fields)
    (run,) = dataset["runs"]
    assert set(run) == set(RunFile.model_fields)
    assert set(run["columns"]) == set(Columns.model_fields)
    (rates,) = dataset["rates"]
    assert set(rates) == set(RatesFile.model_fields)
    assert set(dataset["noise"]) == set(NoiseFile.model_fields)
    assert set(dataset["nuisances"]) == set(Shared.model_fields)


def test_a_track_without_rows(read):
    with pytest.raises(InputError, match=r"track\.csv: has a header but no rows"):
        read("t,x\n", KEYS)
