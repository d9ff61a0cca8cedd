"""How the programs of the tests are compiled, quickly, and what was measured of each file."""

import os
from importlib.metadata import version
from pathlib import Path

import jax

DURATIONS = Path(__file__).with_name("durations.json")
"""Processor time (s) that each file took when it was last measured, with nothing compiled."""

QUICKLY = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
"""Compiling takes most of the tests' time, as most programs run once and briefly. Not to
optimise them changes their results by rounding only. Files that run for longer than they
compile are marked `optimised`."""

if version("jaxlib").startswith("0.10."):
    # LLVM has less to do with what the older emitter of fused loops writes: half the time of
    # a compilation. XLA ends a process with a flag that it does not know, and other versions
    # of it have not been asked.
    QUICKLY["XLA_FLAGS"] = "--xla_cpu_use_fusion_emitters=false"


def environment_of_users() -> dict[str, str]:
    """For a process that compiles as users do: where long runs cost more than compiling."""
    kept = {k: v for k, v in os.environ.items() if QUICKLY.get(k) != v}
    return kept | {"JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir)}


def files_with_tests() -> list[Path]:
    return sorted(DURATIONS.parent.rglob("test_*.py"))
