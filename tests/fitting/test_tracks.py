"""Datasets: what is read, and one clear message for everything that cannot be."""

from pathlib import Path

import numpy as np
import pytest

from derjax import InputError
from fitting.tracks import load_dataset

FRAMES = 12


def good_rows() -> list[list[str]]:
    """A robot that swims 0.5 mm/s from where the scene starts, with its head turning."""
    return [
        [f"{1 + t:g}", f"{-10.3 - 0.5 * t:g}", "0.01", f"{-0.3 * t:.3f}"] for t in range(FRAMES)
    ]


RUN = """
[[runs]]
track = "track.csv"
motor_rpm = 70
columns = { t = "t", x = "x_mm", y = "y_mm", head_angle = "angle" }
length_unit = "mm"
"""


@pytest.fixture
def written(tmp_path: Path):
    """Writes a dataset; returns its path."""

    def write(
        rows: list[list[str]] | None = None,
        run: str = RUN,
        header: str = "t,x_mm,y_mm,angle",
        scene: str = "",
    ) -> Path:
        rows = good_rows() if rows is None else rows
        (tmp_path / "scene.toml").write_text(scene)
        (tmp_path / "track.csv").write_text("\n".join([header, *map(",".join, rows)]) + "\n")
        (tmp_path / "dataset.toml").write_text('scene = "scene.toml"\n' + run)
        return tmp_path / "dataset.toml"

    return write


def changed(row: int, column: int, text: str) -> list[list[str]]:
    rows = good_rows()
    rows[row][column] = text
    return rows


def test_units_and_channels(written) -> None:
    extra = 'time_unit = "ms"\nangle_unit = "deg"\nsigma = 0.1\nsigma_angle = 2\norigin = "track"\n'
    (run,) = load_dataset(written(run=RUN + extra + "time_offset = 500\n")).runs
    assert run.channels == (0, 1, 3)
    assert np.allclose(run.time, (np.arange(1, FRAMES + 1) + 500) * 1e-3)
    assert run.values[2] == pytest.approx([-11.3e-3, 1e-5, np.deg2rad(-0.6)])
    assert run.sigma == pytest.approx(1e-4)
    assert run.sigma_angle == pytest.approx(np.deg2rad(2))
    assert run.free_origin
    assert run.motor_rpm == 70


def test_comments_blank_lines_and_spaces_are_allowed(written) -> None:
    path = written(header="# filmed\n\n t , x_mm, y_mm ,angle")
    assert load_dataset(path).runs[0].values.shape == (FRAMES, 3)


def test_start_and_end_select_frames(written) -> None:
    (run,) = load_dataset(written(run=RUN + "t_start = 2.0\nt_end = 11.0\n")).runs
    assert run.time[[0, -1]] == pytest.approx([2.0, 11.0])


def test_a_frame_is_of_the_middle_of_its_exposure(written) -> None:
    (run,) = load_dataset(written(run=RUN + "exposure = 0.5\n")).runs
    (sharp,) = load_dataset(written()).runs
    assert run.exposure == 0.5
    assert run.time == pytest.approx(sharp.time + 0.25)


STEADY = 'start = "steady"\n'

CASES = {
    "missing track": ({"run": RUN.replace("track.csv", "trak.csv")}, "trak.csv: no such file"),
    "missing column": ({"run": RUN.replace('"y_mm"', '"y"')}, "no column 'y'; .*'x_mm', 'y_mm'"),
    "column twice": ({"header": "t,x_mm,x_mm,angle"}, "two columns have the name 'x_mm'|no column"),
    "text": ({"rows": changed(0, 1, "lost")}, r"line 2 \(row 1\), column 'x_mm': .*'lost'"),
    "decimal comma": ({"rows": changed(0, 1, "1,5")}, "line 2: 5 fields, but the header has 4"),
    "short row": ({"rows": [*good_rows(), ["99"]]}, "line 14: 1 fields, but the header has 4"),
    "repeated": ({"rows": changed(5, 0, "5")}, "line 7, column 't': the time of line 6 is repea"),
    "no time": ({"rows": changed(5, 0, "")}, "line 7, column 't': has no time"),
    "no numbers": (
        {"rows": [[*row[:3], "null"] for row in good_rows()]},
        "column 'angle' has no numbers; leave it out of columns",
    ),
    "few frames": ({"rows": good_rows()[:9]}, "track.csv: 9 frames; at least 10"),
    "few selected": ({"run": RUN + "t_end = 5.0\n"}, "5 frames of 12 lie between"),
    "before motor": ({"run": RUN + "time_offset = -3.0\n"}, "line 2, .*2 s before the motor"),
    "mm read as m": (
        {"run": RUN.replace('length_unit = "mm"\n', "")},
        r"track.csv: columns x_mm, y_mm: .* did you mean length_unit = 'mm'",
    ),
    "mm read as cm": (
        {
            "run": RUN.replace('"mm"', '"cm"'),
            "rows": [[r[0], str(15 * float(r[1])), *r[2:]] for r in good_rows()],
        },
        "did you mean length_unit = 'mm'",
    ),
    "elsewhere": (
        {"rows": [[r[0], str(500 + float(r[1])), *r[2:]] for r in good_rows()]},
        "0.5 m away .* set origin = 'track'",
    ),
    "wrapped": (
        {
            "rows": [
                [*r[:3], f"{(-0.7 * i + 3) % 6.28 - 3.14:.3f}"] for i, r in enumerate(good_rows())
            ]
        },
        "line 7: the head angle jumps by 5.5",
    ),
    "unknown key": ({"run": RUN + "sigmas = 1\n"}, r"runs.*entry 1.*sigmas: unknown key.*'sigma'"),
    "unknown unit": ({"run": RUN.replace('"mm"', '"inch"')}, "dataset.toml: .*length_unit.*inch"),
    "only times": ({"run": '[[runs]]\ntrack="track.csv"\ncolumns={t="t"}\n'}, "at least one of x"),
    "a silhouette that starts steady": (
        {"run": RUN.replace(', head_angle = "angle"', "") + STEADY + 'point = "silhouette"\n'},
        r'dataset.toml: .*entry 1.*start = "steady": .*silhouette changes as the robot rolls',
    ),
    "a late start that starts steady": (
        {"run": RUN + STEADY + "nuisances = { time_offset = {} }\n"},
        r"entry 1.*nuisances.time_offset: has no effect",
    ),
    "a phase from rest": (
        {"run": RUN + "nuisances = { phase = {} }\n"},
        r'nuisances.phase: is only for tracks with start = "steady"',
    ),
    "a rate from rest": (
        {"run": RUN + "nuisances = { motor_rpm = { std = 1.0 } }\n"},
        r'nuisances.motor_rpm: is only for tracks with start = "steady"',
    ),
    "an exposure in other units": (
        {"run": RUN + "exposure = 20\n"},
        r"track.csv: exposure = 20 s is longer than the 1 s from one frame to the next",
    ),
    "no runs": ({"run": ""}, "dataset.toml: .*runs"),
    "bad scene": ({"scene": "[head]\nC_tt = 1\n"}, "scene.toml: .*C_tt.*'C_t'"),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_named(written, case) -> None:
    content, says = CASES[case]
    with pytest.raises(InputError, match=says):
        load_dataset(written(**content))


def test_missing_dataset(tmp_path) -> None:
    with pytest.raises(InputError, match=r"nothing\.toml: no such file"):
        load_dataset(tmp_path / "nothing.toml")


def test_a_motor_table_and_a_rate_contradict_each_other(written, tmp_path) -> None:
    (tmp_path / "motor.csv").write_text("time,rpm\n0,10\n20,70\n")
    scene = '[motor]\ntable = "motor.csv"\n'
    with pytest.raises(InputError, match="leave motor_rpm out"):
        load_dataset(written(scene=scene))
    (run,) = load_dataset(written(scene=scene, run=RUN.replace("motor_rpm = 70\n", ""))).runs
    assert run.motor_rpm is None


def test_displacements_may_start_anywhere(written) -> None:
    rows = [[r[0], str(500 + float(r[1])), *r[2:]] for r in good_rows()]
    (run,) = load_dataset(written(rows=rows, run=RUN + 'origin = "track"\n')).runs
    assert run.free_origin


@pytest.mark.parametrize(("rpm", "step"), [(60, 0.05), (300, 0.01)])
def test_steps_that_are_not_given_suit_the_motors_of_the_tracks(tmp_path, rpm, step) -> None:
    """And not that of the scene, which turns at 60 rpm."""
    (tmp_path / "scene.toml").write_text("[robot]\nedge_length = 0.03\n")
    rows = "".join(f"{k},{-1e-4 * k}\n" for k in range(12))
    (tmp_path / "track.csv").write_text("t,x\n" + rows)
    (tmp_path / "dataset.toml").write_text(
        'scene = "scene.toml"\n[[runs]]\ntrack = "track.csv"\norigin = "track"\n'
        f'motor_rpm = {rpm}\ncolumns = {{ t = "t", x = "x" }}\n'
    )
    assert load_dataset(tmp_path / "dataset.toml").scene.step == pytest.approx(step)
