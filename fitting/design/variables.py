"""The numbers that a design may change, and their bounds."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from derjax import InputError, Scene
from derjax.scenes.parameters import index_of

Vector = Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Variables:
    """Parameters of a scene within bounds, as a vector whose entries go from 0 to 1.

    A parameter that is an array, as a motor's rates over time, counts with every entry.

    Attributes:
        start: by name, in the scene's units: numbers or arrays.
        low: the smallest that each may be.
        high: the largest.
    """

    start: Mapping[str, Any]
    low: Mapping[str, float]
    high: Mapping[str, float]

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(self.start)

    @cached_property
    def labels(self) -> list[str]:
        """A name for every entry."""
        return [
            label
            for name, value in self.start.items()
            for label in ([name] if np.ndim(value) == 0 else _labels(name, np.shape(value)))
        ]

    @cached_property
    def offset(self) -> Vector:
        """(n,) the lower bounds."""
        return self._spread(self.low)

    @cached_property
    def scale(self) -> Vector:
        """(n,) how far apart the bounds are."""
        return self._spread(self.high) - self.offset

    def _spread(self, bounds: Mapping[str, float]) -> Vector:
        return np.concatenate([np.full(np.size(v), bounds[k]) for k, v in self.start.items()])

    @property
    def size(self) -> int:
        """Number of entries, n."""
        return len(self.offset)

    def vector(self, numbers: Mapping[str, Any]) -> Vector:
        """(n,) where some numbers lie between the bounds."""
        values = np.concatenate([np.ravel(np.asarray(numbers[n], float)) for n in self.names])
        return (values - self.offset) / self.scale

    def numbers(self, x: Vector) -> dict[str, Any]:
        """By name, in the scene's units."""
        values, found, place = self.offset + self.scale * x, {}, 0
        for name, start in self.start.items():
            part = values[place : place + np.size(start)]
            found[name] = float(part[0]) if np.ndim(start) == 0 else part.reshape(np.shape(start))
            place += np.size(start)
        return found

    def gradient(self, slopes: Mapping[str, np.ndarray]) -> Vector:
        """(n,) derivatives by the entries, from those by numbers in the scene's units."""
        return np.concatenate([np.ravel(slopes[name]) for name in self.names]) * self.scale


def _labels(name: str, shape: tuple[int, ...]) -> list[str]:
    return [f"{name}[{','.join(map(str, place))}]" for place in np.ndindex(*shape)]


def variables_of(scene: Scene, bounds: Mapping[str, tuple[float, float]]) -> Variables:
    """The parameters of a scene that are given bounds.

    Raises:
        InputError: unknown ones, bounds that are not in order, or that the scene is not within.
    """
    if not bounds:
        raise InputError("[vary]: nothing to vary")
    file = scene.source.file
    start = {}
    for name, (low, high) in bounds.items():
        try:
            file.check_names([name])
        except KeyError as error:
            raise InputError(f"[vary] {name}: {error.args[0]}") from None
        base, place = index_of(name)
        if place is not None and base in bounds:
            raise InputError(
                f"[vary] {base} is that of all flagella: vary it, or {name} and others"
            )
        value = np.asarray(scene.parameters[base], float)
        if place is not None:
            value = np.broadcast_to(value, file.robot.count)[place]
        if not low < high:
            raise InputError(f"[vary] {name}: its bounds are not in order, {low:g} and {high:g}")
        if not np.all((low <= value) & (value <= high)):
            wrong = value[(value < low) | (value > high)][0] if value.ndim else value
            raise InputError(
                f"[vary] {name}: the scene has {wrong:g}, which is not between {low:g} and "
                f"{high:g}: give wider bounds, or another start in the scene"
            )
        start[name] = float(value) if value.ndim == 0 else value
    low = {name: float(b[0]) for name, b in bounds.items()}
    return Variables(start, low, {name: float(b[1]) for name, b in bounds.items()})
