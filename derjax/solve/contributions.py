"""What the incremental potential of a step is made of: contributions of a few simple forms.

Asked for its share at the start of a step, every physical ingredient answers with

- `Elements`: a scalar function of a few degrees of freedom, repeated over many stencils
  (energies of edges and hinges, local drag); differentiated by JAX;
- `Pairs`: the same over stencils that are found anew in every step (contact, friction);
- `Quadratic`: a dense matrix acting on a displacement (hydrodynamic resistance);
- `Diagonal`: the same with a diagonal matrix (inertia);
- `Load`: a constant force (gravity, drag evaluated at the old state).

All are a `Contribution`, whose methods are all that solvers know of them; so may be a form of
your own.
"""

from collections.abc import Callable, Hashable, Sequence
from typing import Any, ClassVar, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..core.pytree import Indices, pytree, replace, static
from .local import ElementPotential, LocalPotential

T = TypeVar("T")
Dofs = Float[Array, " d"]
Matrix = Float[Array, "d d"]


def _add_blocks(matrix: Matrix, dofs: Int[Any, "b k"], blocks: Float[Array, "b k k"]) -> Matrix:
    """With a small matrix added at the degrees of freedom of every element."""
    return matrix.at[dofs[:, :, None], dofs[:, None, :]].add(blocks)


LocalHessians = tuple[tuple[Any, Float[Array, "b k k"]], ...]
"""Small matrices, each with the degrees of freedom (b, k) that it stands for."""


class Guard(Protocol):
    """What must hold all the way from the start of a step to its end."""

    def max_step(self, q: Dofs, direction: Dofs) -> Array:
        """The part, at most 1, of the way along `direction` that may be gone in one go."""
        ...

    def status(self, q: Dofs) -> Array:
        """What is wrong with a step that ends at `q`: `Status.OK` if nothing is."""
        ...


class Contribution:
    """A share of the incremental potential: what a solver may ask of it.

    A new form is a pytree that derives from this class and has `value`, `gradient` and
    `local_hessians`, or `diagonal`, or both: they add up to its second derivative. All solvers
    take it then.

    Attributes:
        symmetric: whether the force is the derivative of a potential, `value`.
        guard: what a solver must not violate on its way; None if there is nothing.
        scattered: whether the second derivative is made of many small matrices.
    """

    symmetric: bool = True
    guard: Guard | None = None
    scattered: ClassVar[bool] = False

    def value(self, q: Dofs) -> Array:
        """J."""
        raise NotImplementedError(f"{type(self).__name__} has no value")

    def gradient(self, q: Dofs) -> Dofs:
        """The derivative of `value` (N and N m): minus the force."""
        raise NotImplementedError(f"{type(self).__name__} has no gradient")

    def value_and_gradient(self, q: Dofs) -> tuple[Array, Dofs]:
        """Both at once."""
        return self.value(q), self.gradient(q)

    def local_hessians(self, q: Dofs) -> LocalHessians:
        """The second derivative (N/m and so on), but for `diagonal`, as small matrices."""
        raise NotImplementedError(f"{type(self).__name__} has no second derivative")

    def diagonal(self, q: Dofs) -> Dofs:
        """What else there is on the diagonal of the second derivative."""
        return jnp.zeros_like(q)

    def add_hessian(self, matrix: Matrix, q: Dofs) -> Matrix:
        """A dense matrix with the second derivative added."""
        for dofs, blocks in self.local_hessians(q):
            matrix = _add_blocks(matrix, dofs, blocks)
        return matrix + jnp.diag(self.diagonal(q))

    @property
    def kind(self) -> Hashable:
        """What contributions share that can be `joined` into one; None if none can."""
        return None

    @classmethod
    def joined(cls, parts: Sequence[Any]) -> "Contribution":
        """The sum of contributions of one `kind` as one of them."""
        raise NotImplementedError(f"{cls.__name__} cannot be joined")


@pytree
class Elements(Contribution):
    """`sum_b potential(q[dofs[b]], data[b])`.

    Attributes:
        dofs: (b, k) degrees of freedom that each element sees.
        potential: `(local (k,), data) -> scalar` in J, with its derivatives.
        data: pytree of arrays with leading axis b.
    """

    dofs: Indices = static()
    potential: ElementPotential = static()
    data: Any

    scattered: ClassVar[bool] = True

    def value(self, q: Dofs) -> Array:
        return jnp.sum(jax.vmap(self.potential)(q[self.dofs.array], self.data))

    def gradient(self, q: Dofs) -> Dofs:
        local = jax.vmap(self.potential.gradient)(q[self.dofs.array], self.data)
        return jnp.zeros_like(q).at[self.dofs.array].add(local)

    def local_hessians(self, q: Dofs) -> LocalHessians:
        """Of every element."""
        blocks = jax.vmap(self.potential.hessian)(q[self.dofs.array], self.data)
        return ((self.dofs.array, blocks),)

    def add_hessian(self, matrix: Matrix, q: Dofs) -> Matrix:
        ((dofs, blocks),) = self.local_hessians(q)
        return _add_blocks(matrix, dofs, blocks)

    @property
    def kind(self) -> Hashable:
        """Elements on one stencil are differentiated together."""
        return self.dofs, type(self.potential)

    @classmethod
    def joined(cls, parts: Sequence["Elements"]) -> "Elements":
        first = parts[0]
        together = type(first.potential).merge([(e.potential, e.data) for e in parts])
        return cls(first.dofs, *together)


@pytree
class Pairs(Contribution):
    """`sum_b potential(q[dofs[b]], data[b])` over those b in the `mask`.

    Like `Elements`, but what interacts is a result of the computation: a list of fixed length,
    not all of whose places are in use. Nothing is computed while none is.

    Attributes:
        dofs: (b, k) degrees of freedom that each element sees.
        mask: (b,) which places of the list are in use.
        potential: `(local (k,), data) -> scalar` in J, with its derivatives.
        data: pytree of arrays with leading axis b.
        guard: what the solver must not violate on its way; None if there is nothing.
    """

    dofs: Int[Array, "b k"]
    mask: Bool[Array, " b"]
    potential: LocalPotential = static()
    data: Any
    guard: Guard | None = None

    scattered: ClassVar[bool] = True

    def _each(self, q: Dofs, function: Callable[[Array, Any], T]) -> T:
        """(b, ...) the elements' `function`, zero in places that are not in use."""

        def only_used(local: Array) -> Array:
            return jnp.where(self.mask.reshape(-1, *([1] * (local.ndim - 1))), local, 0.0)

        return jax.tree.map(only_used, jax.vmap(function)(q[self.dofs], self.data))

    def _if_any(self, compute: Callable[[], T], nothing: T) -> T:
        return lax.cond(jnp.any(self.mask), compute, lambda: nothing)

    def value(self, q: Dofs) -> Array:
        return self._if_any(lambda: jnp.sum(self._each(q, self.potential)), jnp.zeros(()))

    def gradient(self, q: Dofs) -> Dofs:
        zero = jnp.zeros_like(q)
        return self._if_any(
            lambda: zero.at[self.dofs].add(self._each(q, self.potential.gradient)), zero
        )

    def value_and_gradient(self, q: Dofs) -> tuple[Array, Dofs]:
        zero = jnp.zeros_like(q)

        def both() -> tuple[Array, Dofs]:
            value, local = self._each(
                q, lambda x, data: (self.potential(x, data), self.potential.gradient(x, data))
            )
            return jnp.sum(value), zero.at[self.dofs].add(local)

        return self._if_any(both, (jnp.zeros(()), zero))

    def local_hessians(self, q: Dofs) -> LocalHessians:
        """Of every place of the list."""
        size = self.dofs.shape[1]
        nothing = jnp.zeros((len(self.dofs), size, size))
        blocks = self._if_any(lambda: self._each(q, self.potential.hessian), nothing)
        return ((self.dofs, blocks),)

    def add_hessian(self, matrix: Matrix, q: Dofs) -> Matrix:
        return self._if_any(
            lambda: _add_blocks(matrix, self.dofs, self._each(q, self.potential.hessian)), matrix
        )


class ContactPotential(LocalPotential, Protocol):
    """One that depends on an overlap p (m) alone, as a convex function of it."""

    def overlap(self, local: Array, data: Any) -> tuple[Array, Array]:
        """p, negative where nothing touches, and its derivatives (k,)."""
        ...

    def may_meet(self, overlap: Array, data: Any) -> Array:
        """Whether a pair is so close that it may touch a little later."""
        ...

    def force(self, overlap: Array, data: Any) -> Array:
        """N, the derivative of the energy with respect to the overlap."""
        ...

    def stiffness(self, overlap: Array, data: Any) -> Array:
        """N/m, the second derivative."""
        ...

    def curvature(self, local: Array, data: Any) -> Array:
        """(k, k) force times the second derivative of the overlap, for a force that can be."""
        ...


@pytree
class Contacts(Pairs):
    """Pairs that repel each other where they overlap: stiff, and from one moment to the next.

    A tangent of such a force tells nothing of it: a pair that is just apart has none. Solvers may
    ask for the law itself, and keep to the derivatives of `Pairs` otherwise.
    """

    potential: ContactPotential = static()

    def overlaps(self, q: Dofs) -> tuple[Float[Array, " b"], Float[Array, "b k"]]:
        """The overlaps (m) and their derivatives; those not in use are far from touching."""
        p, slope = jax.vmap(self.potential.overlap)(q[self.dofs], self.data)
        return jnp.where(self.mask, p, -1.0), jnp.where(self.mask[:, None], slope, 0.0)

    def add_curvatures(self, matrix: Matrix, q: Dofs) -> Matrix:
        """A dense matrix with the part of the second derivative that has no stiffness in it."""
        return self._if_any(
            lambda: _add_blocks(matrix, self.dofs, self._each(q, self.potential.curvature)), matrix
        )

    def split(self, q: Dofs, most: int) -> tuple["Contacts", "Contacts"]:
        """The closest pairs, up to some number, and a list of the same length of the others.

        Pairs that are far from touching are in neither: nothing comes of them.
        """
        size = min(most, len(self.dofs))
        every, _ = self.overlaps(q)
        overlaps, chosen = lax.top_k(every, size)
        data = jax.tree.map(lambda leaf: leaf[chosen], self.data)
        mask = self.mask[chosen] & jax.vmap(self.potential.may_meet)(overlaps, data)
        near = replace(self, dofs=self.dofs[chosen], mask=mask, data=data)
        touching = self.mask & (every > 0.0)
        return near, replace(self, mask=touching.at[chosen].set(touching[chosen] & ~mask))

    def forces(self, overlaps: Float[Array, " b"]) -> Float[Array, " b"]:
        """N."""
        return jax.vmap(self.potential.force)(overlaps, self.data)

    def stiffnesses(self, overlaps: Float[Array, " b"]) -> Float[Array, " b"]:
        """N/m."""
        return jax.vmap(self.potential.stiffness)(overlaps, self.data)


class Operator(Protocol):
    """A linear map of displacements to forces (N/m)."""

    def matrix(self) -> Float[Array, "m m"]:
        """The map as a matrix; its derivatives are never taken."""
        ...

    def mv(self, displacement: Float[Array, " m"]) -> Float[Array, " m"]:
        """The force for a displacement, differentiable in everything that it depends on."""
        ...


@pytree
class Quadratic(Contribution):
    """`1/2 u^T operator u` of the displacement u = q - origin of some degrees of freedom.

    With `symmetric=False` there is no potential, only the force `operator u`, and the line
    search goes by the residual.

    Attributes:
        dofs: (m,) degrees of freedom the operator acts on.
        operator: N/m.
        origin: (d,) m and rad.
    """

    dofs: Indices = static()
    symmetric: bool = static()
    operator: Operator
    origin: Dofs

    def value(self, q: Dofs) -> Array:
        local = (q - self.origin)[self.dofs.array]
        return 0.5 * local @ self.operator.mv(local)

    def gradient(self, q: Dofs) -> Dofs:
        local = (q - self.origin)[self.dofs.array]
        return jnp.zeros_like(q).at[self.dofs.array].add(self.operator.mv(local))

    def local_hessians(self, q: Dofs) -> LocalHessians:
        """One element that sees all the degrees of freedom."""
        return ((self.dofs.array[None], self.operator.matrix()[None]),)

    def add_hessian(self, matrix: Matrix, q: Dofs) -> Matrix:
        dofs, block = self.dofs.array, self.operator.matrix()
        first, size = int(dofs[0]), len(dofs)
        if np.array_equal(dofs, first + np.arange(size)):  # quicker than a scatter
            rest = (first, q.size - first - size)
            return matrix + jnp.pad(block, (rest, rest))
        return matrix.at[dofs[:, None], dofs[None, :]].add(block)


@pytree
class Diagonal(Contribution):
    """`1/2 sum_i weight_i (q_i - origin_i)^2`.

    Attributes:
        weight: (d,) N/m and N m.
        origin: (d,) m and rad.
    """

    weight: Dofs
    origin: Dofs

    def value(self, q: Dofs) -> Array:
        return 0.5 * jnp.sum(self.weight * (q - self.origin) ** 2)

    def gradient(self, q: Dofs) -> Dofs:
        return self.weight * (q - self.origin)

    def local_hessians(self, q: Dofs) -> LocalHessians:
        return ()

    def diagonal(self, q: Dofs) -> Dofs:
        return self.weight


@pytree
class Load(Contribution):
    """`-force . q`: a force that does not change during the step.

    Attributes:
        force: (d,) N and N m.
    """

    force: Dofs

    def value(self, q: Dofs) -> Array:
        return -self.force @ q

    def gradient(self, q: Dofs) -> Dofs:
        return -self.force

    def local_hessians(self, q: Dofs) -> LocalHessians:
        return ()

    def add_hessian(self, matrix: Matrix, q: Dofs) -> Matrix:
        return matrix


class MobilityOperator(Protocol):
    """A symmetric linear map of forces on wet nodes (N) to their velocities (m/s)."""

    @property
    def resistance(self) -> Float[Array, "b k k"]:
        """Of every block as if it were alone, N s/m."""
        ...

    @property
    def coarse(self) -> "MobilityOperator":
        """Nearly the same map, and quicker: good enough for Newton's directions."""
        ...

    def mv(self, force: Float[Array, " m"]) -> Float[Array, " m"]:
        """The velocities for forces, differentiable in everything that they depend on."""
        ...

    def precondition(self, velocity: Float[Array, " m"]) -> Float[Array, " m"]:
        """Roughly the forces for velocities, those of every block as if it were alone."""
        ...


@pytree
class Mobility:
    """Drag known by what forces do: the displacement u = q - origin is `time law(force)`.

    It is no `Contribution`, but stands beside the potential that those make. For `Quadratic` the
    law would have to be inverted, which large robots cannot afford. The forces are unknowns of
    their own; see `saddle`.

    Attributes:
        dofs: (m,) the degrees of freedom that are dragged.
        law: of force to velocity.
        origin: (d,) m and rad.
        time: s.
    """

    dofs: Indices = static()
    law: MobilityOperator
    origin: Dofs
    time: Float[Array, ""]
