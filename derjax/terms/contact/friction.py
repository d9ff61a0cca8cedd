"""Dry friction between touching rods.

Coulomb's law is a dissipation potential once the normal force N is known; here it is that of
the start of the step. With u the slip of the two surfaces during a step of length h,

    h Phi = mu_f N (sqrt(|u|^2 + (h v_s)^2) - h v_s),

whose force tends to mu_f N for slip faster than v_s. Surfaces move with their edges and turn
with them: the point of a surface at -+ d/2 n from the centre line, d the distance and n the unit
normal from the second rod to the first, moves by w x (-+ d/2 n) beyond its centre line, with the
rotation w of its edge. Two rods that turn as one rigid body therefore do not slip.
"""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...core.pytree import pytree
from ...rods.rod import Rod, State
from ...rods.vectors import dot, unit
from ...solve.contributions import Pairs
from ..term import Prediction, Role, Stage, Term
from .neighbours import Neighbours
from .repulsion import Contact, ContactLaw, force, meeting, weights


def slip(
    local: Float[Array, " 12"], diameter: Array
) -> tuple[Float[Array, "3 14"], Float[Array, ""]]:
    """The slip of a pair (m) as a linear function of its displacement, and its distance (m).

    The displacement is that of four nodes (m) and of the angles of the two edges (rad).
    """
    at, d = meeting(local, diameter)
    x0, x1, y0, y1 = local.reshape(4, 3)
    apart = jnp.sqrt(dot(at.gap, at.gap) + (1e-6 * diameter) ** 2)
    normal = at.gap / apart
    across = jnp.eye(3) - jnp.outer(normal, normal)
    nodes = jnp.kron(weights(at), jnp.eye(3))
    # Both surfaces lie halfway between the two centre lines: in the difference of their motions
    # the arms of the first and of the second have the same sign.
    arm = -0.5 * apart
    columns = []
    for start, end, first in ((x0, x1, 0), (y0, y1, 6)):
        edge = end - start
        tangent = unit(edge)
        turn = dot(tangent, normal) * jnp.eye(3) - jnp.outer(tangent, normal)
        change = (jnp.eye(3) - jnp.outer(tangent, tangent)) / jnp.sqrt(dot(edge, edge))
        tilt = arm * turn @ change
        nodes = nodes.at[:, first : first + 6].add(jnp.concatenate([-tilt, tilt], axis=1))
        columns.append(arm * jnp.cross(tangent, normal)[:, None])
    return across @ jnp.concatenate([nodes, *columns], axis=1), d


def _pressed(local: Float[Array, " 12"], touch: ContactLaw) -> tuple[Array, Array]:
    """The slip of a pair per displacement (3, 14), and its normal force (N)."""
    matrix, d = slip(local, touch.diameter)
    return matrix, force(d, touch)


@pytree
class SlipData:
    """One pair: slip per displacement (3, 14), where it was (14,), mu_f N, and h v_s."""

    slip: Array
    old: Array
    strength: Array
    smallest: Array


@dataclass(frozen=True)
class FrictionDissipation:
    """h Phi of one pair of edges as a function of its nodes and angles."""

    def __call__(self, local: Float[Array, " 14"], data: SlipData) -> Array:
        u = data.slip @ (local - data.old)
        return data.strength * (jnp.sqrt(dot(u, u) + data.smallest**2) - data.smallest)

    def gradient(self, local: Float[Array, " 14"], data: SlipData) -> Array:
        u = data.slip @ (local - data.old)
        return data.strength / jnp.sqrt(dot(u, u) + data.smallest**2) * (u @ data.slip)

    def hessian(self, local: Float[Array, " 14"], data: SlipData) -> Array:
        u = data.slip @ (local - data.old)
        size = jnp.sqrt(dot(u, u) + data.smallest**2)
        inner = jnp.eye(3) - jnp.outer(u / size, u / size)
        return data.strength / size * data.slip.T @ inner @ data.slip


@pytree
class Grip:
    """What holds touching rods during one step.

    Attributes:
        dofs: (k, 14) degrees of freedom of each pair.
        mask: (k,) which places of the list are in use: by those that press each other.
        slip: (k, 3, 14) m per displacement.
        normal_force: (k,) N.
    """

    dofs: Int[Array, "k 14"]
    mask: Bool[Array, " k"]
    slip: Float[Array, "k 3 14"]
    normal_force: Float[Array, " k"]


@pytree
class Friction(Term):
    """`h Phi = sum over touching pairs of mu_f N (sqrt(|u|^2 + (h v_s)^2) - h v_s)`.

    Which rods touch, and how hard, is said by the scene's `Contact`.

    Attributes:
        coefficient: mu_f, dimensionless.
        slip_speed: v_s, m/s: below it friction is like drag, and rods that stick creep.
    """

    role: ClassVar[Role] = Role.FRICTION

    coefficient: Float[Array, ""]
    slip_speed: Float[Array, ""]

    def prepare(self, rod: Rod, state: State, prediction: Prediction) -> Grip:
        """The surfaces and normal forces at the start of the step.

        Raises:
            ValueError: the scene has no `Contact`.
        """
        contact = prediction.only(Contact, "friction")
        close: Neighbours = prediction.cache(contact, rod, state)
        positions = (3 * close.nodes[:, :, None] + jnp.arange(3)).reshape(-1, 12)
        dofs = jnp.concatenate([positions, 3 * rod.topology.n_nodes + close.edges], axis=1)
        # Where nothing is close there is nothing to find out.
        slips, normal_force = lax.cond(
            close.found > 0,
            lambda: jax.vmap(_pressed)(state.q[positions], contact.touch),
            lambda: (jnp.zeros((len(dofs), 3, 14)), jnp.zeros(len(dofs))),
        )
        return Grip(dofs, close.mask & (normal_force > 0.0), slips, normal_force)

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: Grip) -> Pairs:
        data = SlipData(
            slip=cache.slip,
            old=stage.origin_from(state)[cache.dofs],
            strength=self.coefficient * cache.normal_force,
            smallest=jnp.broadcast_to(self.slip_speed * stage.length, len(cache.dofs)),
        )
        return Pairs(cache.dofs, cache.mask, FrictionDissipation(), data)
