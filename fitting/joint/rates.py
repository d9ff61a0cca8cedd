"""Speeds over the rate of the motors: from the tables of a dataset file to SI units."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from derjax import InputError, SceneFile
from derjax.io.fields import TIME_UNITS
from derjax.io.tables import read_table

from ..datasetfile import ANGLE_UNITS, LENGTH_UNITS
from ..scenes import scene_with_rates
from .file import Nuisances, RatesFile

KEYS = ("motor_rpm", "v", "v_std", "head_rate", "head_rate_std")


@dataclass(frozen=True)
class Rates:
    """Speeds of one robot, in SI units.

    Attributes:
        name: for reports.
        motor_rpm: (n,) revolutions per minute, of all motors.
        speed: (n,) m/s, along x of the scene; NaN where there is none.
        speed_std: (n,) m/s, noise; NaN: to be estimated.
        head_rate: (n,) rad/s; NaN where there is none.
        head_rate_std: (n,) rad/s, noise; NaN: to be estimated.
        scene: the robot.
        own: parameters of which this robot has a value of its own.
        nuisances: what else is estimated.
    """

    name: str
    motor_rpm: Float[np.ndarray, " n"]
    speed: Float[np.ndarray, " n"]
    speed_std: Float[np.ndarray, " n"]
    head_rate: Float[np.ndarray, " n"]
    head_rate_std: Float[np.ndarray, " n"]
    scene: SceneFile
    own: tuple[str, ...] = ()
    nuisances: Nuisances = field(default_factory=Nuisances)

    @property
    def measured(self) -> tuple[Float[np.ndarray, " n"], ...]:
        """Speeds, head rates, and their noise."""
        return self.speed, self.speed_std, self.head_rate, self.head_rate_std


def load_rates(path: Path, tables: Sequence[RatesFile], scene: SceneFile) -> tuple[Rates, ...]:
    """The rates of a dataset file.

    Args:
        path: of the dataset file.
        tables: its `[[rates]]`.
        scene: of the dataset, for those that name none.

    Raises:
        InputError: a file is missing or malformed, or numbers do not go together.
    """
    return tuple(_load(path, k, table, scene) for k, table in enumerate(tables, 1))


def _load(path: Path, entry: int, table: RatesFile, scene: SceneFile) -> Rates:
    where = f"{path}: [rates] (entry {entry})"
    if table.scene is not None:
        scene = scene_with_rates(path.parent / table.scene)
    if scene.motor_table is not None:
        raise InputError(f"{where}: the motor of the scene follows a table; speeds need one rate")
    columns = _inline(where, table) if table.file is None else _of_file(path.parent, where, table)
    rpm = columns["motor_rpm"]
    if np.any(rpm == 0) or not np.isfinite(rpm).all():
        raise InputError(
            f"{where} motor_rpm: must not be 0 or empty: a robot at rest does not swim"
        )
    speed_unit = LENGTH_UNITS[table.length_unit] / TIME_UNITS[table.time_unit]
    angle_unit = ANGLE_UNITS[table.angle_unit] / TIME_UNITS[table.time_unit]
    default = Path(table.file).stem if table.file else f"rates {entry}"
    rates = Rates(
        table.name or default,
        rpm,
        columns["v"] * speed_unit,
        columns["v_std"] * speed_unit,
        columns["head_rate"] * angle_unit,
        columns["head_rate_std"] * angle_unit,
        scene,
        table.own,
        table.nuisances,
    )
    _check(where, rates, table)
    return rates


def _inline(where: str, table: RatesFile) -> dict[str, np.ndarray]:
    given = {key: getattr(table, key) for key in KEYS}
    count = np.atleast_1d(np.asarray(given["motor_rpm"], float)).size
    columns = {}
    for key, value in given.items():
        values = np.atleast_1d(np.asarray(np.nan if value is None else value, float))
        if value is None or (np.ndim(value) == 0 and key.endswith("_std")):
            values = np.full(count, values[0])
        if values.size != count:
            raise InputError(f"{where} {key}: has {values.size} numbers, but motor_rpm has {count}")
        columns[key] = values
    return columns


def _of_file(directory: Path, where: str, table: RatesFile) -> dict[str, np.ndarray]:
    path = directory / str(table.file)
    if not path.exists():
        raise InputError(f"{path}: no such file (named by {where} file)")
    text = read_table(path)
    named = dict(table.columns or {})
    if unknown := set(named) - set(KEYS):
        raise InputError(f"{where} columns.{min(unknown)}: unknown; there are {', '.join(KEYS)}")
    for key in KEYS:
        if key not in named and text.find(key) is not None:
            named[key] = key
    if "motor_rpm" not in named:
        raise InputError(
            f"{path}: no column 'motor_rpm' (the columns are {', '.join(map(repr, text.names))}); "
            'say which it is with columns = { motor_rpm = "...", v = "..." }'
        )
    if not {"v", "head_rate"} & set(named):
        raise InputError(f"{path}: neither a column 'v' nor 'head_rate'; name one with columns")
    found = text.numbers(list(named.values())).values
    columns = {key: found[:, k] for k, key in enumerate(named)}
    for key in KEYS:
        one = getattr(table, key) if key.endswith("_std") else None
        if key in columns and one is not None:
            raise InputError(f"{where} {key}: is in the file already; leave one of them out")
        if key not in columns:
            columns[key] = np.full(len(found), np.nan if one is None else one)
    return columns


def _check(where: str, rates: Rates, table: RatesFile) -> None:
    """Refuses speeds that no robot has, which are in another unit."""
    if not np.isfinite(np.r_[rates.speed, rates.head_rate]).any():
        raise InputError(f"{where}: there is no speed in it")
    for std in (rates.speed_std, rates.head_rate_std):
        if np.any(std <= 0):
            raise InputError(f"{where}: a standard deviation is not positive")
    screw = max(rates.scene.robot.each("pitch")) * np.abs(rates.motor_rpm) / 60
    fast = np.abs(rates.speed) > screw
    if fast.any():
        k = int(np.argmax(fast))
        raise InputError(
            f"{where} v: {rates.speed[k]:.3g} m/s at {rates.motor_rpm[k]:g} rpm (length_unit = "
            f"'{table.length_unit}', time_unit = '{table.time_unit}'), but a helix of this pitch "
            f"goes no faster than {screw[k]:.2g} m/s, as in wood; are the units right?"
        )
    motor = 2 * np.pi / 60 * np.abs(rates.motor_rpm)
    fast = np.abs(rates.head_rate) > motor
    if fast.any():
        k = int(np.argmax(fast))
        raise InputError(
            f"{where} head_rate: {rates.head_rate[k]:.3g} rad/s is faster than the motor "
            f"({motor[k]:.3g} rad/s); is angle_unit right?"
        )
