"""A whole run from scene file to results, as the command `derjax simulate` does it."""

import dataclasses
import datetime
import shlex
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..core.errors import InputError
from ..core.status import SolverError, Status
from ..integrate.step import Scene, enlarge
from ..io.output import Output, output_directory
from ..io.textfile import read_text
from ..scenes.build import build
from ..scenes.file import SceneFile
from ..scenes.groups import nondimensional
from ..scenes.load import load_scene
from .progress import Progress, interruptible
from .recording import (
    Advance,
    Recording,
    compile_frame,
    load_checkpoint,
    new_recording,
    record,
    save_checkpoint,
)

TRAJECTORY = "trajectory.nc"
SUMMARY = "summary.json"
CHECKPOINT = "checkpoint.npz"
FIGURES = {f"{name}.png": name for name in ("track", "shape", "speed", "bundle")}
"""Files of figures, and the functions of `plots` that draw them."""

SECONDS_TO_FIRST_SAVE, SECONDS_BETWEEN_SAVES = 5.0, 30.0
DONE, INTERRUPTED = 0, 130


@dataclasses.dataclass(frozen=True)
class Options:
    """What the user asked for.

    Attributes:
        scene: scene file.
        output: directory of the results.
        resume: continue the unfinished run that is there.
        overwrite: replace what is there.
        figures: draw them.
        quiet: print errors only.
        nondimensional: add the numbers without units to the summary.
    """

    scene: Path
    output: Path
    resume: bool = False
    overwrite: bool = False
    figures: bool = True
    quiet: bool = False
    nondimensional: bool = False

    def command(self, *extra: str) -> str:
        """The command line of these options, without those on existing results."""
        words = ["derjax", "simulate", str(self.scene), "-o", str(self.output), *extra]
        words += ["--no-figures"] * (not self.figures) + ["--quiet"] * self.quiet
        words += ["--nondimensional"] * self.nondimensional
        return shlex.join(words)


def simulate(options: Options) -> int:
    """Runs a scene file and writes trajectory, summary and figures.

    Ctrl-C stops after the current frame and leaves a checkpoint to resume from; there also is
    one after a few seconds and then every half a minute. If the disk is full, the run goes on
    all the same.

    Returns:
        The exit code: 0 done, 130 interrupted.

    Raises:
        InputError: the scene file is wrong, the directory cannot be written to, another program
            writes there, or there are results that must not be overwritten; nothing has been
            written. Or results could not be written at the end; the message says where what was
            computed is kept.
        SolverError: a step failed; what was computed up to then has been written.
    """
    file = load_scene(options.scene)
    sources = _sources(options.scene, file)
    with output_directory(options.output) as output:
        _check_output(options)
        return _simulate(options, file, sources, output)


def _simulate(options: Options, file: SceneFile, sources: dict[str, str], output: Output) -> int:
    """`simulate`, with the contents of all files, in a directory that can be written to."""
    try:
        scene = build(file)
        start = scene.start
    except InputError as error:
        raise InputError(f"{options.scene}: {error}") from None
    checkpoint = options.output / CHECKPOINT
    recording = load_checkpoint(file, checkpoint) if options.resume else new_recording(start)
    if not options.quiet:
        print(f"compiling {options.scene} ...", file=sys.stderr, flush=True)
    advance = compile_frame(scene, recording, file.steps_per_frame)

    def with_more_contacts() -> Advance:
        nonlocal scene
        scene = enlarge(scene)
        return compile_frame(scene, recording, file.steps_per_frame)

    interrupted = False
    keeper = _Keeper(file, output)
    frame = file.steps_per_frame * file.step
    with (
        interruptible("stopping after this frame; Ctrl-C again quits without saving") as stopping,
        Progress(
            file.time.end, "simulated s", frame * recording.n_frames, options.quiet
        ) as progress,
    ):
        for _ in record(advance, recording, file.n_frames, with_more_contacts):
            _import_writers()
            progress.update(frame * recording.n_frames)
            if stopping():
                interrupted = recording.report.ok and recording.n_frames < file.n_frames
                break
            keeper.save_now_and_then(recording)

    kept = keeper.save(recording)  # lest writing the results should fail
    if interrupted:
        kept = kept or keeper.rescue(recording)
    outcome = _outcome(recording, _advice(options, kept) if interrupted else None)
    try:
        summary = _write_results(options, file, scene, recording, sources | outcome, output)
    except (InputError, OSError) as error:
        kept = kept or keeper.rescue(recording)
        raise InputError(f"{error}. {_advice(options, kept)}") from error
    if interrupted:
        reached = f"t = {summary['time_s']:g} of {file.time.end:g} s"
        print(f"derjax: at {reached}: interrupted. {_advice(options, kept)}", file=sys.stderr)
        return INTERRUPTED
    output.remove(CHECKPOINT)
    if not recording.report.ok:
        until = f"What was computed until then is in {options.output}"
        raise SolverError(f"{options.scene}: {outcome['message']} {until}")
    if not options.quiet:
        print(_digest(summary, options.output))
    return DONE


class _Keeper:
    """Saves checkpoints of a run, which goes on if they cannot be written."""

    def __init__(self, file: SceneFile, output: Output) -> None:
        self._file, self._output = file, output
        self._due = time.monotonic() + min(SECONDS_TO_FIRST_SAVE, SECONDS_BETWEEN_SAVES)
        self._warned = False

    def save_now_and_then(self, recording: Recording) -> None:
        """Saves a checkpoint if the last one was long ago."""
        if time.monotonic() > self._due:
            self.save(recording)
            self._due = time.monotonic() + SECONDS_BETWEEN_SAVES

    def save(self, recording: Recording) -> Path | None:
        """Saves a checkpoint; returns its path, or None, with a warning, if that failed."""
        try:
            with self._output.replacing(CHECKPOINT) as temporary:
                save_checkpoint(recording, self._file, temporary)
            return self._output.path / CHECKPOINT
        except (InputError, OSError) as error:
            if not self._warned:
                print(f"derjax: warning: {error}; the run goes on", file=sys.stderr, flush=True)
            self._warned = True
            return None

    def rescue(self, recording: Recording) -> Path | None:
        """Saves a checkpoint among the machine's temporary files; None if that failed."""
        try:
            path = Path(tempfile.mkdtemp(prefix="derjax-")) / CHECKPOINT
            save_checkpoint(recording, self._file, path)
            return path
        except OSError:
            return None


def _sources(path: Path, file: SceneFile) -> dict[str, str]:
    """The text of the input files, for the record."""
    sources = {"scene": read_text(path)}
    if file.motor.table is not None:
        sources["motor_table"] = read_text(path.parent / file.motor.table)
    return sources


def _check_output(options: Options) -> None:
    """`InputError` if there are results and the options do not say what to do with them."""
    directory = options.output
    unfinished = directory / CHECKPOINT
    if options.resume:
        ended = directory / TRAJECTORY
        if ended.exists() and not unfinished.exists():
            raise InputError(f"{ended}: this run has ended: there is nothing to resume")
    elif not options.overwrite:
        if unfinished.exists():
            hint = "--resume continues it, --overwrite starts anew"
            raise InputError(f"{unfinished}: here is an unfinished run: {hint}")
        for path in (directory / name for name in (TRAJECTORY, SUMMARY, *FIGURES)):
            if path.exists():
                hint = "choose another directory, or --overwrite"
                raise InputError(f"{path}: exists already: {hint}")


def _advice(options: Options, kept: Path | None) -> str:
    """How to go on with a run whose checkpoint is at `kept`, if it could be written."""
    if kept is None:
        return "There is no room for a checkpoint: what was computed last is lost"
    there = dataclasses.replace(options, output=kept.parent)
    return f"What was computed is in {kept}; resume with: {there.command('--resume')}"


def _outcome(recording: Recording, advice: str | None) -> dict[str, str]:
    """How the run ended: a word and a sentence. `advice`: how to go on, if interrupted."""
    if advice is not None:
        return {"status": "interrupted", "message": f"interrupted. {advice}"}
    status = Status(int(recording.report.status)).name.lower()
    return {"status": status, "message": recording.report.message()}


def _import_writers() -> None:
    """Imports what writes results: after the first step, as it is slow, and long before the end."""
    from ..results import dataset, summary  # noqa: F401


def _write_results(
    options: Options,
    file: SceneFile,
    scene: Scene,
    recording: Recording,
    texts: dict[str, str],
    output: Output,
) -> dict[str, Any]:
    """Writes trajectory, summary and figures; returns the summary."""
    from ..results import dataset as trajectory
    from ..results import summary as summaries

    attributes = {
        "title": "Swimming of a soft flagellated robot, computed by derjax",
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": options.command(),
        **texts,
    }
    dataset = trajectory.to_dataset(scene, recording.stacked, attributes)
    report = recording.report
    summary = {
        "status": texts["status"],
        "message": texts["message"],
        "time_s": float(dataset.time[-1]),
        **summaries.summarise(dataset),
        "steps": int(report.steps),
        "rejected_steps": int(report.rejected),
        "newton_iterations": int(report.iterations),
        "newton_matrices": int(report.factorings),
        "worst_residual": float(report.residual),
        "wall_time_s": recording.wall_time,
        "compile_time_s": recording.compile_time,
        "derjax_version": version("derjax"),
        "jax_version": jax.__version__,
        "scene": str(options.scene),
        "parameters": {name: np.asarray(value) for name, value in scene.parameters.items()},
    }
    if options.nondimensional:
        summary["nondimensional"] = nondimensional(file, summary)
    output.check([TRAJECTORY, SUMMARY, *(FIGURES if options.figures else ())])
    with output.replacing(TRAJECTORY) as temporary:
        trajectory.write(dataset, temporary)
    with output.replacing(SUMMARY) as temporary:
        summaries.write(summary, temporary)
    if options.figures:
        from ..results import plots  # slow to import

        for name, drawn in FIGURES.items():
            figure = getattr(plots, drawn)(dataset)
            if figure is not None:
                with output.replacing(name) as temporary:
                    figure.savefig(temporary)
    return summary


def _digest(summary: dict[str, Any], directory: Path) -> str:
    """What a user wants to see at the end of a run."""
    lines = [
        f"{summary['time_s']:g} s simulated in {summary['wall_time_s']:.1f} s "
        f"(and {summary['compile_time_s']:.1f} s of compilation), {summary['steps']} steps"
    ]
    if summary["v_x_m_per_s"] is not None:
        lines.append(
            f"speed {1e3 * summary['v_x_m_per_s']:.4g} mm/s along x, "
            f"head {summary['head_rate_rad_per_s']:.4g} rad/s"
        )
    if "nondimensional" in summary:
        pairs = (f"{name} {value:.4g}" for name, value in summary["nondimensional"].items())
        lines.append("without units: " + ", ".join(pairs))
    return "\n".join([*lines, f"results in {directory}"])
