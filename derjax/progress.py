"""Telling how far a long computation has come, and stopping it in good order."""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Self, TextIO

from tqdm import tqdm

SECONDS_BETWEEN_LINES = 30.0


class Progress:
    """Progress of a run on stderr: a bar on a terminal, now and then a line elsewhere.

    Args:
        n_steps: steps of the whole run.
        step_length: s.
        done: steps that have been done before.
        quiet: show nothing.
        stream: where to write; stderr if None.
    """

    def __init__(
        self,
        n_steps: int,
        step_length: float,
        done: int = 0,
        quiet: bool = False,
        stream: TextIO | None = None,
    ) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._n_steps, self._step_length, self._first = n_steps, step_length, done
        self._quiet = quiet
        self._began = self._told = time.monotonic()
        self._bar = None
        if not quiet and self._stream.isatty():
            self._bar = tqdm(
                total=n_steps, initial=done, unit=" steps", file=self._stream, dynamic_ncols=True
            )

    def update(self, done: int) -> None:
        """`done` steps of the whole run have been done."""
        if self._bar is not None:
            self._bar.set_postfix_str(f"t = {done * self._step_length:.4g} s", refresh=False)
            self._bar.update(done - self._bar.n)
        elif not self._quiet and time.monotonic() - self._told > SECONDS_BETWEEN_LINES:
            self._told = time.monotonic()
            print(self.line(done, self._told - self._began), file=self._stream, flush=True)

    def line(self, done: int, elapsed: float) -> str:
        """One line on the state of the run after `elapsed` seconds."""
        rate = (done - self._first) / elapsed
        left = (self._n_steps - done) / rate if rate > 0 else float("nan")
        return (
            f"t = {done * self._step_length:.4g} of {self._n_steps * self._step_length:.4g} s "
            f"({100 * done / self._n_steps:.0f} %), {rate:.3g} steps/s, {left:.0f} s left"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()


@contextmanager
def interruptible(message: str) -> Iterator[Callable[[], bool]]:
    """Turns the first Ctrl-C (or SIGTERM) into a question to be asked at a good moment.

    Yields a function that tells whether the user wants to stop. On the first signal `message`
    is written to stderr; a second one raises KeyboardInterrupt at once. Outside of the main
    thread, where signals cannot be caught, nothing changes.
    """
    stopping = threading.Event()

    def handle(_signal: int, _frame: object) -> None:
        if stopping.is_set():
            raise KeyboardInterrupt
        stopping.set()
        os.write(2, f"\n{message}\n".encode())  # printing is not safe in a signal handler

    if threading.current_thread() is not threading.main_thread():
        yield stopping.is_set
        return
    signals = (signal.SIGINT, signal.SIGTERM)
    old = [signal.signal(number, handle) for number in signals]
    try:
        yield stopping.is_set
    finally:
        for number, handler in zip(signals, old, strict=True):
            signal.signal(number, handler)
