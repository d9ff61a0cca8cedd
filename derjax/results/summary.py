"""The few numbers that a run is remembered by.

They are taken over the *window*, the second half of the time computed, when the robot swims
steadily:

`v_x_m_per_s`
    Slope of a straight line fitted (least squares) to the x coordinate of the head node.
`head_rate_rad_per_s`
    Slope of a straight line fitted to the angle that the head has turned about its own axis,
    which points from the head to the flagella, along +x in a straight robot. Positive is
    right-handed about that axis. Reference frames are transported in time, so that this is
    the component of the head's angular velocity along its own axis.
`head_rate_lab_x_rad_per_s`
    Mean of the component of the head's angular velocity along the x axis of the laboratory,
    `(t x dt/dt + s t) . x` with t the head's axis and s its spin.
`tail_to_head_m`
    Mean distance from the head node to the last node.
`propulsive_force_N`
    `6 pi mu r_h C_t v_x`: the x component of the force with which the flagella push the head,
    opposite to the drag on the head; negative when the robot swims towards -x. The drag is that of
    the run, `head_drag` in the trajectory.
`efficiency`
    `eta = F r_h / T`, with F the magnitude of the propulsive force and
    `T = 8 pi mu r_h^3 C_r |head_rate|` the drag torque on the head, that is
    `(3/4) (C_t / C_r) |v_x| / (r_h |head_rate|)`.

Of robots with several flagella also

`propulsive_force_per_flagellum_N`
    The propulsive force divided by the number of flagella.
`minimum_distance_m`
    Smallest distance of the centre lines of two flagella, at any saved frame of the whole run.
`bundle_fraction`, `linking_number`
    Means of the part of the flagella that is bundled, and of how often they wind about each
    other; see `bundling`.
`phase_difference_rad`
    Mean direction of the angle by which the second flagellum has turned at its base beyond the
    first, within half a turn.

and, if rods are kept apart by the smooth contact,

`contact_count`, `contact_force_N`
    Means of the number of touching pairs of edges and of the sum of their normal forces.

What cannot be said is None: of a scene without a head, or with less than two frames in the
window; force and efficiency also of a head without drag, efficiency of a head at rest.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ..io.files import atomic_path

Numbers = dict[str, Any]

NAMES = (
    "v_x_m_per_s",
    "head_rate_rad_per_s",
    "head_rate_lab_x_rad_per_s",
    "tail_to_head_m",
    "propulsive_force_N",
    "efficiency",
)


def window(time: np.ndarray) -> np.ndarray:
    """Which times (s) belong to the second half of the run."""
    return time >= 0.5 * time[-1] * (1 - 1e-12)


def slope(time: np.ndarray, values: np.ndarray) -> float:
    """Slope of the straight line fitted to `values` by least squares."""
    centred = time - time.mean()
    return float(centred @ (values - values.mean()) / (centred @ centred))


def summarise(trajectory: xr.Dataset) -> Numbers:
    """The numbers defined above, of a trajectory made by `to_dataset`."""
    numbers: Numbers = dict.fromkeys(NAMES)
    time = trajectory.time.to_numpy()
    chosen = window(time)
    numbers["window_s"] = [float(time[chosen][0]), float(time[-1])]
    numbers |= _bundle(trajectory, trajectory.isel(time=chosen))
    if "head_position" not in trajectory or chosen.sum() < 2:
        return numbers
    part = trajectory.isel(time=chosen)
    speed = slope(time[chosen], part.head_position.sel(axis="x").to_numpy())
    rate = slope(time[chosen], part.head_angle.to_numpy())
    reach = part.position.isel(node=-1) - part.head_position
    numbers |= {
        "v_x_m_per_s": speed,
        "head_rate_rad_per_s": rate,
        "head_rate_lab_x_rad_per_s": float(part.head_angular_velocity.sel(axis="x").mean()),
        "tail_to_head_m": float(np.linalg.norm(reach, axis=-1).mean()),
    }
    if "head_drag" not in trajectory:
        return numbers
    force = float(trajectory.head_drag) * speed
    torque = float(trajectory.head_spin_drag) * abs(rate)
    numbers["propulsive_force_N"] = force
    if (count := _flagella(trajectory)) > 1:
        numbers["propulsive_force_per_flagellum_N"] = force / count
    efficiency = abs(force) * float(trajectory.head_drag_radius) / torque if torque > 0 else None
    numbers["efficiency"] = efficiency
    return numbers


def _flagella(trajectory: xr.Dataset) -> int:
    """How many flagella a robot has."""
    return int(trajectory.filament.max()) + 1


def _bundle(whole: xr.Dataset, part: xr.Dataset) -> Numbers:
    """How close the flagella are, over all of a trajectory and over its window."""
    numbers: Numbers = {}
    if "bundle_fraction" in whole:
        phase = part.flagellum_phase.to_numpy()
        difference = np.exp(1j * (phase[:, 1] - phase[:, 0])).mean()
        numbers |= {
            "minimum_distance_m": float(whole.minimum_distance.min()),
            "bundle_fraction": float(part.bundle_fraction.mean()),
            "linking_number": float(part.linking_number.mean()),
            "phase_difference_rad": float(np.angle(difference)),
        }
    if "contact_count" in whole:
        numbers |= {
            "contact_count": float(part.contact_count.mean()),
            "contact_force_N": float(part.contact_force.mean()),
        }
    return numbers


def write(summary: Numbers, path: str | Path) -> None:
    """Writes JSON, replacing an older file in one go; what is not finite becomes null."""
    with atomic_path(path) as temporary:
        text = json.dumps({k: _plain(v) for k, v in summary.items()}, indent=2, allow_nan=False)
        temporary.write_text(text + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
