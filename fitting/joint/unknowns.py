"""All numbers that a fit estimates, in one row: what is fitted, and what is not known besides."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import jax
import numpy as np
from jaxtyping import Float

from derjax import InputError
from derjax.scenes.extensions import unit_of

from ..transforms import Transform, Whole, select_parameters
from .file import KnownPrior, Prior

Free = Float[np.ndarray, " p"]


@dataclass(frozen=True)
class Unknown:
    """One number.

    Attributes:
        name: `C_t`, or `C_t of run1` for one of its own, or `run1: drift x`.
        transform: from the real line, on which a search goes.
        start: value at the start.
        unit: of the value.
        mean, std: what is known beforehand; None for nothing.
        fitted: whether it was asked for, and is not there for the sake of others.
    """

    name: str
    transform: Transform
    start: float
    unit: str
    mean: float | None = None
    std: float | None = None
    fitted: bool = False


@dataclass
class Unknowns:
    """The numbers of a fit, which parts of it ask for by name while it is put together."""

    every: list[Unknown] = field(default_factory=list)

    def index(self, unknown: Unknown) -> int:
        """The place of a number, which is new or has been asked for before."""
        for k, known in enumerate(self.every):
            if known.name == unknown.name:
                return k
        self.every.append(unknown)
        return len(self.every) - 1

    def named(self, name: str) -> int:
        """The place of a number that is there."""
        return next(k for k, known in enumerate(self.every) if known.name == name)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(one.name for one in self.every)

    @property
    def fitted(self) -> np.ndarray:
        """(p,) which numbers were asked for."""
        return np.array([one.fitted for one in self.every], bool)

    def start(self) -> Free:
        """(p,) free numbers at the start."""
        return np.array([one.transform.free(one.start) for one in self.every], float)

    def values(self, free: Free) -> np.ndarray:
        """(p,) in their units."""
        pairs = zip(self.every, free, strict=True)
        return np.array([float(one.transform.value(z)) for one, z in pairs])

    def slopes(self, free: Free) -> np.ndarray:
        """(p,) derivative of every value by its free number."""
        pairs = zip(self.every, free, strict=True)
        return np.array([float(jax.grad(one.transform.value)(float(z))) for one, z in pairs])


def of_prior(name: str, prior: Prior | None, start: float, scale: float, unit: str) -> Unknown:
    """A nuisance that may take every value, with its prior.

    Args:
        name: of the number.
        prior: what is known; its mean is the start where it has none.
        start: value.
        scale: a change that is neither large nor small.
        unit: of the value.
    """
    std = None if prior is None else prior.std
    mean = start if prior is None or prior.mean is None else prior.mean
    return Unknown(name, Whole(scale), mean, unit, None if std is None else mean, std)


def fitted_unknowns(
    names: Sequence[str],
    known: Mapping[str, float],
    initial: Mapping[str, float],
    priors: Mapping[str, KnownPrior],
    owner: str | None = None,
    own: Iterable[str] = (),
) -> dict[str, Unknown]:
    """The parameters that are fitted, as a run of some name has them.

    Args:
        names: of parameters.
        known: numbers of the scene.
        initial: where to start.
        priors: by name.
        owner: the run.
        own: parameters of which it has a value of its own.

    Raises:
        InputError: a name that there is not, a start out of range.
    """
    chosen = select_parameters(names, known)
    if unknown := set(own) - set(names):
        raise InputError(
            f"{owner}: own = {min(unknown)!r}: is not among the parameters that are fitted "
            f"({', '.join(names)})"
        )
    found = {}
    for name, transform in zip(names, chosen.transforms, strict=True):
        start = float({**known, **initial}[name])
        chosen.free({**{n: float(known[n]) for n in names}, name: start})
        prior = priors.get(name)
        found[name] = Unknown(
            f"{name} of {owner}" if name in own else name,
            transform,
            start,
            unit_of(name),
            None if prior is None else prior.mean,
            None if prior is None else prior.std,
            fitted=True,
        )
    return found
