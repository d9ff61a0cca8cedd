"""The bodies of the robots: node positions and topology from a few dimensions.

A robot carries filaments: each is given as its nodes in a frame of its own, in which the shaft
of its motor ends at the origin and points along x (`helix`, `arc`). Positions are
smooth functions of the dimensions, so that a rollout can be differentiated with respect to the
shape; the number of nodes is fixed beforehand, on the host. With dimensions of NumPy, and none of
JAX, nothing is compiled.
"""

from .body import RobotGeometry as RobotGeometry
from .body import rotated_about_x as rotated_about_x
from .branched import branched as branched
from .clamped import clamped as clamped
from .filament import arc as arc
from .filament import edge_count as edge_count
from .filament import helix as helix
from .filament import helix_contour as helix_contour
from .single_flagellum import single_flagellum as single_flagellum
from .two_flagella import two_flagella as two_flagella
