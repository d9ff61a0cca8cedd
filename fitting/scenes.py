"""The scenes that measurements are compared with."""

from pathlib import Path

from derjax import InputError, SceneFile, load_scene


def scene_with_rates(path: Path) -> SceneFile:
    """The scene of a track or of speeds, whose motors turn at rates that are known.

    Raises:
        InputError: the file is missing or malformed, or its motors are given by a torque.
    """
    scene = load_scene(path)
    if scene.motor.stall_torque is not None:
        raise InputError(
            f"{path}: [motor] stall_torque: fits need motors of given rates (rpm, or a table)"
        )
    return scene
