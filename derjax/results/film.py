"""What is to be seen of a trajectory at which moment.

The picture is made of the edges alone, whatever the robot: a line along every unbranched path of
edges, and a ball for the head if there is one. `animation` and `viewer` show it.
"""

import dataclasses
import math
from pathlib import Path

import numpy as np
import xarray as xr

from ..core.errors import InputError

MM = 1e3
PALETTE = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#B8A800")
"""Colours of the filaments, after Okabe and Ito: told apart by colour-blind readers too."""
NO_FILAMENT, HEAD = "#555555", "#8a8a8a"

NEEDED = ("time", "position", "edge_start", "edge_end")
MOST_FPS = 50.0
"""Players show a GIF slowly whose frames last less than 0.02 s."""


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


def film_of(
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


def _moments(
    time: np.ndarray, fps: float, speed: float, begin: float | None, end: float | None
) -> np.ndarray:
    """The numbers of the frames of a film; see `film_of`."""
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
