"""The paper's robot: a head with two flagella, as one rod."""

import numpy as np
from jaxtyping import Array

from ..rods.topology import Head, chain
from .body import Nodes, RobotGeometry, on_shaft
from .numbers import library_of


def two_flagella(filaments: tuple[Nodes, Nodes], edge: Array, separation: Array) -> RobotGeometry:
    """Tip, flagellum, motor, three head nodes, motor, flagellum, tip, on one rod.

    The flagella lie parallel to x, at y = -+ separation / 2 (m). The head is a bar across
    their axes; a link of length `edge` (m) leads from each of its ends to a motor. If their
    filaments agree, the second flagellum is a copy of the first, shifted.
    """
    first, second = (on_shaft(filament, edge, backwards=1) for filament in filaments)
    offset = np.array([0.0, 0.5, 0.0]) * separation
    first, second = first - offset, second + offset
    xp = library_of(first, second, edge)
    middle = xp.stack([-edge, 0.0 * edge, 0.0 * edge])[None]
    nodes = xp.concatenate([first[::-1], middle, second])
    head = len(first)  # the middle one of its three nodes
    topology = chain(
        len(nodes),
        filaments=(tuple(range(head - 1))[::-1], tuple(range(head + 2, len(nodes)))),
        head=Head(
            node=head,
            line=(head - 1, head + 1),
            edges=(head - 1, head),
            ahead=(head - 2, head + 2),
        ),
        motors=(head - 3, head + 1),
    )
    return RobotGeometry(nodes, topology, stiff_hinges=(head - 2, head - 1, head))
