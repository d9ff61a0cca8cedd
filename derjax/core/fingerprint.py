"""What arguments of a function mean to a program, in the same words in every process.

A program depends on the structure of its arguments, on shapes and types of their leaves, and on the
values of all that is static. Descriptions are nested tuples and lists of text, of which two are
equal only if programs are. What is not known for certain is `Unknown`.

An object that is no dataclass may say what it is, by a method `fingerprint`, which returns
something that can be described in turn.
"""

import dataclasses
import enum
import functools
import hashlib
import sys
from typing import Any

import jax
import numpy as np

Description = Any

SIMPLE = (type(None), bool, int, float, complex, str, bytes)


class Unknown(Exception):
    """Something of which it cannot be said what it makes of a program."""


def described(value: Any, packages: frozenset[str]) -> Description:
    """A static value.

    Args:
        value: what to describe.
        packages: whose classes and functions are known; their sources belong to the program.

    Raises:
        Unknown: the value, or a part of it, comes from elsewhere or has no name.
    """
    kind = type(value)
    if kind in SIMPLE:
        return kind.__name__, repr(value)
    if kind in (tuple, list):
        if all(type(each) is int for each in value):  # long, in topologies
            return kind.__name__, repr(value)
        return kind.__name__, [described(each, packages) for each in value]
    if kind is dict:
        items = [(described(k, packages), described(v, packages)) for k, v in value.items()]
        return "dict", items
    if kind in (set, frozenset):
        return kind.__name__, sorted(repr(described(each, packages)) for each in value)
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.asarray(value)
        if array.dtype.hasobject:
            raise Unknown(f"an array of {array.dtype}")
        weak = str(jax.typeof(value).weak_type) if isinstance(value, jax.Array) else ""
        content = hashlib.sha256(array.tobytes()).hexdigest()
        return kind.__name__, array.dtype.str, array.shape, weak, content
    if kind is functools.partial:
        parts = (value.func, value.args, value.keywords)
        return "partial", [described(part, packages) for part in parts]
    if isinstance(value, type) or (callable(value) and hasattr(value, "__qualname__")):
        return "named", _name_of(value, packages)
    name = _name_of(kind, packages)
    if isinstance(value, enum.Enum):
        return name, value.name
    if (says := getattr(value, "fingerprint", None)) is not None:
        return name, described(says(), packages)
    if dataclasses.is_dataclass(value):
        return name, [
            (field.name, described(getattr(value, field.name), packages))
            for field in dataclasses.fields(value)
        ]
    if isinstance(value, tuple):  # with names for its places
        return name, [described(each, packages) for each in value]
    raise Unknown(f"{value!r}")


def leaves_described(tree: Any, packages: frozenset[str]) -> tuple[Description, int]:
    """A tree that JAX looks into, without the numbers in its leaves, and how many leaves it has.

    Raises:
        Unknown: a part of its structure comes from elsewhere or has no name.
    """
    kind = type(tree)
    if tree is None:
        return "None", 0
    if isinstance(tree, np.ndarray | np.generic | jax.Array | bool | int | float | complex):
        aval = jax.typeof(tree)
        return ("leaf", str(aval.dtype), aval.shape, aval.weak_type), 1
    if kind in (tuple, list):
        name, children = kind.__name__, list(tree)
    elif kind is dict:
        keys = sorted(tree)
        name, children = ("dict", described(keys, packages)), [tree[key] for key in keys]
    elif isinstance(tree, tuple):
        name, children = _name_of(kind, packages), list(tree)
    elif dataclasses.is_dataclass(tree):
        fields = dataclasses.fields(tree)
        static = [f.name for f in fields if f.metadata.get("static", False)]
        values = [(name, described(getattr(tree, name), packages)) for name in static]
        name = _name_of(kind, packages), values
        children = [getattr(tree, f.name) for f in fields if f.name not in static]
    else:
        raise Unknown(f"{tree!r}")
    parts = [leaves_described(child, packages) for child in children]
    return (name, [part for part, _ in parts]), sum(count for _, count in parts)


def _name_of(thing: Any, packages: frozenset[str]) -> str:
    """The full name of a class or function; `Unknown` unless a known package has it there."""
    module, name = getattr(thing, "__module__", None), thing.__qualname__
    if not isinstance(module, str) or module.partition(".")[0] not in packages:
        raise Unknown(f"{thing!r}")
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    if found is not thing:
        raise Unknown(f"{thing!r}")
    return f"{module}.{name}"
