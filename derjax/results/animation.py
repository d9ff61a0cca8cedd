"""Films of a trajectory: what is seen at which moment, and GIF and MP4 files of it.

The picture is made of the edges alone, whatever the robot: a tube along every unbranched path
of edges, and a ball for the head if there is one. `viewer` shows the same in a browser.
"""

import dataclasses
import math
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.animation import FFMpegWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from PIL import Image

from ..core.errors import InputError
from ..io.files import atomic_path

MM = 1e3
PALETTE = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#B8A800")
"""Colours of the filaments, after Okabe and Ito: told apart by colour-blind readers too."""
NO_FILAMENT, HEAD = "#555555", "#8a8a8a"

NEEDED = ("time", "position", "edge_start", "edge_end")
MOST_FPS = 50.0
"""Players show a GIF slowly whose frames last less than 0.02 s."""
SIZE, DPI = (8.0, 4.8), 100
LIGHT = np.array([0.25, -0.75, 0.6])
SLIDE = 0.3
"""Mitres of a tube where it turns back on itself are cut short by this bound on 1 + cos."""

Tick = Callable[[int], None]
"""Is told how many frames are done."""


@dataclasses.dataclass(frozen=True)
class Film:
    """What is to be seen. Lengths in mm, times of the simulation in s.

    Attributes:
        time: (t,).
        nodes: (t, n, 3).
        lines: paths of nodes, to be drawn as tubes.
        colours: one for each line.
        rod_radius: of the tubes.
        head: (t, 3) centres of the head; None without one.
        head_radius: of its ball.
        centre: (t, 3) what the camera follows, already taken off `nodes` and `head`; or None.
        frame_length: s of film that each frame lasts.
    """

    time: np.ndarray
    nodes: np.ndarray
    lines: tuple[tuple[int, ...], ...]
    colours: tuple[str, ...]
    rod_radius: float
    head: np.ndarray | None
    head_radius: float
    centre: np.ndarray | None
    frame_length: float

    @property
    def n_frames(self) -> int:
        return len(self.time)

    def moment(self, frame: int) -> str:
        """The time of a frame (s) as a text, with as many digits as tell frames apart."""
        interval = self.time[1] - self.time[0]
        first = max(0, -math.floor(math.log10(interval)))
        slack = 1e-6 * interval
        enough = (d for d in range(first, first + 3) if abs(round(interval, d) - interval) < slack)
        digits = next(enough, first + 3)
        return f"{self.time[frame]:.{digits}f}"

    def label(self, frame: int) -> str:
        """What stands over a frame."""
        said = f"t = {self.moment(frame)} s"
        if self.centre is None:
            return said
        x, y, z = self.centre[frame]
        return f"{said},  {self.centre_name} at ({x:.1f}, {y:.1f}, {z:.1f}) mm"

    @property
    def centre_name(self) -> str:
        return "middle" if self.head is None else "head"

    def axis_label(self, axis: str) -> str:
        return f"{axis} (mm)" if self.centre is None else f"{axis} from {self.centre_name} (mm)"

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of a box that holds everything in all frames."""
        reach = [(self.nodes.reshape(-1, 3), self.rod_radius)]
        if self.head is not None:
            reach.append((self.head, self.head_radius))
        low = np.min([points.min(axis=0) - r for points, r in reach], axis=0)
        high = np.max([points.max(axis=0) + r for points, r in reach], axis=0)
        margin = 0.02 * (high - low).max()
        return low - margin, high + margin


class Mesh(NamedTuple):
    """A surface: vertices (t, v, 3) in mm, quadrilaterals (f, 4), the line (v,) of each vertex."""

    vertices: np.ndarray
    faces: np.ndarray
    line: np.ndarray


def read(path: Path) -> xr.Dataset:
    """The trajectory in a NetCDF file, as `derjax simulate` writes it.

    Raises:
        InputError: there is no such file, or it holds something else.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; 'derjax simulate -o {path.parent}' writes it")
    try:
        trajectory = xr.load_dataset(path, engine="h5netcdf")
    except PermissionError:
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as NetCDF: {error}") from error
    if missing := [name for name in NEEDED if name not in trajectory.variables]:
        raise InputError(f"{path}: is not a trajectory of derjax: it has no {missing[0]!r}")
    return trajectory


def film(
    trajectory: xr.Dataset,
    *,
    fps: float = 20.0,
    speed: float = 1.0,
    begin: float | None = None,
    end: float | None = None,
    follow: bool = False,
) -> Film:
    """The film of a trajectory.

    Its frames are frames of the trajectory, at equal distances and at most `fps` a second.

    Args:
        trajectory: the data set that `trajectory.nc` holds.
        fps: frames per second of film.
        speed: seconds of simulation per second of film.
        begin: first time that is shown, s; None for the start of the trajectory.
        end: last time that is shown, s; None for its end.
        follow: whether the head, or the middle of the nodes, stays where it is.

    Raises:
        InputError: there are less than two frames to show, or they hold no numbers.
    """
    time = trajectory.time.to_numpy()
    chosen = _moments(time, fps, speed, begin, end)
    time = time[chosen]
    nodes = MM * trajectory.position.transpose("time", "node", "axis").to_numpy()[chosen]
    head = None
    if "head_position" in trajectory:
        head = MM * trajectory.head_position.transpose("time", "axis").to_numpy()[chosen]
    if not np.isfinite(nodes).all() or (head is not None and not np.isfinite(head).all()):
        raise InputError("there are positions that are not numbers")
    centre = None
    if follow:
        centre = nodes.mean(axis=1) if head is None else head
        nodes = nodes - centre[:, None]
        head = None if head is None else head - centre
    edges = np.stack([trajectory.edge_start.to_numpy(), trajectory.edge_end.to_numpy()], axis=1)
    lines, colours = _coloured_lines(edges, trajectory)
    extent = float(np.ptp(nodes[0], axis=0).max())
    rod_radius = float(MM * trajectory.attrs.get("rod_radius", 0.0)) or 0.01 * extent
    return Film(
        time=time,
        nodes=nodes,
        lines=lines,
        colours=colours,
        rod_radius=rod_radius,
        head=head,
        head_radius=float(MM * trajectory.attrs.get("head_radius", 0.0)) or 3.0 * rod_radius,
        centre=centre,
        frame_length=float(time[-1] - time[0]) / (len(time) - 1) / speed,
    )


def polylines(edges: np.ndarray) -> tuple[tuple[int, ...], ...]:
    """The unbranched paths of nodes that make up `edges` (e, 2), each edge in one of them.

    Paths end where an edge ends freely and where more than two meet; a ring ends where it began.
    """
    meeting: dict[int, list[int]] = {}
    for edge, pair in enumerate(edges):
        for node in pair:
            meeting.setdefault(int(node), []).append(edge)
    ends = [node for node, joined in meeting.items() if len(joined) != 2]
    left, paths = set(range(len(edges))), []
    for start in [*ends, *meeting]:  # what is left after the ends are rings
        for first in meeting[start]:
            path, edge = [start], first
            while edge in left:
                left.remove(edge)
                path.append(int(edges[edge].sum()) - path[-1])
                joined = meeting[path[-1]]
                if len(joined) == 2:
                    edge = joined[0] if joined[1] == edge else joined[1]
            if len(path) > 1:
                paths.append(tuple(path))
    return tuple(paths)


def tubes(film: Film, sides: int) -> Mesh:
    """Tubes with `sides` sides along the lines of a film."""
    vertices, faces, line = [], [], []
    first = 0
    for number, path in enumerate(film.lines):
        rings = _tube(film.nodes[:, list(path)], film.rod_radius, sides)
        count = rings.shape[1]
        vertices.append(rings.reshape(len(rings), count * sides, 3))
        faces.append(first + _quadrilaterals(count, sides))
        line += [number] * (count * sides)
        first += count * sides
    return Mesh(np.concatenate(vertices, axis=1), np.concatenate(faces), np.array(line))


def ball(rings: int, sides: int) -> tuple[np.ndarray, np.ndarray]:
    """A ball about the origin with radius 1: vertices (v, 3) and quadrilaterals (f, 4)."""
    down = np.linspace(0.0, np.pi, rings)[:, None]
    around = np.linspace(0.0, 2 * np.pi, sides, endpoint=False)
    ring = np.sin(down) * np.cos(around), np.sin(down) * np.sin(around), np.cos(down) + 0 * around
    return np.stack(ring, axis=-1).reshape(-1, 3), _quadrilaterals(rings, sides)


def write_gif(film: Film, path: Path, tick: Tick = lambda done: None) -> None:
    """Writes an animated GIF, which repeats for ever.

    Raises:
        OSError: it cannot be written.
    """
    picture = Picture(film)
    palette = _palette(film)

    def images() -> Iterator[Image.Image]:
        for frame in range(film.n_frames):
            image = picture.image(frame).quantize(palette=palette, dither=Image.Dither.NONE)
            tick(frame + 1)
            yield image

    # GIFs count hundredths of a second: rounding the moments, not the lengths, keeps the speed.
    moments = np.round(100 * film.frame_length * np.arange(film.n_frames + 1)).astype(int)
    lengths = [int(10 * length) for length in np.diff(moments)]
    with atomic_path(path) as temporary:
        frames = images()
        next(frames).save(temporary, save_all=True, append_images=frames, duration=lengths, loop=0)


def write_mp4(film: Film, path: Path, tick: Tick = lambda done: None) -> None:
    """Writes an MP4 file (H.264) with ffmpeg.

    Raises:
        InputError: there is no ffmpeg.
        OSError: it cannot be written.
    """
    picture = Picture(film)
    with atomic_path(path) as temporary, mpl.rc_context({"animation.ffmpeg_path": ffmpeg()}):
        writer = FFMpegWriter(fps=1.0 / film.frame_length, codec="h264")  # pyright: ignore[reportArgumentType]
        writer.setup(picture.figure, temporary, DPI)
        try:
            for frame in range(film.n_frames):
                picture.show(frame)
                writer.grab_frame()
                tick(frame + 1)
        except BaseException:
            with suppress(Exception):  # it ends ffmpeg, which may have got the Ctrl-C too
                writer.finish()
            raise
        try:
            writer.finish()
        except subprocess.CalledProcessError as error:
            said = str(error.stderr).strip().splitlines() or [str(error)]
            raise OSError(f"ffmpeg: {said[-1]}") from error


def ffmpeg() -> str:
    """The program ffmpeg: that on the path, else that of the package imageio-ffmpeg.

    Raises:
        InputError: there is neither.
    """
    if found := shutil.which(mpl.rcParams["animation.ffmpeg_path"]):
        return found
    try:
        from imageio_ffmpeg import get_ffmpeg_exe  # optional  # pyright: ignore[reportMissingImports]

        return get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise InputError(
            "MP4 files need ffmpeg: install it, or 'pip install imageio-ffmpeg', "
            "or leave mp4 out of --formats"
        ) from error


class Picture:
    """A figure that shows one frame of a film at a time, with axes that hold all of it."""

    def __init__(self, film: Film) -> None:
        self._film = film
        self._mesh = tubes(film, 8)
        self._ball, self._ball_faces = ball(13, 24)
        self._colours = np.array([to_rgb(colour) for colour in film.colours])
        self.figure = Figure(figsize=SIZE, dpi=DPI)
        self._canvas = FigureCanvasAgg(self.figure)
        ax = self.figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d", computed_zorder=False)
        assert isinstance(ax, Axes3D)
        _equal_axes(ax, film)
        self._label = self.figure.text(0.03, 0.93, "", fontsize=12)
        # The head is drawn first: rods that are inside of it stay visible.
        self._head = Poly3DCollection([], facecolor=HEAD, alpha=0.12, linewidth=0)
        self._rods = Poly3DCollection([], linewidth=0.4)
        for surface in (self._head, self._rods):
            ax.add_collection3d(surface, autolim=False)
            surface.set_clip_on(False)  # at the square that matplotlib makes of the axes

    def show(self, frame: int) -> None:
        """Shows a frame."""
        film, mesh = self._film, self._mesh
        corners = mesh.vertices[frame][mesh.faces]
        normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        light = np.clip(normals @ LIGHT / np.linalg.norm(LIGHT), 0.0, 1.0)
        colours = self._colours[mesh.line[mesh.faces[:, 0]]] * (0.6 + 0.4 * light[:, None])
        self._rods.set_verts(corners)
        self._rods.set_facecolor(colours)
        self._rods.set_edgecolor(colours)
        if film.head is not None:
            self._head.set_verts(film.head[frame] + film.head_radius * self._ball[self._ball_faces])
        self._label.set_text(film.label(frame))

    def image(self, frame: int) -> Image.Image:
        """A frame as an RGB image."""
        self.show(frame)
        self._canvas.draw()
        return Image.fromarray(np.asarray(self._canvas.buffer_rgba())).convert("RGB")


def _moments(
    time: np.ndarray, fps: float, speed: float, begin: float | None, end: float | None
) -> np.ndarray:
    """The numbers of the frames of a film; see `film`."""
    if len(time) < 2:
        raise InputError("there is one frame only, which makes no film")
    slack = 1e-9 * (time[-1] - time[0])
    begin, end = time[0] if begin is None else begin, time[-1] if end is None else end
    (inside,) = np.nonzero((time >= begin - slack) & (time <= end + slack))
    spacing = (time[-1] - time[0]) / (len(time) - 1)
    chosen = inside[:: max(1, math.ceil(speed / fps / spacing - 1e-9))]
    if len(chosen) < 2:
        raise InputError(
            f"there are less than two frames to show: the trajectory has one every {spacing:.4g} s "
            f"from {time[0]:g} to {time[-1]:g} s, the film would show t = {begin:g} to {end:g} s, "
            f"one every {max(spacing, speed / fps):.4g} s"
        )
    return chosen


def _coloured_lines(
    edges: np.ndarray, trajectory: xr.Dataset
) -> tuple[tuple[tuple[int, ...], ...], tuple[str, ...]]:
    """The lines to draw, and their colours: by filament, or else each line its own."""
    if "filament" not in trajectory.variables:
        lines = polylines(edges)
        return lines, tuple(PALETTE[i % len(PALETTE)] for i in range(len(lines)))
    lines, colours = [], []
    filament = trajectory.filament.to_numpy()
    for number in np.unique(filament):
        found = polylines(edges[filament == number])
        lines += found
        colours += [PALETTE[number % len(PALETTE)] if number >= 0 else NO_FILAMENT] * len(found)
    return tuple(lines), tuple(colours)


def _tube(path: np.ndarray, radius: float, sides: int) -> np.ndarray:
    """(t, rings, sides, 3): rings about a path (t, m, 3), mitred at its nodes, with round ends."""
    along = np.diff(path, axis=1)
    along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-30)
    turns = np.linspace(0.0, 2 * np.pi, sides, endpoint=False)[:, None]
    across = np.cross(along[:, 0], np.eye(3)[np.abs(along[:, 0]).argmin(axis=-1)])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    rings = []
    for i in range(path.shape[1]):
        before, after = along[:, max(i - 1, 0)], along[:, min(i, along.shape[1] - 1)]
        other = np.cross(before, across)
        circle = radius * (np.cos(turns) * across[:, None] + np.sin(turns) * other[:, None])
        both = before + after
        slope = _dot(circle, both[:, None]) / np.maximum(_dot(before, both), SLIDE)[:, None]
        rings.append(path[:, i, None] + circle - slope * before[:, None])
        # What is across `before` goes to what is across `after` without turning about them.
        across = across - both * _dot(across, after) / np.maximum(_dot(before, both), 1e-9)
        across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-30)
    return np.stack(
        [
            *_cap(path[:, 0], rings[0], -radius * along[:, 0])[::-1],
            *rings,
            *_cap(path[:, -1], rings[-1], radius * along[:, -1]),
        ],
        axis=1,
    )


def _cap(centre: np.ndarray, ring: np.ndarray, outwards: np.ndarray) -> list[np.ndarray]:
    """Two smaller rings beyond the last `ring` (t, sides, 3) of a tube, which close it."""
    centre, outwards = centre[:, None], outwards[:, None]
    return [centre + 0.8 * (ring - centre) + 0.6 * outwards, centre + outwards + 0 * ring]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.sum(a * b, axis=-1, keepdims=True)


def _quadrilaterals(rings: int, sides: int) -> np.ndarray:
    """(f, 4): the corners of the faces between rings of `sides` vertices each."""
    ring, side = np.meshgrid(np.arange(rings - 1), np.arange(sides), indexing="ij")
    ring, side, after = sides * ring.ravel(), side.ravel(), (side.ravel() + 1) % sides
    return np.stack([ring + side, ring + after, ring + sides + after, ring + sides + side], axis=1)


def _equal_axes(ax: Axes3D, film: Film) -> None:
    low, high = film.bounds()
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    ax.set_box_aspect(tuple(high - low), zoom=1.25)  # pyright: ignore[reportArgumentType]
    longest = (high - low).max()
    for axis, name, size in zip((ax.xaxis, ax.yaxis, ax.zaxis), "xyz", high - low, strict=True):
        axis.set_major_locator(MaxNLocator(max(2, round(7 * size / longest))))
        axis.set_pane_color((0.97,) * 4)  # pyright: ignore[reportAttributeAccessIssue]
        axis.set_label_text(film.axis_label(name))
    ax.view_init(elev=18, azim=-65)


def _palette(film: Film) -> Image.Image:
    """256 colours for all frames, lest they flicker: greys, shades of the rods, and tints.

    The tints, towards white, are for the edges of what is drawn.
    """
    colours = np.array([to_rgb(colour) for colour in dict.fromkeys(film.colours)])[:, None]
    count = 224 // len(colours)
    shade = np.linspace(0.6, 1.0, count - count // 3)[:, None]
    tint = np.linspace(0.1, 0.9, count // 3)[:, None]
    grey = np.tile(np.linspace(0.0, 1.0, 32)[:, None], 3)
    parts = [
        grey,
        (shade * colours).reshape(-1, 3),
        (colours + tint * (1 - colours)).reshape(-1, 3),
    ]
    image = Image.new("P", (1, 1))
    image.putpalette(np.round(255 * np.concatenate(parts)).astype(np.uint8).tobytes())
    return image
