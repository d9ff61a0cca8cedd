"""Films of trajectories: what they show, the files they make, and what is refused."""

import errno
import os
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from PIL import Image

from derjax import InputError
from derjax.commands.main import main
from derjax.results import animation
from derjax.results import dataset as trajectory
from derjax.results.film import NO_FILAMENT, PALETTE, film_of, polylines
from derjax.results.surfaces import tubes

N_FRAMES, N_NODES, SPACING = 12, 9, 0.1
HELICES = tuple(tuple(range(k, k + N_NODES)) for k in (1, 1 + N_NODES))
"""Two helices, each joined to the head at node 0."""


def moving_helices(filament: bool = True, head: bool = True, n_frames: int = N_FRAMES):
    """A data set as `trajectory.to_dataset` makes it, of helices that turn and advance."""
    time = SPACING * np.arange(n_frames)
    along = np.linspace(0.0, 1.0, N_NODES)
    phase = 12.0 * along - 6.0 * time[:, None]
    x = 0.01 + 0.08 * along - 0.002 * time[:, None]
    helix = np.stack([x, 0.006 * np.cos(phase), 0.006 * np.sin(phase)], axis=-1)
    centre = np.zeros((n_frames, 1, 3))
    centre[:, 0, 0] = -0.002 * time
    apart = np.array([0.0, 0.02, 0.0])
    nodes = np.concatenate([centre, helix + apart, helix - apart], axis=1)
    edges = np.array([pair for path in HELICES for pair in zip((0, *path[:-1]), path, strict=True)])
    number = np.repeat([0, 1], N_NODES)
    number[::N_NODES] = -1
    data = xr.Dataset(
        {"position": (("time", "node", "axis"), nodes, {"units": "m"})},
        {
            "time": ("time", time, {"units": "s"}),
            "axis": ("axis", ["x", "y", "z"]),
            "edge_start": ("edge", edges[:, 0]),
            "edge_end": ("edge", edges[:, 1]),
        },
        {"rod_radius": 1.6e-3, "head_radius": 0.015},
    )
    if filament:
        data = data.assign_coords(filament=("edge", number))
    if head:
        data["head_position"] = (("time", "axis"), nodes[:, 0])
    return data


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The directory of a finished run."""
    directory = tmp_path / "run"
    directory.mkdir()
    trajectory.write(moving_helices(), directory / "trajectory.nc")
    return directory


def names(directory: Path) -> set[str]:
    return {path.name for path in directory.iterdir()}


def test_films_of_a_run(run, capsys):
    assert main(["render", str(run)]) == 0
    assert names(run) == {"trajectory.nc", "animation.gif", "animation.html"}
    said = capsys.readouterr().out
    assert f"{run / 'animation.gif'}: {N_FRAMES} frames, 1.2 s" in said
    with Image.open(run / "animation.gif") as film:
        assert film.n_frames == N_FRAMES
        assert film.size == (800, 480)
        assert film.info["duration"] == 100
        assert film.convert("RGB").getpixel((1, 1)) == (255, 255, 255)
    assert 20e3 < (run / "animation.gif").stat().st_size < 1e6
    page = (run / "animation.html").read_text(encoding="utf-8")
    assert 'src="http' not in page
    assert "<script src" not in page
    assert "<link" not in page
    assert "</html>" in page
    # Each frame is there once as a frame and once as a step of the slider.
    for frame in range(N_FRAMES):
        assert f'"name":"{frame}"' in page
        assert f'"args":[["{frame}"]' in page
    assert f'"name":"{N_FRAMES}"' not in page
    assert len(page) < 7e6


def test_options_choose_the_frames(run, tmp_path):
    out = tmp_path / "films"
    argv = ["render", str(run), "-o", str(out), "--formats", "gif", "--quiet"]
    options = ["--speed", "2", "--fps", "10", "--from", "0.2", "--to", "0.9", "--follow"]
    assert main([*argv, *options]) == 0
    assert names(out) == {"animation.gif"}
    assert names(run) == {"trajectory.nc"}
    with Image.open(out / "animation.gif") as film:
        assert film.n_frames == 4  # at 0.2, 0.4, 0.6 and 0.8 s
        assert film.info["duration"] == 100


def test_film_keeps_time():
    """Frames have equal distances, are no more than asked for, and last as long as they must."""
    film = film_of(moving_helices(), fps=7.0, speed=1.0)
    np.testing.assert_allclose(film.time, SPACING * np.arange(0, N_FRAMES, 2))
    assert film.frame_length == pytest.approx(0.2)
    assert [film.label(i) for i in (0, 1)] == ["t = 0.0 s", "t = 0.2 s"]
    slow = film_of(moving_helices(), speed=0.1)
    assert slow.n_frames == N_FRAMES
    assert slow.frame_length == pytest.approx(1.0)


def test_moments_have_the_digits_that_tell_frames_apart():
    data = moving_helices()
    film = film_of(data.assign_coords(time=1e-5 * data.time), fps=7.0, speed=1e-5)
    assert [film.label(i) for i in (0, 1)] == ["t = 0.000000 s", "t = 0.000002 s"]


def test_gif_keeps_time_in_hundredths_of_a_second(run, tmp_path):
    film = film_of(moving_helices(), speed=1.5)
    animation.write_gif(film, tmp_path / "film.gif")
    lengths = []
    with Image.open(tmp_path / "film.gif") as image:
        for frame in range(image.n_frames):
            image.seek(frame)
            lengths.append(image.info["duration"])
    assert set(lengths) == {60, 70}
    assert sum(lengths) == pytest.approx(1e3 * N_FRAMES * SPACING / 1.5)


def test_followed_head_stays():
    film = film_of(moving_helices(), follow=True)
    assert film.head is not None
    assert not film.head.any()
    assert film.label(10) == "t = 1.0 s,  head at (-2.0, 0.0, 0.0) mm"
    assert film.axis_label("x") == "x from head (mm)"
    headless = film_of(moving_helices(head=False), follow=True)
    np.testing.assert_allclose(headless.nodes.mean(axis=1), 0.0, atol=1e-9)
    assert "middle at" in headless.label(0)


def test_colours_are_those_of_the_filaments():
    film = film_of(moving_helices())
    colour = dict(zip(film.lines, film.colours, strict=True))
    assert [colour[path] for path in HELICES] == list(PALETTE[:2])
    assert [c for path, c in colour.items() if 0 in path] == [NO_FILAMENT]
    unknown = film_of(moving_helices(filament=False))
    assert len(unknown.lines) == len(set(unknown.colours)) == 1  # two at a node are no branch


@pytest.mark.parametrize(
    ("edges", "expected"),
    [
        ([(0, 1), (1, 2), (2, 3)], {(0, 1, 2, 3)}),
        ([(2, 1), (0, 1), (3, 2)], {(0, 1, 2, 3)}),
        ([(0, 1), (2, 3)], {(0, 1), (2, 3)}),
        ([(0, 1), (1, 2), (1, 3), (3, 4)], {(0, 1), (1, 2), (1, 3, 4)}),
        ([(0, 1), (1, 2), (2, 0)], {(0, 1, 2, 0)}),
        ([(0, 1), (1, 2), (2, 3), (3, 1)], {(0, 1), (1, 2, 3, 1)}),
    ],
    ids=["chain", "shuffled", "two", "branched", "ring", "lasso"],
)
def test_polylines(edges, expected):
    found = polylines(np.array(edges))
    assert len(found) == len(expected)
    assert {min(path, path[::-1]) for path in found} == {min(p, p[::-1]) for p in expected}


def test_tubes_have_the_radius_of_the_rod():
    """Away from nodes: the middles of a tube's long edges lie on the rod's surface."""
    film = film_of(moving_helices())
    mesh = tubes(film, 8)
    assert np.isfinite(mesh.vertices).all()
    assert mesh.faces.max() == mesh.vertices.shape[1] - 1
    start = 0
    for path in film.lines:
        rings = mesh.vertices[:, start : start + 8 * (len(path) + 4)]
        rings = rings.reshape(len(rings), len(path) + 4, 8, 3)[:, 2:-2]
        start += 8 * (len(path) + 4)
        nodes = film.nodes[:, list(path), None]
        along = nodes[:, 1:] - nodes[:, :-1]
        along = along / np.linalg.norm(along, axis=-1, keepdims=True)
        across = np.cross(rings[:, 1:] - nodes[:, 1:], along)
        np.testing.assert_allclose(np.linalg.norm(across, axis=-1), film.rod_radius, rtol=1e-9)


def test_everything_stays_in_the_picture():
    film = film_of(moving_helices())
    low, high = film.bounds()
    vertices = tubes(film, 8).vertices
    assert (vertices > low).all()
    assert (vertices < high).all()
    assert film.head is not None
    assert (film.head - film.head_radius > low).all()


def test_mp4(run):
    try:
        animation.ffmpeg()
    except InputError:
        pytest.skip("no ffmpeg")
    assert main(["render", str(run), "--formats", "mp4"]) == 0
    assert names(run) == {"trajectory.nc", "animation.mp4"}
    assert (run / "animation.mp4").read_bytes()[4:8] == b"ftyp"


def test_mp4_without_ffmpeg(run, monkeypatch, capsys):
    monkeypatch.setitem(mpl.rcParams, "animation.ffmpeg_path", "no-such-program")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert main(["render", str(run), "--formats", "gif", "mp4"]) == 2
    assert "pip install imageio-ffmpeg" in capsys.readouterr().err
    assert names(run) == {"trajectory.nc"}


def test_films_are_not_overwritten_unless_asked(run, capsys):
    (run / "animation.html").write_text("mine")
    assert main(["render", str(run)]) == 2
    said = capsys.readouterr().err
    assert str(run / "animation.html") in said
    assert "--overwrite" in said
    assert names(run) == {"trajectory.nc", "animation.html"}
    argv = ["render", str(run), "--formats", "html", "--overwrite", "--quiet"]
    assert main(argv) == 0
    assert capsys.readouterr() == ("", "")
    assert (run / "animation.html").read_text(encoding="utf-8") != "mine"


@pytest.mark.parametrize("format", ["gif", "mp4"])
def test_interrupted_film_leaves_nothing(run, format, monkeypatch, capsys):
    if format == "mp4":
        try:
            animation.ffmpeg()
        except InputError:
            pytest.skip("no ffmpeg")

    def show(self: animation.Picture, frame: int) -> None:
        if frame == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(animation.Picture, "show", show)
    assert main(["render", str(run), "--formats", format]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert names(run) == {"trajectory.nc"}


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--from", "2", "--to", "1"], "--from 2: must be before --to 1"),
        (["--from", "5"], "trajectory.nc: there are less than two frames to show"),
        (["--to", "0.05"], "less than two frames"),
        (["--speed", "100"], "less than two frames"),
        (["--speed", "0"], "--speed 0"),
        (["--speed", "nan"], "--speed nan"),
        (["--fps", "0"], "--fps 0"),
        (["--fps", "1000"], "--fps 1000"),
        (["--from", "nan"], "--from nan"),
    ],
)
def test_options_that_cannot_be(run, options, expected, capsys):
    assert main(["render", str(run), *options]) == 2
    said = capsys.readouterr().err
    assert expected in said
    assert said.count("\n") == 1
    assert names(run) == {"trajectory.nc"}


def refused(argv: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What `derjax render` says in one line when it refuses."""
    assert main(["render", *argv]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def test_missing_directory_and_missing_trajectory(tmp_path, capsys):
    assert f"{tmp_path / 'none'}: no such directory" in refused([str(tmp_path / "none")], capsys)
    assert f"{tmp_path / 'trajectory.nc'}: no such file" in refused([str(tmp_path)], capsys)


def test_not_a_trajectory(run, capsys):
    path = run / "trajectory.nc"
    trajectory.write(moving_helices().drop_vars("edge_end"), path)
    said = refused([str(run)], capsys)
    assert f"{path}: is not a trajectory of derjax: it has no 'edge_end'" in said
    path.write_text("time,x\n0,1\n")
    assert f"{path}: cannot be read as NetCDF" in refused([str(run)], capsys)


def test_trajectories_that_make_no_film(run, capsys):
    path = run / "trajectory.nc"
    trajectory.write(moving_helices(n_frames=1), path)
    assert f"{path}: there is one frame only" in refused([str(run)], capsys)
    broken = moving_helices()
    broken["position"][3, 2, 1] = np.nan
    trajectory.write(broken, path)
    assert f"{path}: there are positions that are not numbers" in refused([str(run)], capsys)
    assert names(run) == {"trajectory.nc"}


def test_output_that_cannot_be_written(run, monkeypatch, capsys):
    path = run / "trajectory.nc"
    assert f"{path}: is not a directory" in refused([str(run), "-o", str(path)], capsys)
    monkeypatch.setattr("os.fsync", no_space)
    assert f"{run}: cannot be written to: No space" in refused([str(run)], capsys)
    assert names(run) == {"trajectory.nc"}


def test_a_film_for_which_there_is_no_room(run, monkeypatch, capsys):
    monkeypatch.setattr(animation.Picture, "show", no_space)
    path = run / "animation.gif"
    assert f"{path}: cannot be written: No space left" in refused([str(run)], capsys)
    assert names(run) == {"trajectory.nc"}


def test_a_film_that_appears_meanwhile_is_not_replaced(run, monkeypatch, capsys):
    path = run / "animation.gif"
    show = animation.Picture.show

    def write_another(self: animation.Picture, frame: int) -> None:
        path.write_text("another's")
        show(self, frame)

    monkeypatch.setattr(animation.Picture, "show", write_another)
    assert f"{path}: was written by another program" in refused([str(run), "--quiet"], capsys)
    assert path.read_text() == "another's"


def no_space(*_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
