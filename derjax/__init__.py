"""derjax: soft flagellated robots in viscous fluid, simulated with exact derivatives.

    import derjax as dj

    file = dj.load_scene("scene.toml")          # or dj.robots.two_flagella(pitch=0.0318)
    scene = dj.build(file, {"C_t": 4.0})        # scene.start is the robot at rest
    run = dj.rollout(scene, end=20.0)           # run.head_position, run.summary(), run.plot()

Importing derjax switches JAX to 64-bit floating point, as slender rods are too stiff for 32 bits,
and SciPy's linear algebra to one thread, unless `OPENBLAS_NUM_THREADS` or its like says otherwise.
"""

import gc
import os
from importlib.metadata import version

# Importing makes much and drops little: a tenth of its time would go into looking for garbage.
collecting = gc.isenabled()
gc.disable()

# Else XLA writes a page about processor features for every program that it finds in the
# compilation cache. Failures are exceptions all the same.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import jax

jax.config.update("jax_enable_x64", True)

from .core.runtime import use_one_blas_thread

use_one_blas_thread()

from . import robots as robots
from .core.errors import InputError as InputError
from .core.errors import InputWarning as InputWarning
from .core.errors import SolverWarning as SolverWarning
from .core.pytree import pytree as pytree
from .core.pytree import static as static
from .core.runtime import enable_compilation_cache as enable_compilation_cache
from .core.status import SolverError as SolverError
from .core.status import Status as Status
from .integrate.frames import RolloutStats as RolloutStats
from .integrate.frames import march_frames as march_frames
from .integrate.frames import roll_frames as roll_frames
from .integrate.schemes.euler import euler as euler
from .integrate.schemes.trbdf2 import trbdf2 as trbdf2
from .integrate.step import Scene as Scene
from .results.mechanics import Operators as Operators
from .results.mechanics import energies as energies
from .results.mechanics import forces as forces
from .results.mechanics import operators as operators
from .results.mechanics import potential as potential
from .results.mechanics import resistance as resistance
from .results.run import Run as Run
from .results.run import rollout as rollout
from .results.run import steady_run as steady_run
from .rods.kinematics import angles as angles
from .rods.kinematics import positions as positions
from .rods.rod import Rod as Rod
from .rods.rod import State as State
from .rods.rod import at_rest as at_rest
from .rods.topology import Topology as Topology
from .rods.topology import chain as chain
from .runs.batch import build_many as build_many
from .scenes.build import build as build
from .scenes.file import SceneFile as SceneFile
from .scenes.load import load_scene as load_scene
from .solve.contributions import Contribution as Contribution
from .solve.contributions import Diagonal as Diagonal
from .solve.contributions import Elements as Elements
from .solve.contributions import Load as Load
from .solve.contributions import Mobility as Mobility
from .solve.contributions import Pairs as Pairs
from .solve.contributions import Quadratic as Quadratic
from .solve.newton import NewtonSettings as NewtonSettings
from .steady.branch import Branch as Branch
from .steady.branch import branch as branch
from .steady.curve import steady_curve as steady_curve
from .steady.equilibrium import equilibrium as equilibrium
from .steady.orbit import Orbit as Orbit
from .steady.orbit import orbit as orbit
from .steady.solve import Steady as Steady
from .steady.solve import steady as steady
from .steady.stability import Stability as Stability
from .steady.stability import Threshold as Threshold
from .steady.stability import stability as stability
from .steady.stability import threshold as threshold
from .terms import Bend as Bend
from .terms import Contact as Contact
from .terms import Domain as Domain
from .terms import Energy as Energy
from .terms import FreeSpace as FreeSpace
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
from .terms.elastic import elasticity as elasticity

__version__ = version("derjax")

if collecting:
    if gc.get_freeze_count() == 0:  # nothing that another has put aside
        gc.freeze()
        gc.unfreeze()  # all that was made is old now, without having been looked through
    gc.enable()
del collecting, gc, jax, os, use_one_blas_thread, version
