"""Deferred signals: Ctrl-C takes effect between two ticks."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def deferred_interrupts() -> Iterator[Callable[[], None]]:
    """Defer SIGINT and SIGTERM while the body runs; the yielded function delivers a pending signal.

    An exception during a write would leave an incomplete chunk in the file; inside a lock or a callback it could block
    the threads or get lost. A pending signal is delivered at the end of the body at the latest. Outside the main
    thread, where no signals arrive, nothing is deferred.
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
