"""Newton's directions where rods touch: the law of contact as it is, all else as its tangent.

With A the second derivative but for the stiffness of contact, N (m, d) the derivatives of the
overlaps p of m pairs, and F their law, a direction u is wanted that balances forces,

    A u = -g - N^T (F(p + N u) - F(p)),

g being what is left of all forces, contact included. With a = A^-1 g and W = N A^-1 N^T, which
says how far pairs move apart for forces between them, that is m equations for the overlaps p' at
the end,

    p' = p - N a - W (F(p') - F(p)),        u = -a - A^-1 N^T (F(p') - F(p)).

Each has one solution as F grows with p', and Newton's method for it starts where nothing holds the
pairs apart: from there it goes down without passing by the solution.

That needs an A which is positive definite. Rods that are pressed together, and slide, may be held
by nothing but the stiffness of their contact. Then A has that as well, where they are now, and F is
what is left of the law.
"""

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..core.pytree import pytree
from .contributions import Contacts, Dofs
from .dense import Factor

MOST = 40
"""Iterations for the overlaps."""

CLOSE = 1e-7
"""Of the largest overlap: a last change after which, as it squares, nothing is left to change."""

LISTED = 32
"""Pairs, the closest ones, that go by their law. Others are rare, and go by their tangent."""


@pytree
class TouchingFactor:
    """A factored Newton matrix, and what contact forces do.

    Attributes:
        contacts: the pairs that go by their law.
        smooth: the factor of A, of the free degrees of freedom.
        taken: (m,) N/m, stiffness of the pairs that is in A.
        normals: (m, f) N, how these change the overlaps.
        given: (f, m) A^-1 N^T, m/N.
        compliance: (m, m) W, m/N.
    """

    contacts: Contacts
    smooth: Factor
    taken: Float[Array, " m"]
    normals: Float[Array, "m f"]
    given: Float[Array, "f m"]
    compliance: Float[Array, "m m"]


def normals_of(
    contacts: Contacts, slopes: Float[Array, "m k"], size: int, chosen: Any
) -> Float[Array, "m f"]:
    """How the chosen ones of all degrees of freedom change the overlaps.

    Args:
        contacts: pairs.
        slopes: the derivatives of their overlaps.
        size: d, of all degrees of freedom.
        chosen: the free ones.
    """
    rows = jnp.arange(len(slopes))[:, None]
    return jnp.zeros((len(slopes), size)).at[rows, contacts.dofs].add(slopes)[:, chosen]


def touching_factor(
    smooth: Factor, contacts: Contacts, taken: Float[Array, " m"], normals: Float[Array, "m f"]
) -> TouchingFactor:
    """From the factor of all but contact, the stiffness of contact that it has none the less, and
    how overlaps change."""

    def compute() -> tuple[Array, Array]:
        given = smooth.solve(normals.T)
        return given, normals @ given

    nothing = jnp.zeros_like(normals.T), jnp.zeros((len(normals),) * 2)
    known = lax.cond(jnp.any(contacts.mask), compute, lambda: nothing)
    return TouchingFactor(contacts, smooth, taken, normals, *known)


def direction(factor: TouchingFactor, q: Dofs, gradient: Float[Array, " f"]) -> Float[Array, " f"]:
    """Where forces balance if contact goes by its law, and all else by its tangent."""
    contacts, free = factor.contacts, -factor.smooth.solve(gradient)
    alone = jnp.all(factor.taken == 0.0)

    def excess(p: Array) -> Array:
        """N, the force but for what the stiffness that is taken makes of it."""
        return contacts.forces(p) - factor.taken * p

    def with_contact() -> Array:
        now, _ = contacts.overlaps(q)
        before, onward = excess(now), now + factor.normals @ free
        # Where pairs would go without the forces that hold them apart.
        apart = onward + factor.compliance @ before

        def wanted(carry):
            count, _, change = carry
            return (count < MOST) & change

        def closer(carry):
            count, p, _ = carry
            left = p - apart + factor.compliance @ excess(p)
            slope = jnp.eye(p.size) + factor.compliance * (contacts.stiffnesses(p) - factor.taken)
            change = -jnp.linalg.solve(slope, left)
            new = p + change
            far = jnp.max(jnp.abs(change)) > CLOSE * jnp.max(new)
            return count + 1, new, far & (jnp.max(new) > 0.0)

        start = jnp.where(alone, apart, onward)
        start = (jnp.zeros((), jnp.int32), start, jnp.array(True))
        _, end, far = lax.while_loop(wanted, closer, start)
        found = free - factor.given @ (excess(end) - before)
        # Only a stable A has one solution, and one that leads down: else there is the tangent.
        return jnp.where(alone | (~far & (found @ gradient < 0.0)), found, free)

    return lax.cond(jnp.any(contacts.mask), with_contact, lambda: free)
