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
    """Progress on stderr: a bar on a terminal, now and then a line elsewhere.

    Args:
        total: how much there is to do.
        unit: of that, in the plural.
        done: how much has been done before.
        quiet: show nothing.
        stream: where to write; stderr if None.
    """

    def __init__(
        self,
        total: float,
        unit: str,
        done: float = 0.0,
        quiet: bool = False,
        stream: TextIO | None = None,
    ) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._total, self._unit, self._first = total, unit, done
        self._quiet = quiet
        self._began = self._told = time.monotonic()
        self._bar = None
        if not quiet and self._stream.isatty():
            self._bar = tqdm(
                total=total,
                initial=done,
                file=self._stream,
                dynamic_ncols=True,
                bar_format="{percentage:3.0f} %|{bar}| {n:.4g} of {total:.4g}{unit}, "
                "{rate_fmt}, {remaining} left",
                unit=f" {unit}",
            )

    def update(self, done: float) -> None:
        """So much of all has been done."""
        if self._bar is not None:
            self._bar.update(done - self._bar.n)
        elif not self._quiet and time.monotonic() - self._told > SECONDS_BETWEEN_LINES:
            self._told = time.monotonic()
            print(self.line(done, self._told - self._began), file=self._stream, flush=True)

    def line(self, done: float, elapsed: float) -> str:
        """One line on how far it has come after `elapsed` seconds."""
        rate = (done - self._first) / elapsed
        left = (self._total - done) / rate if rate > 0 else float("nan")
        return (
            f"{done:.4g} of {self._total:.4g} {self._unit} ({100 * done / self._total:.0f} %), "
            f"{rate:.3g} {self._unit}/s, {left:.0f} s left"
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


@contextmanager
def terminated_like_interrupted() -> Iterator[None]:
    """Lets SIGTERM, by which queues of clusters end a job, do what Ctrl-C does.

    Outside of the main thread, where signals cannot be caught, nothing changes.
    """

    def handle(_signal: int, _frame: object) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    old = signal.signal(signal.SIGTERM, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, old)
