"""Scalar functions of the few degrees of freedom of one element, with their derivatives."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array


class LocalPotential(Protocol):
    """A scalar function (J) of the few degrees of freedom of one element."""

    def __call__(self, local: Array, data: Any) -> Array: ...

    def gradient(self, local: Array, data: Any) -> Array: ...

    def hessian(self, local: Array, data: Any) -> Array: ...


class ElementPotential(LocalPotential, Protocol):
    """One that can be added up with others of its kind before it is differentiated."""

    @classmethod
    def merge(cls, parts: Sequence[tuple[Any, Any]]) -> tuple["ElementPotential", Any]:
        """One potential, and its data, for the sum of several (potential, data)."""
        ...


class Sum(tuple):
    """A sum of functions whose last argument is a tuple of data, one for each of them."""

    def __call__(self, *arguments: Any) -> Array:
        *shared, data = arguments
        return jnp.asarray(sum(f(*shared, d) for f, d in zip(self, data, strict=True)))


@dataclass(frozen=True)
class Autodiff:
    """A scalar function with the derivatives that JAX finds."""

    function: Callable[[Array, Any], Array]

    def __call__(self, local: Array, data: Any) -> Array:
        return self.function(local, data)

    def gradient(self, local: Array, data: Any) -> Array:
        return jax.grad(self.function)(local, data)

    def hessian(self, local: Array, data: Any) -> Array:
        return jax.hessian(self.function)(local, data)

    @classmethod
    def merge(cls, parts: Sequence[tuple["Autodiff", Any]]) -> tuple["Autodiff", Any]:
        return cls(Sum(p.function for p, _ in parts)), tuple(data for _, data in parts)


@dataclass(frozen=True)
class QuadraticForm:
    """`1/2 u . A u` of the displacement u = local - origin, for data (origin (k,), A (k, k)).

    What local drag makes of a step: A is its resistance (N s/m) over the length of the step.
    """

    def __call__(self, local: Array, data: tuple[Array, Array]) -> Array:
        origin, a = data
        return 0.5 * (local - origin) @ a @ (local - origin)

    def gradient(self, local: Array, data: tuple[Array, Array]) -> Array:
        origin, a = data
        return a @ (local - origin)

    def hessian(self, local: Array, data: tuple[Array, Array]) -> Array:
        return data[1]

    @classmethod
    def merge(cls, parts: Sequence[tuple["QuadraticForm", Any]]) -> tuple["QuadraticForm", Any]:
        """Every drag of a stage is measured from the same origin."""
        origin = parts[0][1][0]
        return cls(), (origin, jnp.asarray(sum(a for _, (_, a) in parts)))
