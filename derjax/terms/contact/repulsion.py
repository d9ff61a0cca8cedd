"""Contact of rods: a smooth repulsion of edges that come closer than their diameter.

The energy of a pair at the softened distance d (see `near`) is C^2: with the overlap
p = 2 r_0 - d and the ramp w,

    E(p) = k p^3 / (6 w)                       for 0 < p < w,
    E(p) = k (p^2 / 2 - p w / 2 + w^2 / 6)     for p > w.

Distances have closed derivatives. At their minimum the near points s, t do not change D to
first order, and with the gap g, the weights w = (1 - s, s, -(1 - t), -t) of the four nodes and
A the second derivatives of D with respect to (s, t),

    dD/dx = 2 w (x) g,    d2D/dx2 = 2 w w^T (x) 1 - G A^-1 G^T,    G = d(dD/dx)/d(s, t).
"""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from ...core.pytree import Indices, pytree, replace, static
from ...rods.rod import Rod, State
from ...solve.contributions import Contacts
from ..term import Prediction, Stage, Term
from .neighbours import Neighbours, search
from .segments import Near, barrier_curvature, near

SOFTNESS = 0.05
"""Of the distance, in diameters: it raises distances by less than 0.25 % of a diameter."""

RAMP = 0.01
"""Overlap over which the repulsion sets in, in diameters."""

MEETING = 0.25
"""Gap of pairs that may touch within an iteration of Newton's method, in diameters."""


@pytree
class ContactLaw:
    """What two edges repel each other by: stiffness (N/m) and diameter (m)."""

    stiffness: Array
    diameter: Array


def energy(d: Array, touch: ContactLaw) -> Array:
    """J, at a distance d (m)."""
    width = RAMP * touch.diameter
    p = jnp.maximum(touch.diameter - d, 0.0)
    onset = p**3 / (6.0 * width)
    return touch.stiffness * jnp.where(
        p < width, onset, 0.5 * p**2 - 0.5 * p * width + width**2 / 6.0
    )


def force(d: Array, touch: ContactLaw) -> Array:
    """N, by which two edges at a distance d (m) repel each other."""
    return _force(touch.diameter - d, touch)


def _force(overlap: Array, touch: ContactLaw) -> Array:
    width = RAMP * touch.diameter
    p = jnp.maximum(overlap, 0.0)
    return touch.stiffness * jnp.where(p < width, 0.5 * p**2 / width, p - 0.5 * width)


def _stiffness(overlap: Array, touch: ContactLaw) -> Array:
    width = RAMP * touch.diameter
    p = jnp.maximum(overlap, 0.0)
    return touch.stiffness * jnp.minimum(p / width, 1.0)


def meeting(local: Float[Array, " 12"], diameter: Array) -> tuple[Near, Array]:
    """Where two edges meet, and their softened distance (m)."""
    at = near(local.reshape(4, 3), SOFTNESS * diameter)
    # Rods whose centre lines cross still have a distance with derivatives.
    return at, jnp.sqrt(at.squared + (1e-6 * diameter) ** 2)


def weights(at: Near) -> Float[Array, " 4"]:
    """How the four nodes of a pair move the vector between its near points."""
    return jnp.stack([1.0 - at.s, at.s, at.t - 1.0, -at.t])


@dataclass(frozen=True)
class ContactEnergy:
    """The energy of one pair of edges as a function of its four nodes."""

    def __call__(self, local: Float[Array, " 12"], data: ContactLaw) -> Array:
        return energy(meeting(local, data.diameter)[1], data)

    def gradient(self, local: Float[Array, " 12"], data: ContactLaw) -> Array:
        at, d = meeting(local, data.diameter)
        return jnp.outer(weights(at), -force(d, data) / d * at.gap).ravel()

    def overlap(self, local: Float[Array, " 12"], data: ContactLaw) -> tuple[Array, Array]:
        at, d = meeting(local, data.diameter)
        return data.diameter - d, jnp.outer(weights(at), -at.gap / d).ravel()

    def may_meet(self, overlap: Array, data: ContactLaw) -> Array:
        return overlap > -MEETING * data.diameter

    def force(self, overlap: Array, data: ContactLaw) -> Array:
        return _force(overlap, data)

    def stiffness(self, overlap: Array, data: ContactLaw) -> Array:
        return _stiffness(overlap, data)

    def hessian(self, local: Float[Array, " 12"], data: ContactLaw) -> Array:
        at, d = meeting(local, data.diameter)
        return _second(local, data, at, d, _stiffness(data.diameter - d, data), force(d, data))

    def curvature(self, local: Float[Array, " 12"], data: ContactLaw) -> Array:
        at, d = meeting(local, data.diameter)
        # A guess may overlap by far more than rods ever do.
        p = jnp.minimum(data.diameter - d, 0.5 * RAMP * data.diameter)
        return _second(local, data, at, d, jnp.zeros(()), _force(p, data))


def _second(
    local: Float[Array, " 12"], data: ContactLaw, at: Near, d: Array, stiffness: Array, push: Array
) -> Float[Array, "12 12"]:
    """The second derivative of an energy of the distance, from its own two derivatives."""
    x0, x1, y0, y1 = local.reshape(4, 3)
    w, pull = weights(at), -push / d
    # Half of G and of A, whose products are those of half of D.
    ends = jnp.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    along = jnp.stack([x1 - x0, y0 - y1], axis=1)
    g = (ends[:, None, :] * at.gap[:, None] + w[:, None, None] * along).reshape(12, 2)
    bend = barrier_curvature(jnp.stack([at.s, at.t]))
    a = along.T @ along + 0.5 * (SOFTNESS * data.diameter) ** 2 * jnp.diag(bend)
    determinant = a[0, 0] * a[1, 1] - a[0, 1] ** 2
    inverse = jnp.array([[a[1, 1], -a[0, 1]], [-a[0, 1], a[0, 0]]]) / determinant
    squared = jnp.kron(jnp.outer(w, w), jnp.eye(3)) - g @ inverse @ g.T
    normal = jnp.outer(w, at.gap / d).ravel()
    return (stiffness - pull) * jnp.outer(normal, normal) + pull * squared


@pytree
class Contact(Term):
    """`E = sum over pairs of edges of E(2 r_0 - d)`: rods do not pass through each other.

    Attributes:
        stiffness: N/m, the force of an overlap.
        radius: r_0, m, of the rod.
        pairs: (p, 2) the edges that may touch.
        capacity: how many of these may come close at one time. If more do, the step fails
            with `Status.CAPACITY`.
    """

    stiffness: Float[Array, ""]
    radius: Float[Array, ""]
    pairs: Indices = static()
    capacity: int = static()

    def prepare(self, rod: Rod, state: State, prediction: Prediction) -> Neighbours:
        """The pairs that may touch during the step."""
        move, diameter = prediction.move, 2.0 * self.radius
        return search(rod, state, move, self.pairs, diameter, self.capacity)

    def enlarged(self) -> "Contact":
        """With a list twice as long, or as long as it can ever have to be."""
        return replace(self, capacity=min(2 * self.capacity, len(self.pairs.array)))

    @property
    def touch(self) -> ContactLaw:
        """Of every place of the list."""
        return ContactLaw(
            jnp.broadcast_to(self.stiffness, self.capacity),
            jnp.broadcast_to(2.0 * self.radius, self.capacity),
        )

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: Neighbours) -> Contacts:
        dofs = (3 * cache.nodes[:, :, None] + jnp.arange(3)).reshape(-1, 12)
        return Contacts(dofs, cache.mask, ContactEnergy(), self.touch, cache)
