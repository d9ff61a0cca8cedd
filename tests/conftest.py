"""Settings for every test: double precision, no display, compiled programs kept.

Also the order of files and what each costs: see `test_budget.py`.
"""

import json
import os
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from quick import DURATIONS, QUICKLY, files_with_tests

# Unless chosen already: `JAX_DISABLE_MOST_OPTIMIZATIONS=0 XLA_FLAGS= pytest` compiles as users do.
os.environ.update({key: value for key, value in QUICKLY.items() if key not in os.environ})
os.environ.setdefault("MPLBACKEND", "Agg")

import jax
import numpy as np
import pytest

from derjax.core.programs import keep_in
from derjax.core.runtime import collect_garbage_rarely, use_this_process

QUICKLY_COMPILED = os.environ.get("JAX_DISABLE_MOST_OPTIMIZATIONS") == "1"
"""Asked for here, as JAX may have been imported before."""

MUCH_LONGER = 3.0
"""A file that takes so many times what is stored is named when the tests end."""


EMPTY = pytest.StashKey[TemporaryDirectory[str]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--store-durations",
        action="store_true",
        help=f"compile everything anew, and store the processor time of each file that passes "
        f"in tests/{DURATIONS.name}",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Keep compiled programs from one run of the tests to the next, and files in our order."""
    if config.getoption("--store-durations") and config.option.markexpr != "not slow":
        raise pytest.UsageError("what is stored is what `pytest` takes without -m")
    if config.getoption("--store-durations") and not hasattr(config, "workerinput"):
        config.stash[EMPTY] = TemporaryDirectory(ignore_cleanup_errors=True)
        # Workers, and processes that tests start, are told by this, too.
        os.environ["JAX_COMPILATION_CACHE_DIR"] = config.stash[EMPTY].name
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    kept = Path(chosen) if chosen else config.rootpath / ".pytest_cache" / "jax"
    jax.config.update("jax_compilation_cache_dir", str(kept))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    collect_garbage_rarely()
    if hasattr(config.option, "loadscopereorder"):
        # pytest-xdist would begin with the files that have the most tests.
        config.option.loadscopereorder = False
    config.pluginmanager.register(Durations(config))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Function) -> None:
    """Before fixtures of the whole session compile anything for a file, too.

    A command that a test runs in this process keeps programs from then on, and what is kept is
    compiled apart from what was made before: where there are commands, all is kept.
    """
    if hasattr(item.module, "main"):
        use_this_process()
    quickly = QUICKLY_COMPILED and item.get_closest_marker("optimised") is None
    jax.config.update("jax_disable_most_optimizations", quickly)


class Durations:
    """The processor time of each file, of all workers together."""

    def __init__(self, config: pytest.Config) -> None:
        self.config = config
        self.stored: dict[str, float] = json.loads(DURATIONS.read_text())
        self.taken: dict[str, float] = defaultdict(float)
        self.failed: set[str] = set()
        self.before = used()

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """The longest files come first: one that begins last leaves other processors idle."""
        items.sort(key=lambda item: -self.stored.get(file_of(item.nodeid), 0.0))

    def pytest_collection_finish(self) -> None:
        self.before = used()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Iterator[None]:
        """A worker's reports reach the first process with all their attributes."""
        report = yield
        now = used()
        report.processor_time, self.before = now - self.before, now
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.taken[file_of(report.nodeid)] += getattr(report, "processor_time", 0.0)
        if report.failed:
            self.failed.add(file_of(report.nodeid))

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        # What is stored says nothing of tests that are marked slow.
        usual = self.config.option.markexpr == "not slow"
        for file, seconds in self.taken.items() if usual else ():
            if seconds > 5.0 + MUCH_LONGER * self.stored.get(file, 0.0):
                stored = f"{self.stored[file]:.0f} s" if file in self.stored else "nothing"
                terminalreporter.write_line(
                    f"{file} took {seconds:.0f} s of processor time; stored is {stored} "
                    "(see tests/test_budget.py)",
                    yellow=True,
                )
        if self.config.getoption("--store-durations"):
            measured = {f: round(s, 1) for f, s in self.taken.items() if f not in self.failed}
            there = {p.relative_to(DURATIONS.parent).as_posix() for p in files_with_tests()}
            kept = {f: s for f, s in (self.stored | measured).items() if f in there}
            longest_first = dict(sorted(kept.items(), key=lambda each: -each[1]))
            DURATIONS.write_text(json.dumps(longest_first, indent=2) + "\n")


def used() -> float:
    """Processor time (s) of this process and of those that it has started and awaited."""
    return sum(os.times()[:4])


def file_of(nodeid: str) -> str:
    """The file of a test, relative to this folder."""
    return nodeid.split("::")[0].removeprefix("tests/")


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same in every run."""
    return np.random.default_rng(20230301)


@pytest.fixture(scope="module", autouse=True)
def _programs_of_one_file() -> Iterator[None]:
    """Drop compiled programs after every file: a process can only hold so many of them."""
    yield
    jax.clear_caches()
    keep_in(None)
