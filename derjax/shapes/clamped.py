"""Filaments on fixed motors, without a head."""

from collections.abc import Sequence
from itertools import pairwise

from jaxtyping import Array

from ..rods.topology import Topology
from .body import Nodes, RobotGeometry, on_shaft, places_around_axis
from .numbers import library_of


def clamped(
    filaments: Sequence[Nodes], edge: Array, separation: Array, tips: bool = False
) -> RobotGeometry:
    """Filaments whose bases are held in place and turned about their own axes.

    They lie around the x axis as those of the robot `branched`. The first edge of each, from
    the origin of its own frame to the end of the shaft, is clamped and turned by its motor. With
    `tips` the other end is held as well, and does not turn: there one more edge follows, in line
    with the last one of the filament, which is clamped.
    """
    places = places_around_axis(len(filaments), separation)
    nodes, edges, hinges, paths, driven_edges, ends = [], [], [], [], [], []
    size = 0
    for filament, place in zip(filaments, places, strict=True):
        branch = on_shaft(filament, edge, backwards=0)
        if tips:
            branch = library_of(branch).concatenate([branch, 2.0 * branch[-1:] - branch[-2:-1]])
        nodes.append(branch + place)
        first = len(edges)
        path = range(size, size + len(branch))
        edges += pairwise(path)
        hinges += [(e, e + 1) for e in range(first, len(edges) - 1)]
        paths.append(tuple(path))
        driven_edges.append(first)
        ends += [first, len(edges) - 1] if tips else [first]
        size += len(branch)
    held = [node for edge in ends for node in edges[edge]]
    positions = [3 * node + axis for node in held for axis in range(3)]
    topology = Topology(
        n_nodes=size,
        edges=tuple(edges),
        hinges=tuple(hinges),
        filaments=tuple(paths),
        driven_edges=tuple(driven_edges),
        fixed_dofs=(*positions, *(3 * size + edge for edge in ends)),
    )
    return RobotGeometry(library_of(*nodes).concatenate(nodes), topology)
