"""Films of a trajectory as GIF and MP4 files; `viewer` shows the same in a browser."""

import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import matplotlib as mpl
import numpy as np
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
from .film import HEAD, Film
from .surfaces import ball, tubes

SIZE, DPI = (8.0, 4.8), 100
LIGHT = np.array([0.25, -0.75, 0.6])

Tick = Callable[[int], None]
"""Is told how many frames are done."""


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
