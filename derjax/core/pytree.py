"""Frozen dataclasses that JAX can look into.

A field is a leaf (traced, differentiable) unless it is declared with `static()`: then it is
part of the tree's structure, must be hashable, and a new value means a new compilation. This
one rule is what "static structure apart from differentiable parameters" means in derjax.
"""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

T = TypeVar("T")


def static(**kwargs: Any) -> Any:
    """A dataclass field that belongs to the structure of the pytree, not to its leaves."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True, field_specifiers=(static, dataclasses.field))
def pytree(cls: type[T]) -> type[T]:
    """Make `cls` a frozen dataclass and register it as a pytree.

    Floats that are given for leaves become arrays, which their users may count on.
    """
    check = getattr(cls, "__post_init__", None)

    def __post_init__(self: Any) -> None:
        for name in leaves:
            if type(value := getattr(self, name)) is float:
                object.__setattr__(self, name, jnp.asarray(value))
        if check is not None:
            check(self)

    cls.__post_init__ = __post_init__  # pyright: ignore[reportAttributeAccessIssue]
    made = dataclasses.dataclass(frozen=True)(cls)
    fields = dataclasses.fields(made)  # pyright: ignore[reportArgumentType]
    leaves = tuple(f.name for f in fields if not f.metadata.get("static", False))
    statics = tuple(f.name for f in fields if f.metadata.get("static", False))
    _register(made, leaves, statics)
    return made


def _register(cls: type[Any], leaves: tuple[str, ...], statics: tuple[str, ...]) -> None:
    """Tell JAX how to look into a class.

    Not by `jax.tree_util.register_dataclass`: to jaxlib (0.10.1), two classes that are registered
    so are the same structure if they have as many leaves and equal static values, so that once in
    a while the program that was compiled for one of them runs for the other.
    """
    names, keys = leaves + statics, tuple(jax.tree_util.GetAttrKey(name) for name in leaves)

    def children(tree: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        own = tree.__dict__
        return tuple([own[name] for name in leaves]), tuple([own[name] for name in statics])

    def with_keys(tree: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        values, structure = children(tree)
        return tuple(zip(keys, values, strict=True)), structure

    def made_of(structure: tuple[Any, ...], values: Iterable[Any]) -> Any:
        return cls(**dict(zip(names, (*values, *structure), strict=True)))

    jax.tree_util.register_pytree_with_keys(cls, with_keys, made_of, children)


def replace(tree: T, **changes: Any) -> T:
    """A copy of `tree` with the named fields changed."""
    return dataclasses.replace(tree, **changes)  # pyright: ignore[reportArgumentType]


def jvp_nonzero(function: Callable[..., T], primals: tuple, tangents: tuple) -> tuple[T, T]:
    """`jax.jvp` for tangents some of whose leaves are known to be zero (`SymbolicZero`).

    Nothing is computed for those: multiplying by zeros is work that XLA does not leave out.
    """
    leaves, structure = jax.tree.flatten(primals)
    changes = jax.tree.leaves(tangents, is_leaf=lambda leaf: isinstance(leaf, SymbolicZero))
    moves = [
        not isinstance(d, SymbolicZero) and jnp.issubdtype(jnp.result_type(x), jnp.inexact)
        for x, d in zip(leaves, changes, strict=True)
    ]

    def of_those_that_change(*changing: Any) -> T:
        rest = iter(changing)
        every = [next(rest) if m else x for x, m in zip(leaves, moves, strict=True)]
        return function(*jax.tree.unflatten(structure, every))

    if not any(moves):
        value = function(*primals)
        return value, jax.tree.map(jnp.zeros_like, value)
    chosen = tuple(x for x, m in zip(leaves, moves, strict=True) if m)
    along = tuple(d for d, m in zip(changes, moves, strict=True) if m)
    return jax.jvp(of_those_that_change, chosen, along)


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

    def fingerprint(self) -> tuple[object, ...]:
        """What it means to a program; see `fingerprint`."""
        return self._key

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Indices) and self._key == other._key

    def __repr__(self) -> str:
        return f"Indices{self.array.shape}"
