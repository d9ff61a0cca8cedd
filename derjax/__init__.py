"""derjax: soft flagellated robots in viscous fluid, simulated with exact derivatives.

Importing derjax switches JAX to 64-bit floating point: slender rods are too stiff for 32 bits.

    scene file --load_scene--> SceneFile --build--> Scene, State --rollout--> states, report
"""

import os
from importlib.metadata import version

# Else XLA writes a page about processor features for every program that it finds in the
# compilation cache. Failures are exceptions all the same.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import jax

jax.config.update("jax_enable_x64", True)

from .rod import Rod as Rod  # noqa: E402
from .rod import State as State  # noqa: E402
from .rod import Topology as Topology  # noqa: E402
from .rod import angles as angles  # noqa: E402
from .rod import at_rest as at_rest  # noqa: E402
from .rod import chain as chain  # noqa: E402
from .rod import positions as positions  # noqa: E402
from .rollout import Report as Report  # noqa: E402
from .rollout import march as march  # noqa: E402
from .rollout import rollout as rollout  # noqa: E402
from .scene import build as build  # noqa: E402
from .scenefile import InputError as InputError  # noqa: E402
from .scenefile import SceneFile as SceneFile  # noqa: E402
from .scenefile import load_scene as load_scene  # noqa: E402
from .status import SolverError as SolverError  # noqa: E402
from .status import Status as Status  # noqa: E402
from .step import Scene as Scene  # noqa: E402

__version__ = version("derjax")
