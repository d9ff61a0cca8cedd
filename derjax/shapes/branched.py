"""A head with any number of flagella."""

from collections.abc import Sequence
from itertools import pairwise

from jaxtyping import Array

from ..rods.topology import Head, Topology
from .body import Nodes, RobotGeometry, on_shaft, places_around_axis
from .numbers import library_of


def branched(filaments: Sequence[Nodes], edge: Array, separation: Array) -> RobotGeometry:
    """Flagella around the axis of one head, each on an arm and with a motor of its own.

    The head is an edge along x. From its second node arms lead outwards, to links that are
    parallel to x and end at the motors. Neighbouring flagella are `separation` (m) apart, and
    equal ones are copies of each other, shifted. A single flagellum needs no arm: then this is the
    robot `single_flagellum`, node for node.
    """
    n_flagella = len(filaments)
    if n_flagella == 0:
        raise ValueError("a robot needs at least one flagellum")
    places = places_around_axis(n_flagella, separation)
    hub = on_shaft(filaments[0], edge, backwards=2)[:2]
    nodes, edges, paths = [hub], [(0, 1)], []
    hinges, stiff, motors = [], [], []
    arms = int(n_flagella > 1)
    size = 2
    for filament, place in zip(filaments, places, strict=True):
        branch = on_shaft(filament, edge, backwards=arms) + place
        first_edge, first_hinge = len(edges), len(hinges)
        path = [1, *range(size, size + len(branch))]
        edges += pairwise(path)
        hinges += [(0, first_edge)]
        hinges += [(e, e + 1) for e in range(first_edge, len(edges) - 1)]
        stiff += range(first_hinge, first_hinge + 2 * arms)
        motors.append(first_hinge + 2 * arms if arms else first_hinge + 1)
        paths.append(tuple(path[1 + arms :]))
        nodes.append(branch)
        size += len(branch)
    topology = Topology(
        n_nodes=size,
        edges=tuple(edges),
        hinges=tuple(hinges),
        filaments=tuple(paths),
        head=Head(node=0, line=(0, 1), edges=(0,)),
        motors=tuple(motors),
    )
    return RobotGeometry(library_of(*nodes).concatenate(nodes), topology, tuple(stiff))
