"""Chunks of a sweep on the processors of this computer, by threads that take the next when free."""

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from queue import Empty, SimpleQueue

from . import points
from .points import Cancelled, Chunk, Outcome

SECONDS_BETWEEN_LOOKS = 0.2


def compute_all(
    chunks: Sequence[Chunk],
    count: int,
    stopping: Callable[[], bool],
    tell: Callable[[float], None],
) -> Iterator[list[Outcome]]:
    """The outcomes of chunks, in the order in which they are done; ends early if asked to stop.

    Args:
        chunks: the points.
        count: of threads.
        stopping: whether to stop, after the pieces of runs that are under way.
        tell: told now and then how many points' worth has been done of chunks under way.
    """
    waiting, done = deque(chunks), SimpleQueue()
    under_way: dict[int, float] = {}
    left = threading.Event()

    def over() -> bool:
        return stopping() or left.is_set()

    def work(thread: int) -> None:
        def on_progress(part: float) -> None:
            under_way[thread] = part
            if over():
                raise Cancelled

        try:
            while not over():
                outcomes = points.compute_surely(waiting.popleft(), on_progress)
                under_way[thread] = 0.0
                done.put(outcomes)
        except (Cancelled, IndexError):  # told to stop, or nothing waits
            pass
        finally:
            done.put(None)

    working = min(count, len(chunks))
    for thread in range(working):
        # A second Ctrl-C is not to wait for them: they must not keep the process.
        threading.Thread(target=work, args=(thread,), daemon=True).start()
    try:
        while working:
            try:
                outcomes = done.get(timeout=SECONDS_BETWEEN_LOOKS)
            except Empty:
                tell(sum(list(under_way.values())))
                continue
            if outcomes is None:
                working -= 1
            else:
                yield outcomes
    finally:
        left.set()
