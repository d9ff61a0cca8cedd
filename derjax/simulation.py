"""A whole run from scene file to results, as the command `derjax simulate` does it."""

import dataclasses
import datetime
import shlex
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from . import summary as summaries
from . import trajectory
from .files import atomic_path
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
from .scene import build, enlarge
from .scenefile import InputError, SceneFile, load_scene
from .status import SolverError, Status
from .step import Scene

TRAJECTORY = "trajectory.nc"
SUMMARY = "summary.json"
CHECKPOINT = "checkpoint.npz"
FIGURES = {f"{name}.png": name for name in ("track", "shape", "speed", "bundle")}
"""Files of figures, and the functions of `plots` that draw them."""

SECONDS_BETWEEN_SAVES = 30.0
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
    """

    scene: Path
    output: Path
    resume: bool = False
    overwrite: bool = False
    figures: bool = True
    quiet: bool = False

    def command(self, *extra: str) -> str:
        """The command line of these options, without those on existing results."""
        words = ["derjax", "simulate", str(self.scene), "-o", str(self.output), *extra]
        words += ["--no-figures"] * (not self.figures) + ["--quiet"] * self.quiet
        return shlex.join(words)


def simulate(options: Options) -> int:
    """Runs a scene file and writes trajectory, summary and figures.

    Ctrl-C stops after the current frame and leaves a checkpoint to resume from; there also is
    a new checkpoint every half a minute.

    Returns:
        The exit code: 0 done, 130 interrupted.

    Raises:
        InputError: the scene file is wrong, or there are results that must not be overwritten;
            nothing has been written.
        SolverError: a step failed; what was computed up to then has been written.
    """
    file = load_scene(options.scene)
    sources = _sources(options.scene, file)
    _check_output(options)
    try:
        scene, start = build(file)
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

    options.output.mkdir(parents=True, exist_ok=True)

    interrupted, saved = False, time.monotonic()
    frame = file.steps_per_frame * file.step
    with (
        interruptible("stopping after this frame; Ctrl-C again quits without saving") as stopping,
        Progress(
            file.time.end, "simulated s", frame * recording.n_frames, options.quiet
        ) as progress,
    ):
        for _ in record(advance, recording, file.n_frames, with_more_contacts):
            progress.update(frame * recording.n_frames)
            if stopping():
                interrupted = recording.report.ok and recording.n_frames < file.n_frames
                break
            if time.monotonic() - saved > SECONDS_BETWEEN_SAVES:
                save_checkpoint(recording, file, checkpoint)
                saved = time.monotonic()

    save_checkpoint(recording, file, checkpoint)  # lest writing the results should fail
    outcome = _outcome(recording, options.command("--resume") if interrupted else None)
    summary = _write_results(options, file, scene, recording, sources | outcome)
    if interrupted:
        reached = f"t = {summary['time_s']:g} of {file.time.end:g} s"
        print(f"derjax: at {reached}: {outcome['message']}", file=sys.stderr)
        return INTERRUPTED
    checkpoint.unlink(missing_ok=True)
    if not recording.report.ok:
        kept = f"What was computed until then is in {options.output}"
        raise SolverError(f"{options.scene}: {outcome['message']} {kept}")
    if not options.quiet:
        print(_digest(summary, options.output))
    return DONE


def _sources(path: Path, file: SceneFile) -> dict[str, str]:
    """The text of the input files, for the record."""
    sources = {"scene": path.read_text(encoding="utf-8")}
    if file.motor.table is not None:
        sources["motor_table"] = (path.parent / file.motor.table).read_text(encoding="utf-8")
    return sources


def _check_output(options: Options) -> None:
    """`InputError` if there are results and the options do not say what to do with them."""
    directory = options.output
    if directory.exists() and not directory.is_dir():
        raise InputError(f"{directory}: is not a directory (--output)")
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


def _outcome(recording: Recording, resume: str | None) -> dict[str, str]:
    """How the run ended: a word and a sentence. `resume`: the command, if interrupted."""
    if resume is not None:
        return {"status": "interrupted", "message": f"interrupted; resume with: {resume}"}
    status = Status(int(recording.report.status)).name.lower()
    return {"status": status, "message": recording.report.message()}


def _write_results(
    options: Options, file: SceneFile, scene: Scene, recording: Recording, texts: dict[str, str]
) -> dict[str, Any]:
    """Writes trajectory, summary and figures; returns the summary."""
    attributes = {
        "title": "Swimming of a soft flagellated robot, computed by derjax",
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": options.command(),
        **texts,
    }
    dataset = trajectory.to_dataset(file, scene, recording.stacked, attributes)
    report = recording.report
    summary = {
        "status": texts["status"],
        "message": texts["message"],
        "time_s": float(dataset.time[-1]),
        **summaries.summarise(dataset, file),
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
        "parameters": file.parameters,
    }
    trajectory.write(dataset, options.output / TRAJECTORY)
    summaries.write(summary, options.output / SUMMARY)
    if options.figures:
        from . import plots  # slow to import

        for name, drawn in FIGURES.items():
            figure = getattr(plots, drawn)(dataset)
            if figure is not None:
                with atomic_path(options.output / name) as temporary:
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
    return "\n".join([*lines, f"results in {directory}"])
