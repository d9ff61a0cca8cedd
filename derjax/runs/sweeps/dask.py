"""Chunks of a sweep on the workers of a Dask cluster, on this machine or on many."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from queue import Empty, SimpleQueue
from typing import Any

from ...core.errors import InputError
from ...core.runtime import use_this_process
from .points import ERROR, Chunk, Outcome, compute_surely, failed

RETRIES = 2
"""How often a chunk is tried again, after a fault that is not that of one of its points."""

SECONDS_BETWEEN_LOOKS = 0.5
SECONDS_TO_CONNECT = 20


def check_installed() -> None:
    """`InputError` if there is no Dask."""
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise InputError(
            "--workers and --scheduler need Dask, which is not installed: "
            "pip install 'derjax[sweep]'"
        ) from None


@contextlib.contextmanager
def client(workers: int | None, scheduler: str | None) -> Iterator[Any]:
    """A Dask client of so many new processes on this machine, or of a scheduler that runs.

    Raises:
        InputError: nobody answers at that address, or workers there have another version of derjax.
    """
    from distributed import Client, LocalCluster

    if scheduler is None:
        with (
            LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address=None,  # pyright: ignore[reportArgumentType]
                silence_logs="ERROR",  # pyright: ignore[reportArgumentType]
            ) as cluster,
            Client(cluster) as connected,
        ):
            yield connected
        return
    try:
        connected = Client(scheduler, timeout=SECONDS_TO_CONNECT)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {scheduler}: no Dask scheduler answers: {error}") from None
    with connected:
        _check_versions(connected, scheduler)
        yield connected


def _check_versions(connected: Any, scheduler: str) -> None:
    """`InputError` if a worker cannot do what is going to be asked of it."""
    ours = version("derjax")
    try:
        theirs = connected.run(version, "derjax")
    except Exception as error:
        raise InputError(f"--scheduler {scheduler}: workers have no derjax: {error}") from None
    if others := {name: theirs[name] for name in theirs if theirs[name] != ours}:
        name, other = next(iter(others.items()))
        raise InputError(
            f"--scheduler {scheduler}: worker {name} has derjax {other}, this is {ours}"
        )


def compute_all(
    connected: Any, chunks: Sequence[Chunk], stopping: Callable[[], bool]
) -> Iterator[list[Outcome]]:
    """The outcomes of chunks, in the order in which they are done; ends early if asked to stop.

    A chunk whose worker is lost goes to another; if that happens again and again, its points
    have failed.
    """
    futures, done = {}, SimpleQueue()
    try:
        for chunk in chunks:
            future = connected.submit(_on_worker, chunk, retries=RETRIES, pure=False)
            futures[future] = chunk
            future.add_done_callback(done.put)
        while futures and not stopping():
            with contextlib.suppress(Empty):
                future = done.get(timeout=SECONDS_BETWEEN_LOOKS)
                yield _result(future, futures.pop(future))
    finally:
        connected.cancel(list(futures))


def _result(future: Any, chunk: Chunk) -> list[Outcome]:
    try:
        return future.result()
    except Exception as error:
        message = f"the computation was lost: {type(error).__name__}: {error}"
        return [failed(number, ERROR, message) for number in chunk.files]


def _on_worker(chunk: Chunk) -> list[Outcome]:
    use_this_process()
    return compute_surely(chunk)
