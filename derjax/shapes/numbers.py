"""Numbers that a shape is made of: on the host, or in a program."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def library_of(*values: Any) -> Any:
    """NumPy for numbers of Python and of NumPy, and `jax.numpy` where one of them is JAX's.

    On the host a shape costs no program: JAX would compile one for every operation.
    """
    return jnp if any(isinstance(value, jax.Array) for value in values) else np
