"""One track in the tables of every program: it is read to the same numbers."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from derjax import InputError
from fitting.datasetfile import RunFile
from fitting.formats import FORMATS, Sample, recognised
from fitting.formats.motive import _twists
from fitting.reading import read_track
from fitting.trackkeys import Axes

DATA = Path(__file__).parents[2] / "data"
_spec = importlib.util.spec_from_file_location("made", DATA / "make_format_files.py")
assert _spec is not None
assert _spec.loader is not None
made = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(made)

FRAMES = made.tracked()
TIME = np.array([f.t for f in FRAMES])
PLACE = 1e-3 * np.array([[f.x, f.y, f.z] for f in FRAMES])
ANGLE = np.array([f.angle for f in FRAMES])

PIXELS = {"fps": made.FPS, "pixel_size": made.PIXEL_MM, "length_unit": "mm"}
MM = {"length_unit": "mm"}

KEYS = {
    "imagej.csv": ("imagej", PIXELS),
    "imagej_tabs.txt": ("imagej", PIXELS),
    "imagej_labels.tsv": ("imagej", {**MM, "fps": made.FPS}),
    "manual_tracking.xls": ("manual-tracking", PIXELS),
    "mtrackj.txt": ("mtrackj", {}),
    "trackmate.csv": ("trackmate", {}),
    "trackmate_old.csv": ("trackmate", PIXELS),
    "trackmate.xml": ("trackmate-xml", {}),
    "tracker.txt": ("tracker", MM),
    "tracker_multi.txt": ("tracker", {**MM, "track_id": "head"}),
    "kinovea.csv": ("kinovea", MM),
    "kinovea_old.csv": ("kinovea", MM),
    "deeplabcut.csv": ("deeplabcut", PIXELS),
    "deeplabcut_individuals.csv": ("deeplabcut", PIXELS),
    "sleap.csv": ("sleap", PIXELS),
    "trackpy.csv": ("trackpy", PIXELS),
    "motive.csv": ("motive", {}),
    "plain.csv": ("plain", {}),
}
"""The format of each file, and the keys that it needs."""

ROUNDED = 1.1e-7
"""m: the coarsest digits are those of Kinovea, four behind the point of millimetres, twice."""


def read(path: Path, **keys):
    """The track in a file."""
    return read_track(path, RunFile.model_validate({"track": path.name, **keys}))


def assert_is_the_track(track, dimensions: int = 2, atol: float = ROUNDED) -> None:
    np.testing.assert_allclose(track.time, TIME - TIME[0], atol=1e-9)
    moved = track.values[:, :dimensions] - track.values[0, :dimensions]
    np.testing.assert_allclose(moved, PLACE[:, :dimensions] - PLACE[0, :dimensions], atol=atol)


@pytest.mark.parametrize("name", made.FILES)
def test_every_file_has_the_same_numbers(name):
    path, (form, keys) = DATA / "formats" / name, KEYS[name]
    assert recognised(Sample(path)).name == form
    track = read(path, **keys)
    assert_is_the_track(track)
    assert track.channels[:2] == (0, 1)
    if form in ("motive", "plain"):
        assert track.channels == (0, 1, 2, 3)
        assert_is_the_track(track, 3)
        turned = track.values[:, 3] - track.values[0, 3]
        np.testing.assert_allclose(turned, ANGLE - ANGLE[0], atol=2e-7)
    # What stands in the file as lost is counted; other programs leave such rows out.
    text, encoding = made.FILES[name]
    whole = form in ("tracker", "deeplabcut", "sleap", "motive", "plain")
    assert track.dropped == (len(made.LOST) if whole else 0)
    assert path.read_bytes() == text.encode(encoding), "run data/make_format_files.py"


def test_every_format_has_a_file():
    assert {form for form, _ in KEYS.values()} == {one.name for one in FORMATS}


def test_a_format_may_be_named_and_must_be_right():
    path = DATA / "formats" / "imagej.csv"
    assert_is_the_track(read(path, format="imagej", **PIXELS))
    with pytest.raises(InputError, match=r"format = 'motive': is not as .* \(format = 'imagej'\)"):
        read(path, format="motive")
    with pytest.raises(ValueError, match="should be one of 'trackmate-xml'"):
        RunFile.model_validate({"track": "a", "format": "excel"})


ASKED = {
    "imagej.csv": [("fps", "'Slice' seems to hold numbers of frames"), ("pixel_size", "no unit")],
    "trackmate_old.csv": [("fps", "'FRAME' seems"), ("pixel_size", "length_unit")],
    "tracker_multi.txt": [("track_id", "several tracks: head, tail"), ("length_unit", "no unit")],
    "deeplabcut.csv": [("fps", "'coords'"), ("pixel_size", "'head x', 'head y' are in pixels")],
    "kinovea.csv": [("length_unit", "no unit for columns 'Track 1/0/X'")],
}


@pytest.mark.parametrize("name", ASKED)
def test_what_a_file_does_not_tell_is_asked_for_by_the_name_of_the_key(name):
    with pytest.raises(InputError) as caught:
        read(DATA / "formats" / name)
    said = str(caught.value).splitlines()
    assert len(said) == len(ASKED[name])
    for line, (key, words) in zip(said, ASKED[name], strict=True):
        assert name in line
        assert key in line
        assert words in line


def with_lines(tmp_path: Path, name: str, change) -> Path:
    """A copy of a file whose lines are changed."""
    text, _ = made.FILES[name]
    lines = text.split("\n")
    (tmp_path / name).write_text("\n".join(change(lines)), encoding="utf-8")
    return tmp_path / name


def test_the_head_is_the_point_that_is_followed_unless_another_is_named():
    path = DATA / "formats" / "deeplabcut.csv"
    tail = read(path, node="tail", **PIXELS)
    assert len(tail.time) == made.FRAMES  # the tail was never lost
    assert "node" in " ".join(read(path, **PIXELS).said)
    with pytest.raises(InputError, match="node = 'fin': there are head, tail"):
        read(path, node="fin", **PIXELS)


def test_how_sure_a_position_must_be():
    path = DATA / "formats" / "deeplabcut.csv"
    assert read(path, likelihood=0.01, **PIXELS).dropped == 0
    assert_is_the_track(read(DATA / "formats" / "sleap.csv", likelihood=0.9, **PIXELS))
    with pytest.raises(InputError, match="0 frames"):
        read(DATA / "formats" / "sleap.csv", likelihood=0.95, **PIXELS)
    with pytest.raises(InputError, match="likelihood is given, but no column has one"):
        read(DATA / "formats" / "imagej.csv", likelihood=0.5, **PIXELS)


def test_of_several_particles_one_is_kept(tmp_path):
    path = DATA / "formats" / "imagej.csv"
    said = " ".join(read(path, **PIXELS).said)
    assert 'the largest is taken (several = "largest")' in said
    assert_is_the_track(read(path, several="nearest", **PIXELS))
    # Without areas, and dust that comes first in half of the frames.
    bare = with_lines(tmp_path, "imagej.csv", lambda lines: [
        ",".join(line.split(",")[:1] + line.split(",")[2:]) for line in lines if line
    ])  # fmt: skip
    track = read(bare, **PIXELS)
    assert_is_the_track(track)
    assert "nearest" in " ".join(track.said)
    with pytest.raises(InputError, match='several = "largest", but no column has areas'):
        read(bare, several="largest", **PIXELS)


def test_several_tracks_are_asked_for(tmp_path):
    def second(lines):
        other = [line.replace(",0,31.25,", ",3,31.25,", 1) for line in lines[4:12]]
        return [*lines[:-1], *other]

    path = with_lines(tmp_path, "trackmate.csv", second)
    with pytest.raises(InputError, match=r"'TRACK_ID' tells of .* 0, nothing, 3; .*track_id"):
        read(path)
    assert_is_the_track(read(path, track_id=0))


@pytest.mark.parametrize("value", ["-1", "0", "-1,000"])
def test_numbers_that_mean_nothing_are_found(tmp_path, value):
    def lost(lines):
        found = [line.replace("\t\t\t", f"\t{value}\t{value}\t") for line in lines]
        return [*lines[:2], *found[2:]]

    path = with_lines(tmp_path, "tracker.txt", lost)
    track = read(path, **MM)
    assert_is_the_track(track)
    assert track.dropped == 3
    assert any("count as not found (missing = []" in one for one in track.said)
    assert read(path, missing=[], **MM).dropped == 0
    assert read(path, missing=float(value.replace(",", ".")), **MM).dropped == 3


def test_a_track_that_begins_at_the_origin_is_no_gap(tmp_path):
    rows = "".join(f"{k},{-0.1 * k},{0.02 * k}\n" for k in range(20))
    (tmp_path / "a.csv").write_text("t,x,y\n" + rows)
    assert read(tmp_path / "a.csv", **MM).dropped == 0


def test_axes_of_the_picture_are_not_those_of_the_robot():
    path, keys = DATA / "formats" / "trackmate.csv", {}
    right_up = read(path, **keys).values
    turned = read(path, axes={"right": "z", "up": "-x"})
    assert turned.channels == (0, 2)
    np.testing.assert_allclose(turned.values, np.stack([-right_up[:, 1], right_up[:, 0]], 1))
    np.testing.assert_allclose(read(path, y_down=False).values, right_up * [1.0, -1.0], rtol=1e-12)
    matrix = Axes(right="y", up="-x").matrix
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    np.testing.assert_array_equal(matrix @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    with pytest.raises(ValueError, match="may point in one direction only"):
        Axes(right="y", up="-y")


def test_senses_that_are_turned_twice_are_refused():
    columns = {"t": "POSITION_T", "x": "POSITION_X", "y": "-POSITION_Y"}
    path = DATA / "formats" / "trackmate.csv"
    assert_is_the_track(read(path, columns=columns, length_unit="mm"))
    with pytest.raises(InputError, match="y_down = true turns y round, and so does the minus"):
        read(path, columns=columns, length_unit="mm", y_down=True)


def test_the_spin_of_a_body_is_about_its_own_axis():
    """The axis may swing, as in the picture of a camera above: the spin is what is left."""

    def about(axis, angle):
        return np.append(np.sin(angle / 2) * np.asarray(axis, float), np.cos(angle / 2))

    def times(a, b):
        vector = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
        return np.append(vector, a[3] * b[3] - a[:3] @ b[:3])

    askew = about([0.6, 0.0, 0.8], 1.1)
    angle, last = np.zeros(3), askew
    for k in range(1, 41):
        swing, spin = about([0, 0, 1], 0.02 * k), about([1, 0, 0], -0.1 * k)
        now = times(times(swing, spin), askew)  # spins about x, which swings about z
        angle, last = angle + _twists(askew, last, now), now
    assert angle[0] == pytest.approx(-4.0, abs=1e-3)


def test_the_angle_of_a_rigid_body_follows_the_axis_of_the_robot():
    path = DATA / "formats" / "motive.csv"
    turned = read(path, axes={"right": "-x", "up": "y"})
    np.testing.assert_allclose(turned.values[:, 3], ANGLE[0] - ANGLE, atol=1e-7)
    assert turned.channels == (0, 1, 2, 3)


LABELS = {"length_unit": "mm", "fps": made.FPS, "angle_unit": "deg"}


def test_angles_of_ellipses_are_unwrapped_by_a_key_and_refused_without():
    path = DATA / "formats" / "imagej_labels.tsv"
    columns = {"x": "X", "y": "Y", "head_angle": "Angle"}
    with pytest.raises(InputError, match=r"half a turn, as .* an ellipse; say angle_period = 180"):
        read(path, columns=columns, **LABELS)
    track = read(path, columns=columns, angle_period=180, y_down=True, **LABELS)
    assert_is_the_track(track)
    turned = track.values[:, 2] - track.values[0, 2]
    np.testing.assert_allclose(turned, ANGLE - ANGLE[0], atol=2e-5)
    with pytest.raises(InputError, match="which way it turns cannot be told"):
        read(path, columns=columns, angle_period=14.0, **LABELS)


def test_two_recordings_in_one_file_are_told_from_rows_in_no_order(tmp_path):
    first = [f"{0.5 * k},{-0.1 * k}" for k in range(14)]
    again = [f"{0.5 * k + 0.2:.4g},{-0.1 * k}" for k in range(14)]
    (tmp_path / "a.csv").write_text("\n".join(["t,x", *first, *again]))
    with pytest.raises(InputError, match=r"line 16, column 't': the time falls from 6.5 to 0.2"):
        read(tmp_path / "a.csv", **MM)
    (tmp_path / "a.csv").write_text("\n".join(["t,x", *first[7:], *first[:7]]))
    np.testing.assert_allclose(read(tmp_path / "a.csv", **MM).time, 0.5 * np.arange(14))


def test_times_that_jump_are_refused_and_the_advice_works(tmp_path):
    rows = [f"{k + 4000 * (k > 15)},{-0.1 * k}" for k in range(30)]
    (tmp_path / "a.csv").write_text("\n".join(["t,x", *rows]))
    with pytest.raises(InputError, match=r"line 18, column 't': the time jumps by 4001 s,"):
        read(tmp_path / "a.csv", **MM)
    assert len(read(tmp_path / "a.csv", t_end=15, **MM).time) == 16
    assert len(read(tmp_path / "a.csv", t_start=4016, **MM).time) == 14
    assert len(read(tmp_path / "a.csv", max_gap=4001, **MM).time) == 30
    with pytest.raises(InputError, match=r"longer than max_gap = 0\.5"):
        read(tmp_path / "a.csv", max_gap=0.5, t_end=15, **MM)


def test_clocks_that_count_frames_are_no_times(tmp_path):
    def to_frames(lines):
        return [line.replace(":40", ":01").replace(":80", ":02") for line in lines]

    path = with_lines(tmp_path, "kinovea_old.csv", to_frames)
    with pytest.raises(InputError, match="seem to stand frames, not parts of a second"):
        read(path, **MM)


def test_silhouettes_are_seen_from_a_side():
    path = DATA / "formats" / "trackmate.csv"
    assert read(path).sight is None
    assert read(path, point="silhouette").sight == 2
    assert read(path, point="silhouette", axes={"right": "x", "up": "z"}).sight == 1
    with pytest.raises(InputError, match="a camera sees two coordinates of it, but columns has 3"):
        read(DATA / "formats" / "motive.csv", point="silhouette")


FILES_OF_OTHER_KINDS = [
    (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", r"is a picture \(PNG\), not text"),
    (b"PK\x03\x04\x14\0\x06\0", "is a workbook or an archive, not text"),
    (b"\0\0\0\x20ftypisom\0\0\2\0", r"is a film \(MP4\), not text"),
    (b'{"frames": [1, 2]}', "is JSON, not a table"),
    (b'<?xml version="1.0"?>\n<TrackMate version="7.11.1">\n', "session of TrackMate; export"),
    (b'<?xml version="1.0"?>\n<svg/>\n', "is XML, but no tracks"),
    (b"<!DOCTYPE html><html>", "is a web page"),
    (
        b'<Tracks nTracks="1">\n<particle>\n<detection t="0" x="1"/>',
        "line 3: a detection without y",
    ),
    (b'<Tracks nTracks="1">\n<particle>\n<detection t="0" x="1" y="2"/>', "is not whole XML"),
    (b"", "the file is empty"),
    (b"a,b\n1,2\n3,4\n", r"it is not clear which columns hold what; say columns = .*'a', 'b'"),
    (b"1,2\n3,4\n", "there is no header: numbers of columns"),
    (b"t,x (mm)\n0,1\n1,2\n2,3\n3,4\n4,5\n", "5 frames; at least 10"),
]


@pytest.mark.parametrize(("content", "says"), FILES_OF_OTHER_KINDS)
def test_files_that_are_something_else(tmp_path, content, says):
    (tmp_path / "track.csv").write_bytes(content)
    with pytest.raises(InputError, match=says) as caught:
        read(tmp_path / "track.csv")
    assert str(tmp_path / "track.csv") in str(caught.value)


def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path):
    with (tmp_path / "track.csv").open("wb") as stream:
        stream.write(b"t,x\n0,1\n")
        stream.truncate(300_000_000)
    with pytest.raises(InputError, match="has 300 MB: too much for the track of one robot"):
        read(tmp_path / "track.csv")


WRITTEN = {
    "trackmate": ("POSITION_T", "POSITION_X", "POSITION_Y", "TRACK_ID", "FRAME"),
    "mtrackj": ("t [sec]", "x [mm]", "y [mm]", "TID", "PID"),
    "trackpy": ("frame", "x", "y", "particle", "mass"),
    "plain": ("time (s)", "x (mm)", "y (mm)", "track", "index"),
}


@settings(deadline=None, max_examples=120, suppress_health_check=list(HealthCheck))
@given(
    form=st.sampled_from(sorted(WRITTEN)),
    delimiter=st.sampled_from([",", ";", "\t"]),
    comma=st.booleans(),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
    header_rows=st.integers(1, 4),
    trailing=st.booleans(),
    seed=st.integers(0, 99),
    lost=st.sets(st.integers(1, 18), max_size=4),
    blank=st.sampled_from(["", "NaN"]),
)
def test_however_a_track_is_written(
    tmp_path, form, delimiter, comma, encoding, header_rows, trailing, seed, lost, blank
):
    """Delimiters, decimal signs, encodings, header rows, order of rows, gaps: the same numbers."""
    names = list(WRITTEN[form])
    if form == "trackpy":
        names = [*names, "signal"]
    header = [names]
    if form == "trackmate":
        keys, units = names, ["(sec)", "(mm)", "(mm)", "", ""]
        header = [keys, ["T", "X", "Y", "Track ID", "Frame"], ["T", "X", "Y", "Trk", "Fr"], units]
        header = header[: header_rows - 1] + header[3:]
        header = header if header_rows > 1 else [keys]
    frames = np.arange(20)
    x, y = -0.31 * frames, 0.2 * np.sin(frames)
    fast = form == "trackpy"
    rows = []
    for k in frames:
        clock = k if fast else 0.5 * k
        seen = [blank, blank] if k in lost else [f"{x[k]:.9f}", f"{-y[k] if fast else y[k]:.9f}"]
        rows.append([str(clock), *seen, "7", str(k + 1)] + ["1"] * fast)
    order = np.random.default_rng(seed).permutation(20)
    cells = [*header, *(rows[k] for k in order)]
    decimal = comma and delimiter != ","
    lines = [
        delimiter.join(cell.replace(".", ",") if decimal and i >= len(header) else cell
                       for cell in row) + delimiter * trailing
        for i, row in enumerate(cells)
    ]  # fmt: skip
    path = tmp_path / "track.txt"
    path.write_bytes(("\n".join(lines) + "\n").encode(encoding))
    keys = {"length_unit": "mm", "y_down": fast}
    keys |= {"fps": 2.0, "pixel_size": 1.0} if fast else {}
    track = read(path, **keys)
    seen = np.setdiff1d(frames, list(lost))
    assert recognised(Sample(path)).name == form
    np.testing.assert_allclose(track.time, 0.5 * seen, atol=1e-12)
    np.testing.assert_allclose(track.values, 1e-3 * np.stack([x, y], 1)[seen], atol=1e-12)
    assert track.dropped == len(lost)


WIDE = {
    "tracker": (["t", "x", "y"], ["head", "", ""]),
    "kinovea": (["Time", "Track 1/0/X", "Track 1/0/Y"],),
    "deeplabcut": (["coords", "x", "y", "likelihood"], ["bodyparts"] + ["head"] * 3,
                   ["scorer"] + ["net"] * 3, ["individuals"] + ["one"] * 3),
    "sleap": (["frame_idx", "head.x", "head.y", "head.score", "track", "instance.score"],),
    "imagej": (["Slice", "X", "Y", "Area", "", "Mean"],),
}  # fmt: skip
"""Header rows of programs that write the columns of a point side by side, from the last up."""


@settings(deadline=None, max_examples=120, suppress_health_check=list(HealthCheck))
@given(
    form=st.sampled_from(sorted(WIDE)),
    delimiter=st.sampled_from([",", ";", "\t", " "]),
    comma=st.booleans(),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
    quoted=st.booleans(),
    trailing=st.booleans(),
    several=st.booleans(),
    lost=st.sets(st.integers(1, 18), max_size=4),
)
def test_however_points_stand_side_by_side(
    tmp_path, form, delimiter, comma, encoding, quoted, trailing, several, lost
):
    """As above; a second point of the robot, or mass, or track may stand beside the first."""
    delimiter = delimiter if form in ("tracker", "imagej") or delimiter != " " else ";"
    blank = "NaN" if delimiter == " " else ""
    header = [list(row) for row in WIDE[form]]
    if form == "imagej":  # the number of the row comes first
        header = [["", *(name for name in header[0] if name)]]
        delimiter = delimiter if delimiter in ",\t" else ","
    if form == "sleap":
        header = [[*header[0][-2:], *header[0][:-2]]]
    if several:
        for row in header if form in ("tracker", "kinovea", "deeplabcut") else []:
            row += [cell.replace("head", "tail").replace("Track 1", "Track 2") for cell in row[1:]]
    if form == "tracker" and several:
        header[1][header[1].index("", 1) + 2] = "tail"
    frames = np.arange(20)
    x, y = -0.31 * frames, 0.2 * np.sin(frames)
    counts = form in ("deeplabcut", "sleap", "imagej")
    down = -1.0 if counts else 1.0
    rows = []
    for k in frames:
        clock = str(k) if counts else f"{0.5 * k:.6E}" if form == "tracker" else str(0.5 * k)
        point = [blank, blank] if k in lost else [f"{x[k]:.9f}", f"{down * y[k]:.9f}"]
        sure = ["0.99"] * (form in ("deeplabcut", "sleap"))
        first = {"sleap": ["", "0.9"], "imagej": [str(k + 1), "310", "99"]}.get(form, [])
        if form == "imagej":
            rows.append([first[0], clock, *point, *first[1:]])
            continue
        rows.append([*first, clock, *point, *sure])
        if several and form != "sleap":
            rows[-1] += [f"{x[k] + 9:.4f}", "4.25", *sure]
    decimal = comma and delimiter not in ", "
    quoted = quoted or (delimiter == " " and form == "tracker")
    cells = [[c.replace(".", ",") for c in row] if decimal else row for row in rows]
    cells = [*reversed(header), *cells]
    if quoted:
        cells = [[f'"{cell}"' for cell in row] for row in cells]
    path = tmp_path / "track.txt"
    text = "".join(delimiter.join(row) + delimiter * trailing + "\n" for row in cells)
    path.write_bytes(text.encode(encoding))
    keys = {"length_unit": "mm"}
    keys |= {"fps": 2.0, "pixel_size": 1.0} if counts else {}
    if several and form in ("tracker", "kinovea"):
        keys["track_id"] = "head" if form == "tracker" else "Track 1"
    assert recognised(Sample(path)).name == form
    track = read(path, **keys)
    seen = np.setdiff1d(frames, list(lost))
    np.testing.assert_allclose(track.time, 0.5 * seen, atol=1e-9)
    np.testing.assert_allclose(track.values, 1e-3 * np.stack([x, y], 1)[seen], atol=1e-12)
    assert track.dropped == len(lost)
