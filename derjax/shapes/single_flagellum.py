"""A head with one flagellum."""

from jaxtyping import Array

from ..rods.topology import Head, chain
from .body import Nodes, RobotGeometry, on_shaft


def single_flagellum(filament: Nodes, edge: Array) -> RobotGeometry:
    """A head and one flagellum, as one rod along the x axis.

    Four nodes in line, `edge` (m) apart, make the head and the shaft of the motor: the head
    node is the first, the motor sits at the third, and the filament follows on the fourth.
    """
    nodes = on_shaft(filament, edge, backwards=2)
    topology = chain(
        len(nodes),
        filaments=(tuple(range(2, len(nodes))),),
        head=Head(node=0, line=(0, 1), edges=(0,)),
        motors=(1,),
    )
    return RobotGeometry(nodes, topology)
