"""The physical ingredients, one file each. `derjax.scene` is their registry."""

from .contact.friction import Friction as Friction
from .contact.repulsion import Contact as Contact
from .contact.spillmann_teschner import SpillmannTeschner as SpillmannTeschner
from .elastic.bend import Bend as Bend
from .elastic.stretch import Stretch as Stretch
from .elastic.twist import Twist as Twist
from .energy import Energy as Energy
from .fluid.domain import Domain as Domain
from .fluid.domain import FreeSpace as FreeSpace
from .fluid.explicit import ExplicitDrag as ExplicitDrag
from .fluid.head import HeadDrag as HeadDrag
from .fluid.resistive import ResistiveDrag as ResistiveDrag
from .fluid.spin import SpinDrag as SpinDrag
from .fluid.stokeslets import StokesletSegments as StokesletSegments
from .gravity import Gravity as Gravity
from .inertia import Inertia as Inertia
from .term import Prediction as Prediction
from .term import Role as Role
from .term import Stage as Stage
from .term import Term as Term
