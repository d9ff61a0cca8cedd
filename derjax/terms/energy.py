"""An energy of one's own: any function of the positions of some nodes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.pytree import Indices, pytree, static
from ..rods.rod import Rod, State
from ..solve.contributions import Elements
from ..solve.local import Sum
from .term import Stage, Term


@dataclass(frozen=True)
class OfNodes:
    """The energy of one group of nodes as a function of their coordinates."""

    function: Callable[..., Array]

    def __call__(self, local: Float[Array, " k3"], data: tuple[Any, ...]) -> Array:
        return jnp.asarray(self.function(local.reshape(-1, 3), *data))

    def gradient(self, local: Float[Array, " k3"], data: tuple[Any, ...]) -> Array:
        return jax.grad(self)(local, data)

    def hessian(self, local: Float[Array, " k3"], data: tuple[Any, ...]) -> Array:
        return jax.hessian(self)(local, data)

    @classmethod
    def merge(cls, parts: Sequence[tuple["OfNodes", Any]]) -> tuple["OfNodes", Any]:
        """The sum of several."""
        functions = Sum(lambda x, data, f=p.function: f(x, *data) for p, _ in parts)
        return cls(functions), (tuple(data for _, data in parts),)


@pytree
class Energy(Term):
    """`E = function(x, *data)` of the positions x of some nodes: a trap, a spring, a magnet.

    The force is minus its derivative, which JAX finds, as it finds the second one that Newton's
    method asks for. Steps can be differentiated with respect to all of `data`:

        def trap(x, stiffness, target):
            return 0.5 * stiffness * jnp.sum((x[0] - target) ** 2)

        scene = scene.with_term(derjax.Energy(trap, nodes=[-1], data=(0.1, jnp.zeros(3))))

    Attributes:
        function: `(x (k, 3) in m, *data) -> J`. Must be twice differentiable, and should be
            defined once: every new function compiles a new program.
        nodes: (k,) which nodes it sees; -1 is the last one of the rod.
        data: what else it is told: arrays, or pytrees of arrays.
    """

    function: Callable[..., Array] = static()
    nodes: Sequence[int] = static()
    data: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "nodes", tuple(int(node) for node in self.nodes))
        if isinstance(self.data, float | int | np.ndarray | jax.Array):
            raise TypeError("data must be a tuple of what the function takes besides positions")

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: None) -> Elements:
        """The energy as one element.

        Raises:
            IndexError: the rod has no such node.
        """
        n = rod.topology.n_nodes
        if wrong := [node for node in self.nodes if not -n <= node < n]:
            raise IndexError(f"the rod has {n} nodes: there is no node {wrong[0]}")
        dofs = rod.topology.node_dofs(np.array(self.nodes) % n).reshape(1, -1)
        data = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], self.data)
        return Elements(Indices(dofs), OfNodes(self.function), data)
