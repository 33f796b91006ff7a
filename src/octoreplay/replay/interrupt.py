"""Ctrl-C that waits until a tick is done and its file is whole."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def deferred_interrupts() -> Iterator[Callable[[], None]]:
    """Hold SIGINT and SIGTERM back while the body runs, except where it calls the function that it is given.

    An exception in the middle of a write would leave a chunk half in the file; inside a lock or a callback it could
    stop the threads for ever, or get lost. What came is delivered at the end of the body at the latest. In other
    threads than the main one, where signals never arrive, the body just runs.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    pending: list[int] = []
    previous = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def hold() -> None:
        for number in previous:
            signal.signal(number, lambda received, _: pending.append(received))

    def release() -> None:
        for number, handler in previous.items():
            signal.signal(number, handler)
        if pending:
            received = pending[0]
            pending.clear()
            signal.raise_signal(received)

    def deliver() -> None:
        if pending:
            release()
            hold()

    hold()
    try:
        yield deliver
    finally:
        release()
