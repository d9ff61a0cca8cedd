"""`derjax render`: from a trajectory to films."""

import argparse
import math
from pathlib import Path

from ..core.errors import InputError
from ..io.output import output_directory

HELP = "make a film of a run: GIF, MP4, and a page to turn, zoom and play"

FORMATS = ("gif", "html", "mp4")
TRAJECTORY = "trajectory.nc"


def configure(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `derjax render`."""
    parser.add_argument(
        "directory", type=Path, metavar="DIR", help="where 'derjax simulate' put its results"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="PATH", help="directory of the films (default: DIR)"
    )
    parser.add_argument(
        "--formats",
        nargs="+",
        choices=FORMATS,
        default=["gif", "html"],
        help="what to make (default: gif html); mp4 needs ffmpeg",
    )
    parser.add_argument(
        "--fps",
        type=float,
        default=20.0,
        help="frames per second of film, at most: there are no more than the trajectory has "
        "(default: 20)",
    )
    parser.add_argument(
        "--speed",
        type=float,
        default=1.0,
        metavar="S",
        help="simulated seconds per second of film (default: 1)",
    )
    parser.add_argument(
        "--from", dest="begin", type=float, metavar="T", help="first time to show, s"
    )
    parser.add_argument("--to", dest="end", type=float, metavar="T", help="last time to show, s")
    parser.add_argument("--follow", action="store_true", help="let the camera follow the head")
    parser.add_argument("--overwrite", action="store_true", help="replace the films that are there")
    parser.add_argument("--quiet", action="store_true", help="print errors only")


def run(args: argparse.Namespace) -> int:
    """Runs `derjax render`.

    Raises:
        InputError: arguments or trajectory are wrong, or a film must not be overwritten;
            nothing has been written.
    """
    from ..results import animation  # slow to import
    from ..results.film import MOST_FPS, film_of, read
    from ..runs.progress import Progress

    source: Path = args.directory
    output: Path = source if args.output is None else args.output
    paths = {name: output / f"animation.{name}" for name in dict.fromkeys(args.formats)}
    _check_numbers(args, MOST_FPS)
    if not source.is_dir():
        raise InputError(f"{source}: no such directory")
    _check_output(paths, args.overwrite)
    trajectory = read(source / TRAJECTORY)
    try:
        film = film_of(
            trajectory,
            fps=args.fps,
            speed=args.speed,
            begin=args.begin,
            end=args.end,
            follow=args.follow,
        )
    except InputError as error:
        raise InputError(f"{source / TRAJECTORY}: {error}") from error
    if "mp4" in paths:
        animation.ffmpeg()  # or say now that there is none

    with output_directory(output, exclusive=False) as directory:
        for name, path in paths.items():
            with (
                directory.replacing(path.name) as temporary,
                Progress(film.n_frames, "frames", quiet=args.quiet or name == "html") as progress,
            ):
                if name == "html":
                    from ..results.viewer import write_html  # slow to import

                    write_html(film, temporary)
                else:
                    write = animation.write_gif if name == "gif" else animation.write_mp4
                    write(film, temporary, progress.update)
            if not args.quiet:
                length = film.n_frames * film.frame_length
                size = path.stat().st_size / 1e6
                print(f"{path}: {film.n_frames} frames, {length:.3g} s, {size:.1f} MB", flush=True)
    return 0


def _check_numbers(args: argparse.Namespace, most_fps: float) -> None:
    """`InputError` for an option whose value cannot be right."""
    if not 0 < args.fps <= most_fps:
        raise InputError(f"--fps {args.fps:g}: must be more than 0 and at most {most_fps:g}")
    if not (args.speed > 0 and math.isfinite(args.speed)):
        raise InputError(f"--speed {args.speed:g}: must be more than 0")
    for option, value in (("--from", args.begin), ("--to", args.end)):
        if value is not None and not math.isfinite(value):
            raise InputError(f"{option} {value:g}: must be a time in s")
    if args.begin is not None and args.end is not None and args.begin >= args.end:
        raise InputError(f"--from {args.begin:g}: must be before --to {args.end:g}")


def _check_output(paths: dict[str, Path], overwrite: bool) -> None:
    """`InputError` if there are films that must not be replaced."""
    for path in paths.values():
        if path.exists() and not overwrite:
            raise InputError(f"{path}: exists already: choose another --output, or --overwrite")
