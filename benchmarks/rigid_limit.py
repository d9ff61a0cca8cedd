"""What the robot would do if its flagellum were rigid: the limit of slow or stiff robots.

Two predictions from derjax's own drag matrices, for the robot of Lim, Yadunandan & Jawed
(Soft Matter 19, 2254, 2023) with one flagellum:

- *axial*: the helix alone, held on its axis, balanced against the drag of the head;
- *free*: the whole flagellum as the simulator has it (with its shaft and the edge that leads
  from there to the helix), free to wobble. In the frame of the flagellum the motion is
  steady: a screw, along whose axis the robot advances.

    python -m benchmarks.rigid_limit [-o docs/figures]
"""

from functools import partial
from typing import NamedTuple

import jax
import numpy as np
import pandas as pd
from jaxtyping import Array, Float

from benchmarks.rigid import propulsion, rigid_resistance, stokeslet_resistance
from derjax import SceneFile
from derjax.shapes import edge_count, helix, helix_contour, single_flagellum

from .command import command_line

BLOBS = {"1.67e-4 m": 1.67e-4, "1.02 r0": 1.02 * 1.6e-3, "sqrt(e) r0": np.sqrt(np.e) * 1.6e-3}
PITCHES = (5, 7, 9)
RPM = 50.0


class Motion(NamedTuple):
    """Speed of advance (m/s) and turning rate of the head over that of the motor."""

    speed: float
    spin_ratio: float


def head_drag(scene: SceneFile) -> tuple[float, float]:
    """Force per velocity (N s/m) and torque per rate of rotation (N m s) of the head."""
    size, viscosity = scene.robot.head_radius, scene.fluid.viscosity
    return (
        6 * np.pi * viscosity * size * scene.head.C_t,
        8 * np.pi * viscosity * size**3 * scene.head.C_r,
    )


def flagellum_edges(scene: SceneFile) -> int:
    """Edges of the helix in the scene's robot."""
    robot = scene.robot
    return edge_count(robot.helix_radius, robot.pitch, robot.axial_length, robot.edge_length)


@partial(jax.jit, static_argnames=("n_edges", "handedness", "whole"))
def flagellum_resistance(
    radius: Array,
    pitch: Array,
    length: Array,
    viscosity: Array,
    regularization: Array,
    n_edges: int,
    handedness: str,
    whole: bool,
) -> Float[Array, "6 6"]:
    """Resistance of the helix alone, or of all of the flagellum; about the head node."""
    if whole:
        filament = helix(radius, pitch, length, n_edges, handedness)
        body = single_flagellum(filament, helix_contour(radius, pitch, length) / n_edges)
        nodes = body.nodes[np.array(body.topology.filaments[0])] - body.nodes[0]
    else:
        nodes = helix(radius, pitch, length, n_edges, handedness)
    return rigid_resistance(nodes, stokeslet_resistance(nodes, viscosity, regularization))


def resistance(scene: SceneFile, whole: bool) -> np.ndarray:
    """`flagellum_resistance` of the robot of a scene."""
    robot, fluid = scene.robot, scene.fluid
    shape = (robot.helix_radius, robot.pitch, robot.axial_length)
    return np.asarray(
        flagellum_resistance(
            *shape,
            fluid.viscosity,
            scene.regularization,
            n_edges=flagellum_edges(scene),
            handedness=robot.handedness,
            whole=whole,
        )
    )


def axial_motion(scene: SceneFile) -> Motion:
    """Balance of axial forces and torques between the helix alone and the head."""
    matrix = resistance(scene, whole=False)[np.ix_([0, 3], [0, 3])]
    translation, spin = head_drag(scene)
    motor = scene.motor.rates[0] * 2 * np.pi / 60
    # unknown: velocity, and rate of the flagellum; the head turns slower by the motor's rate
    total = matrix + np.diag([translation, spin])
    velocity, rate = np.linalg.solve(total, [0.0, spin * motor])
    return Motion(abs(velocity), abs(rate - motor) / motor)


def free_motion(scene: SceneFile) -> Motion:
    """Balance of all forces and torques between the whole flagellum and the head."""
    translation, spin = head_drag(scene)
    motor = scene.motor.rates[0] * 2 * np.pi / 60
    total = resistance(scene, whole=True) + np.diag([translation] * 3 + [spin, 0.0, 0.0])
    load = np.array([0.0, 0.0, 0.0, spin * motor, 0.0, 0.0])
    velocity, rate = np.split(np.linalg.solve(total, load), 2)
    advance = abs(velocity @ rate) / np.linalg.norm(rate)
    return Motion(advance, abs(rate[0] - motor) / motor)


def robot(pitch_over_radius: float, regularization: float) -> SceneFile:
    """The paper's robot; its pitches are 5, 7 and 9 times 6.36 mm, with a radius of 6.4 mm."""
    return SceneFile.model_validate(
        {
            "robot": {"pitch": pitch_over_radius * 6.36e-3},
            "fluid": {"regularization": regularization},
            "motor": {"rpm": RPM},
        }
    )


def rows() -> pd.DataFrame:
    """One row for each regularization and pitch."""
    found = []
    for blob, regularization in BLOBS.items():
        for ratio in PITCHES:
            scene = robot(ratio, regularization)
            radius = scene.robot.helix_radius
            units = {"thrust": radius**2, "torque": radius**3, "drag": radius}
            alone = propulsion(resistance(scene, whole=False))
            axial, free = axial_motion(scene), free_motion(scene)
            found.append(
                {
                    "eps": blob,
                    "pitch/r": ratio,
                    **{k: alone[k] / scene.fluid.viscosity / units[k] for k in units},
                    "axial spin ratio": axial.spin_ratio,
                    "axial speed, mm/s": 1e3 * axial.speed,
                    "free spin ratio": free.spin_ratio,
                    "free speed, mm/s": 1e3 * free.speed,
                }
            )
    return pd.DataFrame(found)


def markdown(table: pd.DataFrame) -> str:
    """`table` in Markdown, numbers with three digits."""

    def cell(value) -> str:
        return value if isinstance(value, str) else f"{value:.3g}"

    lines = [table.columns.tolist(), ["---"] * table.shape[1]]
    lines += [[cell(v) for v in row] for row in table.itertuples(index=False)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def main() -> None:
    options = command_line(__doc__).parse_args()
    table = rows()
    table.to_csv(options.output / "rigid_limit.csv", index=False, float_format="%.6g")
    text = markdown(table)
    (options.output / "rigid_limit.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
