"""The installed JAX computes what NumPy does, in as many threads as are of use.

Some versions of jaxlib silently do not on the CPU (see the versions that pyproject.toml
excludes): the sums below were wrong above 16,384 rows.
"""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from derjax.core.runtime import THREADS

ROWS = (16_384, 16_385, 40_000)


@pytest.mark.parametrize("rows", ROWS)
def test_a_product_with_a_small_matrix_and_a_sum_are_those_of_numpy(rng, rows):
    matrix, vectors = rng.standard_normal((3, 3)), rng.standard_normal((rows, 3))
    found = jax.jit(jax.vmap(lambda r: jnp.sum((matrix @ r) ** 2)))(vectors)
    np.testing.assert_allclose(found, np.sum((vectors @ matrix.T) ** 2, axis=1), rtol=1e-12)


@pytest.mark.parametrize("rows", ROWS)
def test_sums_over_rows_are_those_of_numpy(rng, rows):
    vectors, weights = rng.standard_normal((rows, 3)), rng.uniform(size=rows)

    @jax.jit
    def value_and_gradient(v):
        return jax.value_and_grad(lambda u: jnp.sum(weights * jnp.sum(u * u, axis=1)))(v)

    value, gradient = value_and_gradient(vectors)
    assert float(value) == pytest.approx(weights @ np.sum(vectors**2, axis=1), rel=1e-12)
    np.testing.assert_allclose(gradient, 2 * weights[:, None] * vectors, rtol=1e-12)


def test_derjax_computes_in_double_precision():
    assert jnp.zeros(()).dtype == jnp.float64


@pytest.mark.parametrize(("given", "threads"), [({}, {1}), ({"OPENBLAS_NUM_THREADS": "2"}, {2})])
def test_linear_algebra_has_one_thread_unless_told_otherwise(given, threads):
    """Threads of small matrices wait for each other, most of all where processors are busy."""
    program = (
        "import derjax, scipy.linalg, threadpoolctl as t;"
        "print({each['num_threads'] for each in t.threadpool_info() if each['user_api'] == 'blas'})"
    )
    several = {name: value for name, value in os.environ.items() if name not in THREADS} | given
    done = subprocess.run(
        [sys.executable, "-c", program], env=several, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == str(threads)
