"""Frozen dataclasses that JAX can look into.

A field is a leaf (traced, differentiable) unless it is declared with `static()`: then it is
part of the tree's structure, must be hashable, and a new value means a new compilation. This
one rule is what "static structure apart from differentiable parameters" means in derjax.
"""

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax
import numpy as np

T = TypeVar("T")


def static(**kwargs: Any) -> Any:
    """A dataclass field that belongs to the structure of the pytree, not to its leaves."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True, field_specifiers=(static, dataclasses.field))
def pytree(cls: type[T]) -> type[T]:
    """Make `cls` a frozen dataclass and register it as a pytree."""
    return jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True)(cls))


def replace(tree: T, **changes: Any) -> T:
    """A copy of `tree` with the named fields changed."""
    return dataclasses.replace(tree, **changes)  # pyright: ignore[reportArgumentType]


class Indices:
    """A constant integer array that can be part of a pytree's structure.

    Compared and hashed by content, so that two scenes built from the same file share one
    compiled program.
    """

    def __init__(self, array: Any) -> None:
        self.array = np.array(array, dtype=np.int32)
        self.array.setflags(write=False)
        self._key = (self.array.shape, self.array.tobytes())
        self._hash = hash(self._key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Indices) and self._key == other._key

    def __repr__(self) -> str:
        return f"Indices{self.array.shape}"
