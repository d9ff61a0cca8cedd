"""The incremental potential of a step, as a sum of contributions of four simple forms.

Asked for its share at the start of a step, every physical ingredient answers with

- `Elements`: a scalar function of a few degrees of freedom, repeated over many stencils
  (energies of edges and hinges, local drag, contact); differentiated by JAX;
- `Quadratic`: a dense matrix acting on a displacement (hydrodynamic resistance);
- `Diagonal`: the same with a diagonal matrix (inertia);
- `Load`: a constant force (gravity, drag evaluated at the old state).

The step knows nothing of physics: it finds where the gradient of the sum vanishes.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .pytree import Indices, pytree, static

Dofs = Float[Array, " d"]
Matrix = Float[Array, "d d"]


@pytree
class Elements:
    """`sum_b potential(q[dofs[b]], data[b])`, with `potential` a scalar function of JAX.

    Attributes:
        dofs: (b, k) degrees of freedom that each element sees.
        potential: `(local (k,), data) -> scalar` in J.
        data: pytree of arrays with leading axis b.
    """

    dofs: Indices = static()
    potential: Callable[[Array, Any], Array] = static()
    data: Any

    def value(self, q: Dofs) -> Array:
        return jnp.sum(jax.vmap(self.potential)(q[self.dofs.array], self.data))

    def gradient(self, q: Dofs) -> Dofs:
        local = jax.vmap(jax.grad(self.potential))(q[self.dofs.array], self.data)
        return jnp.zeros_like(q).at[self.dofs.array].add(local)

    def hessian(self, q: Dofs) -> Matrix:
        local = jax.vmap(jax.hessian(self.potential))(q[self.dofs.array], self.data)
        rows, columns = self.dofs.array[:, :, None], self.dofs.array[:, None, :]
        return jnp.zeros((q.size, q.size), q.dtype).at[rows, columns].add(local)


@pytree
class Quadratic:
    """`1/2 (q - origin)^T matrix (q - origin)` on some of the degrees of freedom.

    With `symmetric=False` there is no potential, only the force `matrix (q - origin)`, and
    the line search goes by the residual.

    Attributes:
        dofs: (m,) degrees of freedom the matrix acts on.
        matrix: (m, m) N/m.
        origin: (d,) m and rad.
    """

    dofs: Indices = static()
    symmetric: bool = static()
    matrix: Float[Array, "m m"]
    origin: Dofs

    def value(self, q: Dofs) -> Array:
        local = (q - self.origin)[self.dofs.array]
        return 0.5 * local @ (self.matrix @ local)

    def gradient(self, q: Dofs) -> Dofs:
        local = (q - self.origin)[self.dofs.array]
        return jnp.zeros_like(q).at[self.dofs.array].add(self.matrix @ local)

    def hessian(self, q: Dofs) -> Matrix:
        rows, columns = self.dofs.array[:, None], self.dofs.array[None, :]
        return jnp.zeros((q.size, q.size), q.dtype).at[rows, columns].add(self.matrix)


@pytree
class Diagonal:
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

    def hessian(self, q: Dofs) -> Matrix:
        return jnp.diag(self.weight)


@pytree
class Load:
    """`-force . q`: a force that does not change during the step.

    Attributes:
        force: (d,) N and N m.
    """

    force: Dofs

    def value(self, q: Dofs) -> Array:
        return -self.force @ q

    def gradient(self, q: Dofs) -> Dofs:
        return -self.force

    def hessian(self, q: Dofs) -> Matrix | float:
        return 0.0


Contribution = Elements | Quadratic | Diagonal | Load


@pytree
class Potential:
    """The sum of the contributions to one step."""

    contributions: tuple[Contribution, ...]

    @property
    def symmetric(self) -> bool:
        """Whether every contribution derives from a potential."""
        return all(c.symmetric for c in self.contributions if isinstance(c, Quadratic))

    def value(self, q: Dofs) -> Array:
        return jnp.asarray(sum(c.value(q) for c in self.contributions))

    def gradient(self, q: Dofs) -> Dofs:
        return jnp.asarray(sum(c.gradient(q) for c in self.contributions))

    def hessian(self, q: Dofs) -> Matrix:
        return jnp.asarray(sum(c.hessian(q) for c in self.contributions))


def gather(contributions: Sequence[Contribution]) -> Potential:
    """The potential of a step; elements on the same stencil are differentiated together."""
    merged: list[Contribution] = []
    by_stencil: dict[Indices, list[Elements]] = {}
    for contribution in contributions:
        if isinstance(contribution, Elements):
            by_stencil.setdefault(contribution.dofs, []).append(contribution)
        else:
            merged.append(contribution)
    for dofs, group in by_stencil.items():
        if len(group) == 1:
            merged.append(group[0])
        else:
            potential = _Sum(tuple(element.potential for element in group))
            merged.append(Elements(dofs, potential, tuple(element.data for element in group)))
    return Potential(tuple(merged))


class _Sum(tuple):
    """A sum of element potentials that share a stencil; hashable, so that it can be static."""

    def __call__(self, local: Array, data: tuple[Any, ...]) -> Array:
        return jnp.asarray(sum(f(local, d) for f, d in zip(self, data, strict=True)))
