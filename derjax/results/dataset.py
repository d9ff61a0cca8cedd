"""A trajectory as a labelled data set, which other programs can open.

    import xarray
    trajectory = xarray.open_dataset("out/trajectory.nc")
    trajectory.head_position.sel(axis="x").plot()

All quantities are in SI units and every one says so in its attributes. The file also holds
the scene file that it comes from, with the numbers of the run, so that it can be computed again.
"""

import json
import math
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray as xr
from jaxtyping import Array

from ..core.programs import stored
from ..integrate.provenance import changed
from ..integrate.step import Scene
from ..io.files import atomic_path, make_room
from ..rods import head as kinematics
from ..rods.kinematics import angles, positions
from ..rods.rod import State
from ..rods.topology import Topology
from ..scenes.extensions import unit_of
from ..scenes.file import SceneFile
from ..terms.contact.repulsion import Contact
from ..terms.fluid.head import HeadDrag
from ..terms.motor import TorqueMotor
from . import bundling
from .mechanics import motor_angles, motor_rates

HDF5_OVERHEAD, HDF5_HEADERS = 1.05, 1 << 17
"""How much larger a file is than its numbers, and its bytes besides them."""

DIGITS_OF_TIME = 10
"""To which times are rounded, counted from the first digit of the end of the run: adding up
thousands of steps leaves 30.000000000002 s."""


def to_dataset(
    scene: Scene,
    states: State,
    attributes: Mapping[str, Any] | None = None,
    file: SceneFile | None = None,
) -> xr.Dataset:
    """A trajectory, labelled.

    Numbers are those of the scene, which may have been built of others than the file has. If some
    of its terms are not as they were built, the attribute `changed_terms` names them.

    Args:
        scene: what was run; its parameters become attributes.
        states: the states, with a leading axis of time on every leaf, as `roll_frames` returns.
        attributes: more attributes of the data set, of text and numbers.
        file: the scene file, for scenes that do not know theirs, as those of a batch; its choices
            become an attribute.

    Returns:
        A data set with the dimensions time, node, axis, edge and motor.
    """
    states = jax.tree.map(np.asarray, states)
    topology = scene.rod.topology
    nodes = np.asarray(positions(topology, states.q))
    variables = {
        "position": _variable("time node axis", nodes, "m", "position of the nodes"),
        "velocity": _variable(
            "time node axis",
            positions(topology, states.velocity),
            "m/s",
            "velocity of the nodes, over the step that ends at this time",
        ),
        "edge_angle": _variable(
            "time edge",
            angles(topology, states.q) + 2 * np.pi * states.turns,
            "rad",
            "angle that the edge has turned about itself since the start, whole turns included",
        ),
        **_motor(scene, states),
        **_head(topology, states),
        **_head_drag(scene),
        **_bundle(scene, nodes),
    }
    start, end = topology.edge_nodes.T
    coordinates = {
        "time": _variable("time", rounded(states.time), "s", "time"),
        "node": _variable("node", np.arange(topology.n_nodes), "1", "number of the node"),
        "axis": ("axis", ["x", "y", "z"], {"long_name": "axis of the laboratory frame"}),
        "edge": _variable("edge", np.arange(topology.n_edges), "1", "number of the edge"),
        "edge_start": _variable("edge", start, "1", "node at which the edge starts"),
        "edge_end": _variable("edge", end, "1", "node at which the edge ends"),
        "filament": _variable(
            "edge",
            topology.edge_filaments,
            "1",
            "number of the flagellum that the edge belongs to, -1 for the head",
        ),
    }
    return xr.Dataset(variables, coordinates, _attributes(scene, file) | dict(attributes or {}))


def rounded(time: Any) -> np.ndarray:
    """Times (s) of a run without what adding up steps leaves."""
    time = np.asarray(time)
    end = float(np.max(np.abs(time)))
    if not (end > 0 and np.isfinite(end)):
        return time
    digits = DIGITS_OF_TIME - 1 - math.floor(math.log10(end))
    # In decimals, as the nearest number to what is written is wanted.
    return np.array([float(f"{t:.{digits}f}") if digits > 0 else round(t, digits) for t in time])


def write(dataset: xr.Dataset, path: str | Path) -> None:
    """Writes a NetCDF4 file, replacing an older one in one go."""
    encoding = {name: {"_FillValue": None} for name in dataset.variables}
    with atomic_path(path) as temporary:
        texts = sum(len(str(value)) for value in dataset.attrs.values())
        make_room(temporary, int(HDF5_OVERHEAD * (dataset.nbytes + texts)) + HDF5_HEADERS)
        dataset.to_netcdf(temporary, engine="h5netcdf", encoding=encoding)


def _variable(dims: str, values: Any, units: str, long_name: str) -> tuple[Any, ...]:
    return dims.split(), np.asarray(values), {"units": units, "long_name": long_name}


def _motor(scene: Scene, states: State) -> dict[str, tuple[Any, ...]]:
    """How the motors have turned: as they were told, or as far as their torque went."""
    if scene.motor is None:
        return {}
    angle, rate, torque = _motion_of_motor(scene, states)
    variables = {
        "motor_angle": _variable("time motor", angle, "rad", "angle that the motor has turned"),
        "motor_rate": _variable("time motor", rate, "rad/s", "rate of the motor"),
    }
    if torque is not None:
        what = "torque of the motor on its flagellum, against the head"
        variables["motor_torque"] = _variable("time motor", torque, "N m", what)
    return variables


@stored
def _motion_of_motor(scene: Scene, states: State) -> tuple[Array, Array, Array | None]:
    angle, rate = motor_angles(scene, states), motor_rates(scene, states)
    motor = scene.motor
    return angle, rate, motor.torque(angle, rate) if isinstance(motor, TorqueMotor) else None


def _head(topology: Topology, states: State) -> dict[str, tuple[Any, ...]]:
    """How the head moves; see `kinematics`."""
    if topology.head is None:
        return {}
    moves = _motion_of_head(topology, states)
    return {
        "head_position": _variable("time axis", moves["position"], "m", "position of the head"),
        "head_velocity": _variable("time axis", moves["velocity"], "m/s", "velocity of the head"),
        "head_axis": _variable(
            "time axis",
            moves["axis"],
            "1",
            "direction of the head, towards the flagella",
        ),
        "head_angle": _variable(
            "time",
            moves["angle"],
            "rad",
            "angle that the head has turned about its own axis",
        ),
        "head_spin": _variable(
            "time",
            moves["spin"],
            "rad/s",
            "spin of the head about its own axis",
        ),
        "head_angular_velocity": _variable(
            "time axis",
            moves["angular_velocity"],
            "rad/s",
            "angular velocity of the head",
        ),
    }


@partial(stored, static=(0,))  # as one program: quicker than operation by operation
def _motion_of_head(topology: Topology, states: State) -> dict[str, Array]:
    head = kinematics.head_of(topology)
    return {
        "position": kinematics.head_position(topology, states),
        "velocity": positions(topology, states.velocity)[:, head.node],
        "axis": kinematics.head_axis(topology, states),
        "angle": kinematics.head_angle(topology, states),
        "spin": kinematics.head_spin(topology, states),
        "angular_velocity": kinematics.head_angular_velocity(topology, states),
    }


def _head_drag(scene: Scene) -> dict[str, tuple[Any, ...]]:
    """What resists the motion of the head: the sum of all terms that do."""
    drags = [term for term in scene.terms if isinstance(term, HeadDrag)]
    if not drags:
        return {}
    radii = {float(drag.radius) for drag in drags}
    return {
        "head_drag": _variable(
            "",
            sum(drag.translation for drag in drags),
            "N s/m",
            "resistance of the head to translation",
        ),
        "head_spin_drag": _variable(
            "",
            sum(drag.spin for drag in drags),
            "N m s",
            "resistance of the head to spin about its own axis",
        ),
        "head_drag_radius": _variable(
            "",
            radii.pop() if len(radii) == 1 else np.nan,
            "m",
            "radius of the head that has this drag",
        ),
    }


def _rod_radius(scene: Scene, contacts: Sequence[Contact]) -> float | None:
    """m, of rods that touch, or else of those that the scene was built of."""
    if contacts:
        return max(float(contact.radius) for contact in contacts)
    known = scene.parameters.get("rod_radius")
    return None if known is None else float(known)


def _bundle(scene: Scene, nodes: np.ndarray) -> dict[str, tuple[Any, ...]]:
    """How close the flagella are; see `bundling`."""
    topology = scene.rod.topology
    contacts = [term for term in scene.terms if isinstance(term, Contact)]
    radius = _rod_radius(scene, contacts)
    variables = {}
    if len(topology.filaments) > 1 and radius is not None:
        close = bundling.closeness(topology, nodes, 2.0 * radius)
        variables |= {
            "minimum_distance": _variable(
                "time", close.minimum_distance, "m", "smallest distance of two flagella's axes"
            ),
            "bundle_fraction": _variable(
                "time", close.bundle_fraction, "1", "part of the flagella that is in a bundle"
            ),
            "linking_number": _variable(
                "time", close.linking_number, "1", "turns of the flagella about each other"
            ),
            "flagellum_phase": _variable(
                "time flagellum",
                bundling.phases(topology, nodes),
                "rad",
                "angle that the base of the flagellum has turned about the x axis",
            ),
        }
    if contacts:
        each = [bundling.contact_forces(contact, topology, nodes) for contact in contacts]
        forces = np.concatenate(each, axis=1)
        variables |= {
            "contact_count": _variable(
                "time", (forces > 0).sum(axis=1), "1", "pairs of edges that touch"
            ),
            "contact_force": _variable(
                "time", forces.sum(axis=1), "N", "sum of the normal forces of all contacts"
            ),
        }
    return variables


def _attributes(scene: Scene, file: SceneFile | None) -> dict[str, Any]:
    """Versions, the scene's choices as JSON, and each of its parameters by name."""
    file = scene.source.file if file is None and scene.source is not None else file
    parameters = {name: np.asarray(value) for name, value in scene.parameters.items()}
    others = changed(scene.terms, scene.check_sums)
    return {
        "derjax_version": version("derjax"),
        "jax_version": jax.__version__,
        **({} if file is None else {"scene_json": json.dumps(file.content(parameters))}),
        "parameter_units": ", ".join(f"{name}: {unit_of(name)}" for name in parameters),
        **({"changed_terms": ", ".join(others)} if others else {}),
        **parameters,
    }
