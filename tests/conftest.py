"""Settings for every test: double precision, no display, compiled programs kept."""

import os
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("MPLBACKEND", "Agg")

import jax
import numpy as np
import pytest

from derjax.core.runtime import use_one_blas_thread


def pytest_configure(config: pytest.Config) -> None:
    """Keep compiled programs from one run of the tests to the next."""
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    kept = Path(chosen) if chosen else config.rootpath / ".pytest_cache" / "jax"
    jax.config.update("jax_compilation_cache_dir", str(kept))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    use_one_blas_thread()


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same in every run."""
    return np.random.default_rng(20230301)


@pytest.fixture(scope="module", autouse=True)
def _programs_of_one_file() -> Iterator[None]:
    """Drop compiled programs after every file: a process can only hold so many of them."""
    yield
    jax.clear_caches()
