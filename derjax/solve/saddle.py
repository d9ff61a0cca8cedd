"""The step of a large robot: its position and the fluid's forces are unknowns together.

With the drag force f on the wet degrees of freedom as an unknown of its own, the equations of a
stage,

    grad E(q) + f = 0,        u = q - q~ = l A f   (wet),

need the mobility A only in products. They are the conditions for a saddle of

    E(q) + f . (q - q~) - l/2 f . A f .

Newton's linear systems are solved by GMRES (Saad & Schultz, SIAM J. Sci. Stat. Comput. 7, 856,
1986) with the same equations without what couples blocks that are not neighbours on a filament:

    (K + R/l) dq = b + R rho/l,        df = R (dq - rho)/l,

R being the inverse of the mobility of every block by itself, K that part of the second derivative
of E, and b, rho what is wanted of the two equations.

In Newton's method A is a coarse one in these systems (`MobilityOperator.coarse`). That costs some
more iterations, of which each takes one product with A itself, for what is left of the equations;
what they end at is the same. Derivatives are solved for with A itself.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..core.pytree import Indices, pytree, static
from .blocks import BlockFactor, Layout, SmallMatrices, assemble, factor_blocks
from .contributions import Dofs, Mobility, MobilityOperator
from .gmres import gmres
from .potential import Potential

ROUGH, EXACT = 1e-2, 1e-13
"""By how much GMRES lowers the residual: in Newton's method, where the coarse far field leaves as
much anyway, and for derivatives."""

WORST = 1e-6
"""The residual with which a derivative is still one: it is better known to be none than wrong."""

PRODUCTS = 80
"""Of GMRES, at the most: many where filaments touch, which the preconditioner knows nothing of."""

ENOUGH = 8.0
"""Times s . R s / l is more than s . A^-1 s / 2 l, also where filaments nearly touch: there the
fluid hardly lets them move apart."""

Unknowns = Float[Array, " d+m"]


@pytree
class SaddlePointSystem:
    """The equations of a stage, for the unknowns (q, f); see the module.

    The second equation is multiplied with a typical resistance over l, which makes forces of it.

    Attributes:
        potential: E, with all that is not the fluid's non-local drag; symmetric.
        drag: the fluid's.
        layout: the blocks.
        held: (d,) where the degrees of freedom that are not free are, m and rad.
        free: (d,) 1 for those that are.
        scale: (d,) N and N m, what forces and torques are measured in.
    """

    potential: Potential
    drag: Mobility
    layout: Layout = static()
    held: Dofs
    free: Dofs
    scale: Dofs

    max_chord_steps = 8
    """Steps that one may still have to take with a matrix that is out of date. Close to the
    solution it is the coarse far field that limits what a step gains, and not the matrix's age."""

    @property
    def symmetric(self) -> bool:
        return self.potential.symmetric

    @property
    def guards(self) -> tuple[Any, ...]:
        return self.potential.guards

    def split(self, z: Unknowns) -> tuple[Dofs, Float[Array, " m"]]:
        """q and f."""
        d = self.held.size
        return z[:d], z[d:]

    def join(self, q: Dofs, f: Float[Array, " m"]) -> Unknowns:
        return jnp.concatenate([q, f])

    def start(self, q: Dofs) -> Unknowns:
        """q with about the forces that the second equation has for it."""
        velocity = (q - self.drag.origin)[self.drag.dofs.array] / self.drag.time
        return self.join(q, drag_forces(self.drag.law.coarse, velocity, ROUGH))

    @property
    def scales(self) -> Unknowns:
        """What residuals of both equations are measured in."""
        return self.join(self.scale, self.scale[self.drag.dofs.array])

    def max_step(self, z: Unknowns, direction: Unknowns) -> Array:
        return self.potential.max_step(self.split(z)[0], self.split(direction)[0])

    def status(self, z: Unknowns) -> Array:
        return self.potential.status(self.split(z)[0])

    @property
    def stiffness(self) -> Array:
        """What makes forces of displacements in the second equation, N/m."""
        diagonal = jnp.diagonal(self.drag.law.resistance, axis1=1, axis2=2)
        return lax.stop_gradient(jnp.mean(diagonal) / self.drag.time)

    def _spread(self, f: Float[Array, " m"]) -> Dofs:
        """A vector over the wet degrees of freedom as one over all."""
        return jnp.zeros_like(self.held).at[self.drag.dofs.array].add(f)

    def gradient(self, z: Unknowns) -> Unknowns:
        """What is left of the two equations; of degrees of freedom that are held, how far they
        are from where they should be."""
        return self._left(z, self.potential.gradient(self.split(z)[0]))

    def _left(self, z: Unknowns, gradient: Dofs) -> Unknowns:
        """`gradient`, where that of E is known."""
        q, f = self.split(z)
        force = gradient + self._spread(f)
        move = (q - self.drag.origin)[self.drag.dofs.array]
        slip = move - self.drag.time * self.drag.law.mv(f)
        return self.join(jnp.where(self.free > 0, force, q - self.held), self.stiffness * slip)

    def value_and_gradient(self, z: Unknowns) -> tuple[Array, Unknowns]:
        """What a solution makes a minimum of, and `gradient`.

        Where the second equation holds, the function of the saddle is the potential of the first
        one, E(q) + u . A^-1 u / 2 l. Where a slip s is left of it, it is smaller by
        s . A^-1 s / 2 l; for that a multiple of s . R s / l is added, which is more. As the
        equation is linear, s is small from the first step on.
        """
        q, f = self.split(z)
        value, gradient = self.potential.value_and_gradient(q)
        gradient = self._left(z, gradient)
        move = (q - self.drag.origin)[self.drag.dofs.array]
        slip = self.split(gradient)[1] / self.stiffness
        missing = ENOUGH * self.drag.law.precondition(slip) @ slip / self.drag.time
        return value + 0.5 * f @ (move + slip) + missing, gradient

    def slope(self, gradient: Unknowns, direction: Unknowns) -> Array:
        """Of that potential: along with q, f changes by itself."""
        force, q = self.split(gradient)[0], self.split(direction)[0]
        return (self.free * force) @ q

    def direction(
        self, matrix: "SaddlePointFactor", z: Unknowns, gradient: Unknowns, free: slice
    ) -> Unknowns:
        """Newton's direction."""
        return -matrix.solve(gradient[free])

    def linearise(
        self, z: Unknowns, sizes: Unknowns, unit: Unknowns, free: None, exact: bool
    ) -> tuple["SaddlePointFactor", Unknowns]:
        """What solves with the Newton matrix at z, and what rounding makes of its forces.

        Raises:
            ValueError: a contribution has no potential, so that the matrix is not symmetric.
        """
        if not self.symmetric:
            raise ValueError(
                "blocks are only for forces that derive from a potential: a contribution with "
                "symmetric=False needs one dense matrix ([solver] method = 'dense')"
            )
        q, _ = self.split(z)
        matrices = SmallMatrices.of(self.potential.local_hessians(q))
        diagonal = self.potential.diagonal(q)
        law = self.drag.law
        drag = law.resistance.reshape(*self.layout.nodes.shape[:2], *law.resistance.shape[1:])
        rough = assemble(self.layout, matrices, diagonal, drag / self.drag.time, self.free)
        size = self.split(sizes)[0]
        rounding = matrices.absolute @ size + diagonal * size
        solver = SaddlePointFactor(
            self,
            matrices,
            diagonal,
            law if exact else law.coarse,
            factor_blocks(rough, self.free * self.split(unit)[0]),
            exact,
        )
        # In the second equation every place is felt everywhere.
        wet = size[self.drag.dofs.array]
        felt = self.stiffness * jnp.full_like(wet, jnp.max(wet, initial=0.0))
        return solver, self.join(rounding, felt)


@pytree
class _Still:
    """The law of a fluid that is not there: no wet degrees of freedom."""

    resistance: Array

    @property
    def coarse(self) -> "_Still":
        return self

    def mv(self, force: Array) -> Array:
        return force

    def precondition(self, velocity: Array) -> Array:
        return velocity


def drag_forces(
    law: MobilityOperator, velocity: Float[Array, " m"], tolerance: float = EXACT
) -> Float[Array, " m"]:
    """The forces (N) with which a fluid resists velocities (m/s), by GMRES."""
    alone = gmres(lambda u: law.mv(law.precondition(u)), velocity, tolerance, PRODUCTS)
    return law.precondition(alone)


def no_drag(layout: Layout) -> Mobility:
    """For a scene without non-local drag."""
    size = 3 * layout.size
    law = _Still(jnp.zeros((layout.nodes[..., 0].size, size, size)))
    nothing = jnp.zeros(layout.topology.n_dofs)
    return Mobility(Indices(np.zeros(0)), law, nothing, jnp.ones(()))


@pytree
class SaddlePointFactor:
    """Solves with the Newton matrix of a `SaddlePointSystem`.

    Attributes:
        saddle: the equations.
        matrices: the second derivative of E, as small matrices.
        diagonal: (d,) and what is diagonal of them.
        law: of force to velocity in the products.
        near: the factor of the preconditioner.
        exact: whether GMRES goes on until the solution is one, or NaN.
    """

    saddle: SaddlePointSystem
    matrices: SmallMatrices
    diagonal: Dofs
    law: MobilityOperator
    near: BlockFactor
    exact: bool = static()

    def _product(self, q: Dofs, f: Array) -> tuple[Dofs, Array]:
        """What changes of q and f do to the two equations: forces, and a displacement (m)."""
        s = self.saddle
        force = self.matrices @ q + self.diagonal * q + s._spread(f)
        slip = q[s.drag.dofs.array] - s.drag.time * self.law.mv(f)
        return jnp.where(s.free > 0, force, q), slip

    def _roughly(self, b: Dofs, slip: Array) -> tuple[Dofs, Array]:
        """The changes of q and f for which the equations of blocks by themselves are met."""
        s = self.saddle
        known = s._spread(s.drag.law.precondition(slip)) / s.drag.time
        held = (1.0 - s.free) * b
        drag = s._spread(s.drag.law.precondition(held[s.drag.dofs.array])) / s.drag.time
        stretched = self.matrices @ held
        b = jnp.where(s.free > 0, b + known - drag - stretched, b)
        q = self.near.solve(b)
        return q, s.drag.law.precondition(q[s.drag.dofs.array] - slip) / s.drag.time

    def _solve(self, b: Dofs, slip: Array) -> tuple[Dofs, Array]:
        """The changes of q and f for which the two equations are met."""
        s = self.saddle
        unit, length = s.scale, s.scale[s.drag.dofs.array] / s.stiffness

        def roughly(given: Unknowns) -> tuple[Dofs, Array]:
            b, slip = s.split(given)
            return self._roughly(unit * b, length * slip)

        def product(given: Unknowns) -> Unknowns:
            force, slip = self._product(*roughly(given))
            return s.join(force / unit, slip / length)

        goal, worst = (EXACT, WORST) if self.exact else (ROUGH, np.inf)
        wanted = s.join(b / unit, slip / length)
        return roughly(gmres(product, wanted, goal, PRODUCTS, worst))

    def solve(self, b: Unknowns) -> Unknowns:
        """Solution z of J z = b."""
        force, pull = self.saddle.split(b)
        return self.saddle.join(*self._solve(force, pull / self.saddle.stiffness))

    def solve_transposed(self, b: Unknowns) -> Unknowns:
        """Solution z of J^T z = b.

        J is symmetric but for the factor of its second equation, and for degrees of freedom
        that are held, which other equations contain but whose own contain nothing else.
        """
        s, stiffness = self.saddle, self.saddle.stiffness
        wanted, slip = s.split(b)
        q, f = self._solve(s.free * wanted, slip)
        # What the free equations contain of those that are held.
        moved = self.matrices @ (s.free * q) + s._spread(f)
        q = jnp.where(s.free > 0, q, wanted - moved)
        return s.join(q, f / stiffness)
