"""A track that goes the other way than its motor drives the robot is told of when it is read."""

import warnings

import numpy as np
import pytest

from derjax import InputError
from derjax.core.errors import InputWarning
from fitting.tracks import load_dataset

TIME = np.arange(30)
KEYS = """
columns = { t = "t", x = "x", y = "y", head_angle = "th" }
length_unit = "mm"
origin = "track"
"""


@pytest.fixture
def read(tmp_path):
    """A dataset with a robot that swims `x` mm/s and whose head turns `angle` rad/s."""

    def written(x=-0.5, angle=-0.3, rpm="70", keys=KEYS, scene="", wobble=0.1):
        y = wobble * np.sin(1.3 * TIME)
        rows = zip(TIME, x * TIME + y, y, angle * TIME, strict=True)
        table = "t,x,y,th\n" + "".join(",".join(map(str, row)) + "\n" for row in rows)
        (tmp_path / "track.csv").write_text(table)
        (tmp_path / "scene.toml").write_text(scene)
        text = f'scene = "scene.toml"\n[[runs]]\ntrack = "track.csv"\nmotor_rpm = {rpm}\n{keys}'
        (tmp_path / "dataset.toml").write_text(text)
        return load_dataset(tmp_path / "dataset.toml")

    return written


RIGHT = "[robot]\nhandedness = 'right'\n"
TWO = "[robot]\nkind = 'two_flagella'\n"


@pytest.mark.parametrize(
    ("track", "said"),
    [
        ({"x": 0.5, "angle": 0.3}, r"by x and head_angle .* Right would be motor_rpm = -70"),
        ({"rpm": "-70"}, r"with motor_rpm = -70 .* go towards \+x and turn its head forwards"),
        ({"x": 0.5, "keys": KEYS.replace(', head_angle = "th"', "")}, 'columns = { x = "-x" }'),
        ({"scene": RIGHT, "angle": 0.3, "rpm": "70"}, r"motor_rpm = -70, the other handedness"),
        ({"scene": TWO, "rpm": "[-70, -60]"}, r"the robot swims the other way than its motor"),
    ],
)
def test_the_other_way_is_refused_with_the_keys_that_make_it_right(read, track, said):
    with pytest.raises(InputError, match=said) as caught:
        read(**track)
    assert "track.csv" in str(caught.value)
    keys = track.get("keys", KEYS) + "backwards = true\n"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(**{**track, "keys": keys})


@pytest.mark.parametrize(
    ("track", "minus"),
    [
        ({"x": 0.5}, r'by x the robot swims .*columns = { x = "-x" }'),
        ({"angle": 0.3}, r'by head_angle the robot turns .*columns = { head_angle = "-th" }'),
    ],
)
def test_where_axes_contradict_each_other_a_warning_names_the_minus(read, track, minus):
    with pytest.warns(InputWarning, match=minus):
        read(**track)


@pytest.mark.parametrize(
    "track",
    [
        {},
        {"x": 0.5, "angle": 0.3, "rpm": "-70"},
        {"scene": RIGHT, "x": 0.5},
        {"scene": TWO, "rpm": "[70, -60]", "x": 0.5, "angle": 0.3},
        {"x": 0.5, "keys": KEYS + "drift = true\n", "angle": 0.3},
        {"x": 0.001, "angle": 0.001},  # it hardly moves
        {"x": 0.2, "angle": 0.001, "wobble": 9.0},  # that may be its wobble
        {"x": 0.5, "angle": 0.3, "rpm": "5"},  # the transient of a soft robot
    ],
)
def test_what_is_right_or_not_sure_is_not_spoken_of(read, track):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(**track)
