"""Reading scene files."""

import tomllib
import warnings
from pathlib import Path
from typing import Any

from ..core.errors import InputError, InputWarning
from ..io.textfile import LEGACY, encoding_of, read_text
from .effects import idle_keys
from .file import SceneFile
from .messages import check
from .motortable import read_motor_table


def load_scene(path: str | Path) -> SceneFile:
    """Read and check a scene file.

    Warns with an `InputWarning` for every key that has no effect (see `effects`).

    Raises:
        InputError: the file is missing, is not TOML, or has an unknown key or a value that
            cannot be; the message names file and key.
    """
    path = Path(path)
    content = read_toml(path)
    scene = with_motor_table(check(SceneFile, content, path), path)
    for sentence in idle_keys(scene, content).values():
        warnings.warn(f"{path}: {sentence}", InputWarning, stacklevel=2)
    return scene


def with_motor_table(scene: SceneFile, path: Path) -> SceneFile:
    """The scene with the motor table that it names, if it does; `path` is that of its file.

    Raises:
        InputError: the table cannot be read or does not fit the scene.
    """
    if scene.motor.table is None:
        return scene
    try:
        table = read_motor_table(
            path.parent / scene.motor.table, scene.motor, scene.time.end, scene.robot.count
        )
    except InputError as error:
        raise InputError(f"{path}: [motor] table: {error}") from None
    scene = scene.model_copy(update={"motor_table": table})
    try:
        scene.check_motion()
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    return scene


def read_toml(path: Path) -> dict[str, Any]:
    """The contents of a TOML file; `InputError` if there is none."""
    if encoding_of(path) in LEGACY:
        raise InputError(f"{path}: cannot be read: it is not UTF-8; save it in that encoding")
    text = read_text(path)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        end = f"at end of document, line {text.count(chr(10)) + 1}"
        said = str(error).replace("at end of document", end)
        raise InputError(f"{path}: not valid TOML: {said}") from None
