"""How programs are compiled on this computer."""

import gc
import os
import sys
from importlib.metadata import version
from pathlib import Path

import jax

from .programs import keep_in

TRACED = "traced"
"""Where, among JAX's compiled programs, those are that have been traced."""

SHORTEST_COMPILATION = 0.2
"""Programs that compile faster than this (s) are not worth keeping."""

THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")
"""By which a user says how many threads linear algebra has."""


def use_this_process() -> None:
    """What a process that is derjax's own does first: a command, or a worker of a sweep."""
    directory = enable_compilation_cache()
    keep_in(None if directory is None or "://" in str(directory) else directory / TRACED)
    collect_garbage_rarely()


def enable_compilation_cache() -> Path | None:
    """Keep compiled programs on disk, so that the next process need not compile them again.

    They go to the user's cache directory, apart for every version of jaxlib. A directory or a
    shortest time that JAX has been given already, by `JAX_COMPILATION_CACHE_DIR` and
    `JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS` or in its configuration, is left as it is.

    Returns:
        The directory in use; None where no directory can be made: then nothing is kept.
    """
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST_COMPILATION)
    chosen = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if chosen:
        return Path(chosen)
    directory = _user_cache() / "derjax" / f"jax-{version('jaxlib')}"
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    jax.config.update("jax_compilation_cache_dir", str(directory))
    return directory


def use_one_blas_thread() -> None:
    """Keep the linear algebra library from starting threads of its own.

    The matrices of a robot are small: threads only wait for each other, and where the
    processors have other work too, a step takes ten to thirty times as long. Only libraries that
    have been loaded are reached, so that SciPy's is loaded here. Whoever has said how many threads
    there are to be, in `OPENBLAS_NUM_THREADS`, `MKL_NUM_THREADS` or `OMP_NUM_THREADS`, is obeyed.
    """
    if any(name in os.environ for name in THREADS):
        return
    import scipy.linalg  # noqa: F401  (the library that JAX takes its linear algebra from)
    from threadpoolctl import threadpool_limits

    threadpool_limits(1, user_api="blas")


def collect_garbage_rarely() -> None:
    """Let Python look for garbage less often: half of the time that JAX traces a derivative.

    Tracing makes millions of small objects of which most live on, and the default is to go through
    them all after every few hundred. What has been imported so far is never looked through again.
    """
    gc.freeze()
    gc.set_threshold(200_000, 20, 100)


def _user_cache() -> Path:
    """Where this operating system wants programs to keep what they can do without."""
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
