"""The tables of scene files, one file each: its keys, its parameters, and the terms it stands for.

A new table is a file here, a line in `INGREDIENTS`, and a field of `SceneFile`. One of another
package is an `Extension`, and needs no change of derjax.
"""

from .contact import ContactTable
from .fluid import FluidTable
from .friction import FrictionTable
from .gravity import GravityTable
from .head import HeadTable
from .ingredient import Ingredient
from .material import MaterialTable
from .motor import MotorTable
from .robot import RobotTable
from .solver import SolverTable
from .time import TimeTable

INGREDIENTS: dict[str, type[Ingredient]] = {
    "robot": RobotTable,
    "material": MaterialTable,
    "head": HeadTable,
    "fluid": FluidTable,
    "motor": MotorTable,
    "contact": ContactTable,
    "friction": FrictionTable,
    "time": TimeTable,
    "gravity": GravityTable,
    "solver": SolverTable,
}
"""By their names in scene files, in the order of their terms."""
