"""The physical ingredients, one file each. `derjax.scene` is their registry."""

from .bend import Bend as Bend
from .contact import Contact as Contact
from .energy import Energy as Energy
from .friction import Friction as Friction
from .gravity import Gravity as Gravity
from .head import HeadDrag as HeadDrag
from .inertia import Inertia as Inertia
from .lagged import Lagged as Lagged
from .resistive import ResistiveDrag as ResistiveDrag
from .spillmann_teschner import SpillmannTeschner as SpillmannTeschner
from .spin import SpinDrag as SpinDrag
from .stokeslets import StokesletSegments as StokesletSegments
from .stretch import Stretch as Stretch
from .term import Prediction as Prediction
from .term import Role as Role
from .term import Stage as Stage
from .term import Term as Term
from .twist import Twist as Twist
