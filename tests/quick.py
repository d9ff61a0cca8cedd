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
    # of it have not been asked. Pieces of a program for threads cost more than they save where
    # other tests run.
    QUICKLY["XLA_FLAGS"] = (
        "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
    )


def environment() -> dict[str, str]:
    """For a process that a test starts: it shares the compiled programs of the tests."""
    return {
        **os.environ,
        "JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir),
        # Derjax obeys this, and where other tests run threads wait for each other.
        "OPENBLAS_NUM_THREADS": "1",
    }


def environment_of_users() -> dict[str, str]:
    """Likewise, compiled as users do: where long runs cost more than compiling."""
    return {key: value for key, value in environment().items() if QUICKLY.get(key) != value}


def files_with_tests() -> list[Path]:
    return sorted(DURATIONS.parent.rglob("test_*.py"))
