"""Parameters that may take every real value, so that no search can leave their range."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from derjax.core.errors import InputError
from derjax.scenes.parameters import index_of


class Transform(Protocol):
    """A smooth, increasing map from the real line onto the range of a parameter."""

    def value(self, free: Array) -> Array:
        """The parameter, in its own unit, at a point of the real line."""
        ...

    def free(self, value: float) -> float:
        """The inverse of `value`; not finite for a parameter outside the open range."""
        ...


@dataclass(frozen=True)
class Log:
    """Positive numbers: value = exp(free), so that steps of `free` are relative changes."""

    def value(self, free: Array) -> Array:
        return jnp.exp(free)

    def free(self, value: float) -> float:
        return float(np.log(value)) if value > 0 else float("nan")


@dataclass(frozen=True)
class Whole:
    """Any number, in units of `scale`."""

    scale: float = 1.0

    def value(self, free: Array) -> Array:
        return self.scale * free

    def free(self, value: float) -> float:
        return value / self.scale


@dataclass(frozen=True)
class Interval:
    """Numbers between `low` and `high`: a logistic function of `free`."""

    low: float
    high: float

    def value(self, free: Array) -> Array:
        return self.low + (self.high - self.low) * jax.nn.sigmoid(free)

    def free(self, value: float) -> float:
        if not self.low < value < self.high:
            return float("nan")
        return float(np.log(value - self.low) - np.log(self.high - value))


@dataclass(frozen=True)
class Parameters:
    """Named parameters and how each is made free. Hashable, so that it can be static.

    Attributes:
        names: keys of `SceneFile.single_numbers`.
        transforms: one for each name.
    """

    names: tuple[str, ...]
    transforms: tuple[Transform, ...]

    def values(self, free: Float[Array, " p"]) -> dict[str, Array]:
        """The parameters by name, in the units of the scene, at a free vector."""
        pairs = zip(self.names, self.transforms, strict=True)
        return {name: transform.value(free[i]) for i, (name, transform) in enumerate(pairs)}

    def free(self, values: Mapping[str, float]) -> np.ndarray:
        """(p,): the free vector of `values`.

        Raises:
            InputError: a value that is not inside the range of its parameter.
        """
        free = [t.free(float(values[n])) for n, t in zip(self.names, self.transforms, strict=True)]
        for name, transform, z in zip(self.names, self.transforms, free, strict=True):
            if not np.isfinite(z):
                range_ = "positive"
                if isinstance(transform, Interval):
                    range_ = f"between {transform.low:g} and {transform.high:g}"
                raise InputError(f"{name} = {values[name]:g}: must be {range_}")
        return np.array(free)

    def slopes(self, free: Float[np.ndarray, " p"]) -> np.ndarray:
        """(p,): derivative of every value with respect to its free coordinate."""
        return np.array(
            [jax.grad(t.value)(z) for t, z in zip(self.transforms, free, strict=True)]
        ).reshape(-1)


def select_parameters(names: Sequence[str], known: Mapping[str, object]) -> Parameters:
    """The parameters `names` of a scene, positive ones on a logarithmic scale.

    Args:
        names: which.
        known: the parameters that the scene has.

    Raises:
        InputError: a name that is unknown, given twice, or not one to be fitted.
    """
    if not names:
        raise InputError("no parameters to fit")
    fittable = [name for name in known if index_of(name)[0] != "rpm"]
    for i, name in enumerate(names):
        if index_of(name)[0] == "rpm":
            raise InputError("rpm cannot be fitted: every run has its own motor_rpm")
        if name not in fittable:
            raise InputError(f"no parameter {name!r}; the scene has {', '.join(fittable)}")
        if name in names[:i]:
            raise InputError(f"parameter {name!r} is given twice")
        base, place = index_of(name)
        if place is not None and base in names:
            raise InputError(f"{base} is that of all flagella: fit it, or {name} and others")
    special = {"poisson_ratio": Interval(-1.0, 0.5), "phase": Whole()}
    chosen = (special.get(index_of(name)[0], Log()) for name in names)
    return Parameters(tuple(names), tuple(chosen))
