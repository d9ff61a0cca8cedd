"""What the fluid is bounded by, and so which flow forces on it make.

A domain is free space and what its boundary adds to the flow there: nothing, the images behind a
plane, the response of a tank. That is linear in the forces and, inside of the fluid, smooth, so
that it is enough to know it for point forces: along segments it is integrated numerically, while
the flow of free space, which is steep, is in closed form (`kernels`). A wall or a tank is one
class that derives from `Domain`, in a file of its own; a scene is put into it by
`replace(term, domain=Wall(...))` of the term that is the drag on its filaments.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.pytree import pytree
from . import kernels

PLACES, WEIGHTS = np.polynomial.legendre.leggauss(4)
PLACES, WEIGHTS = 0.5 + 0.5 * PLACES, 0.5 * WEIGHTS
"""Of Gauss's quadrature along a segment, from 0 to 1."""


class Domain:
    """What the fluid is bounded by: a pytree; its leaves, such as lengths, can be differentiated.

    A new one derives from this class and has `boundary_point_flow`; it may have
    `boundary_segment_flow` as well, where that is known in closed form.

    All flows are 8 pi mu u, for mu the viscosity (Pa s), so that they do not depend on it. All
    forces are spread by the blob of `kernels`, of radius `regularization` (m). Targets and
    sources (m) are inside of the fluid.
    """

    def boundary_point_flow(
        self,
        targets: Float[Array, "n 3"],
        sources: Float[Array, "p 3"],
        forces: Float[Array, "p 3"],
        regularization: Array,
    ) -> Float[Array, "n 3"] | None:
        """What the boundary adds to the flow of point forces (N), summed: N/m; None for nothing.

        It must be linear in the forces and reciprocal: what a force on x does at y along some
        direction is what one along that direction on y does at x.
        """
        raise NotImplementedError(f"{type(self).__name__} has no boundary_point_flow")

    def boundary_segment_flow(
        self,
        targets: Float[Array, "n 3"],
        starts: Float[Array, "s 3"],
        ends: Float[Array, "s 3"],
        at_start: Float[Array, "s 3"],
        at_end: Float[Array, "s 3"],
        regularization: Array,
    ) -> Float[Array, "n 3"] | None:
        """What the boundary adds to `segment_flow`; None for nothing."""
        place = jnp.asarray(PLACES)[:, None, None]
        weight = jnp.asarray(WEIGHTS)[:, None, None]
        sources = (1.0 - place) * starts + place * ends
        forces = weight * ((1.0 - place) * at_start + place * at_end)
        return self.boundary_point_flow(
            targets, sources.reshape(-1, 3), forces.reshape(-1, 3), regularization
        )

    def point_flow(
        self,
        targets: Float[Array, "n 3"],
        sources: Float[Array, "p 3"],
        forces: Float[Array, "p 3"],
        regularization: Array,
    ) -> Float[Array, "n 3"]:
        """The flow of point forces (N), summed: N/m. For targets that are not close to sources."""
        free = kernels.point_flow(targets, sources, forces, regularization)
        return _sum(free, self.boundary_point_flow(targets, sources, forces, regularization))

    def segment_flow(
        self,
        targets: Float[Array, "n 3"],
        starts: Float[Array, "s 3"],
        ends: Float[Array, "s 3"],
        at_start: Float[Array, "s 3"],
        at_end: Float[Array, "s 3"],
        regularization: Array,
    ) -> Float[Array, "n 3"]:
        """The flow of segments, summed over them: N/m.

        Args:
            targets: m, where it is wanted.
            starts: m, of the segments.
            ends: m.
            at_start: N, the force density at the start of each segment times its length; it goes
                linearly along the segment,
            at_end: N, to this at its end.
            regularization: m.
        """
        segments = starts, ends, at_start, at_end
        free = kernels.segment_flow(targets, *segments, regularization)
        return _sum(free, self.boundary_segment_flow(targets, *segments, regularization))

    def segment_pull(
        self,
        targets: Float[Array, "n 3"],
        starts: Float[Array, "s 3"],
        ends: Float[Array, "s 3"],
        at_targets: Float[Array, "n 3"],
        regularization: Array,
    ) -> tuple[Float[Array, "s 3"], Float[Array, "s 3"]]:
        """The transpose of `segment_flow`: from a vector at every target to one at the start and
        one at the end of every segment."""

        def added(at_start: Array, at_end: Array) -> Float[Array, "n 3"] | None:
            segments = starts, ends, at_start, at_end
            return self.boundary_segment_flow(targets, *segments, regularization)

        free = kernels.segment_pull(targets, starts, ends, at_targets, regularization)
        if jax.eval_shape(added, starts, ends) is None:
            return free
        more = jax.linear_transpose(added, starts, ends)(at_targets)
        return free[0] + more[0], free[1] + more[1]

    def segment_kernels(
        self,
        targets: Float[Array, "n 3"],
        starts: Float[Array, "s 3"],
        ends: Float[Array, "s 3"],
        regularization: Array,
    ) -> tuple[kernels.Components, kernels.Components]:
        """M1 and M2 (1/m) of every segment at every target: `segment_flow` is
        M1 at_start + M2 at_end. Each component is (n, s).

        What the boundary adds is found segment by segment, from unit densities.
        """

        def of_one(start: Array, end: Array) -> Float[Array, "6 n 3"] | None:
            def added(densities: Float[Array, "2 3"]) -> Float[Array, "n 3"] | None:
                at_start, at_end = densities[:, None]
                segment = start[None], end[None], at_start, at_end
                return self.boundary_segment_flow(targets, *segment, regularization)

            return jax.vmap(added)(jnp.eye(6).reshape(6, 2, 3))

        m1, m2 = kernels.segment_kernels(targets, starts, ends, regularization)
        added = jax.vmap(of_one)(starts, ends)
        if added is None:
            return m1, m2
        added = added.transpose(3, 1, 2, 0)  # directions of flow, unit densities, targets, segments

        def with_added(free: kernels.Components, more: Float[Array, "3 3 n s"]) -> Any:
            return jax.tree.map(jnp.add, free, tuple(tuple(row) for row in more))

        return with_added(m1, added[:, :3]), with_added(m2, added[:, 3:])


def _sum(free: Array, added: Array | None) -> Array:
    return free if added is None else free + added


@pytree
class FreeSpace(Domain):
    """Fluid without an end."""

    def boundary_point_flow(
        self,
        targets: Float[Array, "n 3"],
        sources: Float[Array, "p 3"],
        forces: Float[Array, "p 3"],
        regularization: Array,
    ) -> None:
        return None


FREE_SPACE = FreeSpace()
