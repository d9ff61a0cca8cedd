"""derjax: soft flagellated robots in viscous fluid, simulated with exact derivatives.

    import derjax as dj

    file = dj.load_scene("scene.toml")          # or dj.robots.two_flagella(pitch=0.0318)
    scene = dj.build(file, {"C_t": 4.0})        # scene.start is the robot at rest
    run = dj.rollout(scene, end=20.0)           # run.head_position, run.summary(), run.plot()

Importing derjax switches JAX to 64-bit floating point: slender rods are too stiff for 32 bits.
"""

import os
from importlib.metadata import version

# Else XLA writes a page about processor features for every program that it finds in the
# compilation cache. Failures are exceptions all the same.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import jax

jax.config.update("jax_enable_x64", True)

from . import robots as robots
from .batch import build_many as build_many
from .errors import InputError as InputError
from .errors import InputWarning as InputWarning
from .errors import SolverWarning as SolverWarning
from .frames import RolloutStats as RolloutStats
from .frames import march_frames as march_frames
from .frames import roll_frames as roll_frames
from .mechanics import energies as energies
from .mechanics import forces as forces
from .mechanics import potential as potential
from .mechanics import resistance as resistance
from .newton import NewtonSettings as NewtonSettings
from .potential import Contribution as Contribution
from .potential import Diagonal as Diagonal
from .potential import Elements as Elements
from .potential import Load as Load
from .potential import Mobility as Mobility
from .potential import Pairs as Pairs
from .potential import Quadratic as Quadratic
from .pytree import pytree as pytree
from .pytree import static as static
from .rod import Rod as Rod
from .rod import State as State
from .rod import Topology as Topology
from .rod import angles as angles
from .rod import at_rest as at_rest
from .rod import chain as chain
from .rod import positions as positions
from .run import Run as Run
from .run import rollout as rollout
from .runtime import enable_compilation_cache as enable_compilation_cache
from .scene import build as build
from .scenefile import SceneFile as SceneFile
from .scenefile import load_scene as load_scene
from .schemes.euler import euler as euler
from .schemes.trbdf2 import trbdf2 as trbdf2
from .status import SolverError as SolverError
from .status import Status as Status
from .step import Scene as Scene
from .terms import Bend as Bend
from .terms import Contact as Contact
from .terms import Energy as Energy
from .terms import Friction as Friction
from .terms import Gravity as Gravity
from .terms import HeadDrag as HeadDrag
from .terms import Inertia as Inertia
from .terms import ResistiveDrag as ResistiveDrag
from .terms import Role as Role
from .terms import SpinDrag as SpinDrag
from .terms import Stage as Stage
from .terms import StokesletSegments as StokesletSegments
from .terms import Stretch as Stretch
from .terms import Term as Term
from .terms import Twist as Twist

__version__ = version("derjax")
