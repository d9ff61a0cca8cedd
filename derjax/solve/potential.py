"""The incremental potential of a step: the sum of what every physical ingredient contributes.

The step knows nothing of physics: it finds where the gradient of the sum vanishes.
"""

from collections.abc import Hashable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..core.pytree import pytree
from ..core.status import Status
from .contributions import Contacts, Contribution, Dofs, Guard, LocalHessians, Matrix
from .dense import Factor, factor, factor_as_it_is, factor_or_with
from .touching import LISTED, TouchingFactor, direction, normals_of, touching_factor


@pytree
class Potential:
    """The sum of the contributions to one step."""

    contributions: tuple[Contribution, ...]

    max_chord_steps = 8
    """Steps that one may still have to take with a matrix that is out of date: more of them, at
    the rate at which the residual falls, cost more than a new matrix."""

    @property
    def symmetric(self) -> bool:
        """Whether every contribution derives from a potential."""
        return all(c.symmetric for c in self.contributions)

    @property
    def guards(self) -> tuple[Guard, ...]:
        """The guards of all contributions."""
        return tuple(c.guard for c in self.contributions if c.guard is not None)

    def max_step(self, q: Dofs, direction: Dofs) -> Array:
        """The part, at most 1, of the way along `direction` that all guards allow."""
        return jnp.min(jnp.stack([jnp.ones(()), *(g.max_step(q, direction) for g in self.guards)]))

    def status(self, q: Dofs) -> Array:
        """The first fault that a guard finds with a step that ends at `q`."""
        status = jnp.array(Status.OK, jnp.int32)
        for guard in self.guards:
            status = jnp.where(status == Status.OK, guard.status(q), status)
        return status

    def value(self, q: Dofs) -> Array:
        return jnp.asarray(sum(c.value(q) for c in self.contributions))

    def gradient(self, q: Dofs) -> Dofs:
        return jnp.asarray(sum(c.gradient(q) for c in self.contributions))

    def value_and_gradient(self, q: Dofs) -> tuple[Array, Dofs]:
        """Both at once, which saves finding again where pairs meet."""
        parts = [c.value_and_gradient(q) for c in self.contributions]
        return jnp.asarray(sum(v for v, _ in parts)), jnp.asarray(sum(g for _, g in parts))

    def slope(self, gradient: Dofs, direction: Dofs) -> Array:
        """By how much the value changes along a direction."""
        return gradient @ direction

    def local_hessians(self, q: Dofs) -> LocalHessians:
        """The second derivative, but for `diagonal`, as small matrices."""
        return tuple(part for c in self.contributions for part in c.local_hessians(q))

    def diagonal(self, q: Dofs) -> Dofs:
        """What else there is on the diagonal of the second derivative."""
        return jnp.asarray(sum(c.diagonal(q) for c in self.contributions))

    def hessian(self, q: Dofs) -> Matrix:
        """The second derivative as one dense matrix."""
        matrix = jnp.zeros((q.size, q.size), q.dtype)
        # Whole matrices first: what adds blocks after them can do it in place.
        for c in sorted(self.contributions, key=lambda c: c.scattered):
            matrix = c.add_hessian(matrix, q)
        return matrix

    @property
    def contacts(self) -> Contacts | None:
        """The one contribution of pairs that touch, if there is one."""
        found = [c for c in self.contributions if isinstance(c, Contacts)]
        return found[0] if len(found) == 1 and self.symmetric else None

    def direction(
        self, matrix: Factor | TouchingFactor, q: Dofs, gradient: Dofs, free: Any
    ) -> Dofs:
        """Newton's direction of the free degrees of freedom."""
        if isinstance(matrix, TouchingFactor):
            return direction(matrix, q, gradient[free])
        return -matrix.solve(gradient[free])

    def linearise(
        self, q: Dofs, sizes: Dofs, unit: Dofs, free: tuple[int, ...] | None, exact: bool
    ) -> tuple[Factor | TouchingFactor, Dofs]:
        """What solves with the Newton matrix of the free degrees of freedom at q, and the forces
        (d,) that rounding numbers of some sizes (m and rad) makes, in units of the rounding.

        Forces and torques are measured in `unit` (N, N m). If `exact`, nothing is added to the
        matrix of what is not stable.
        """
        chosen = slice(None) if free is None else np.array(free)
        if self.contacts is not None and not exact:
            return self._where_rods_touch(self.contacts, q, sizes, unit, chosen)
        matrix = self.hessian(q)
        rounding = jnp.abs(matrix) @ sizes
        inner = matrix[chosen][:, chosen]
        if exact:
            return factor_as_it_is(inner, self.symmetric), rounding
        return factor(inner, self.symmetric, unit[chosen]), rounding

    def _where_rods_touch(
        self, contacts: Contacts, q: Dofs, sizes: Dofs, unit: Dofs, chosen: Any
    ) -> tuple[TouchingFactor, Dofs]:
        """`linearise`, with contact set apart."""
        near, rest = contacts.split(q, LISTED)
        others = tuple(rest if c is contacts else c for c in self.contributions)
        matrix = near.add_curvatures(Potential(others).hessian(q), q)
        p, slopes = near.overlaps(q)
        felt = jnp.abs(slopes)
        # Where they touch, softened distances are the last of many operations.
        pressed = 2.0 * near.stiffnesses(p) * jnp.sum(felt * sizes[near.dofs], axis=1)
        rounding = jnp.abs(matrix) @ sizes
        rounding = rounding.at[near.dofs].add(felt * pressed[:, None])
        normals = normals_of(near, slopes, q.size, chosen)
        stiffness = near.stiffnesses(p)
        smooth, alone = factor_or_with(
            matrix[chosen][:, chosen], unit[chosen], lambda: (normals.T * stiffness) @ normals
        )
        taken = jnp.where(alone, 0.0, stiffness)
        return touching_factor(smooth, near, taken, normals), rounding


def assemble(contributions: Sequence[Contribution]) -> Potential:
    """The potential of a step; contributions of one kind are joined.

    Raises:
        TypeError: something that is no contribution.
    """
    merged: list[Contribution] = []
    groups: dict[Hashable, list[Contribution]] = {}
    for contribution in contributions:
        if not isinstance(contribution, Contribution):
            raise TypeError(
                f"a {type(contribution).__name__} is no share of a potential: that is a Load, "
                "Elements, Pairs, a Quadratic, a Diagonal, or what derives from Contribution"
            )
        if contribution.kind is None:
            merged.append(contribution)
        else:
            groups.setdefault(contribution.kind, []).append(contribution)
    for group in groups.values():
        merged += [type(group[0]).joined(group)] if len(group) > 1 else group
    return Potential(tuple(merged))
