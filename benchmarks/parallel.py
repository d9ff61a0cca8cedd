"""Cases of a benchmark that do not know of each other, in several processes."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import TypeVar

from derjax.core.runtime import enable_compilation_cache
from derjax.runs.progress import Progress

Case = TypeVar("Case")
Found = TypeVar("Found")


def in_parallel(
    function: Callable[[Case], Found], cases: Sequence[Case], workers: int
) -> Iterator[Found]:
    """What a function says of cases, in the order in which they are done, with progress."""
    with Progress(len(cases), "cases") as progress:
        if workers == 1:
            for number, case in enumerate(cases, 1):
                yield function(case)
                progress.update(number)
            return
        # Processes that are forked would share the threads of JAX.
        spawn = get_context("spawn")
        with ProcessPoolExecutor(workers, spawn, initializer=enable_compilation_cache) as pool:
            pending = [pool.submit(function, case) for case in cases]
            for number, done in enumerate(as_completed(pending), 1):
                yield done.result()
                progress.update(number)
