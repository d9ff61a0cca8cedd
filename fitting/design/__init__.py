"""Designing robots by exact gradients.

scene, bounds, objective, limits --design--> Design --write--> design.json, best.toml, figures
"""

from .outcome import Design as Design
from .outcome import design as design
from .search import Search as Search
from .uncertain import Uncertain as Uncertain
