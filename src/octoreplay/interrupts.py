"""Interrupts of a process: SIGINT, SIGTERM and SIGHUP.

The command line calls ``install`` before all other work. From then on the first signal raises KeyboardInterrupt, and a
second one ends the process at once. Without ``install`` the handlers of the calling program stay in force. ``deferred``
holds signals back in both cases. This module imports nothing heavy, because it is loaded before the handlers are set.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

EXIT_CODE = 130
"""Exit code of an interrupted process."""

_SIGNALS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGINT") if hasattr(signal, name)]


class _State:
    """Signals of this process: number of nested ``deferred`` bodies, and what was received."""

    def __init__(self) -> None:
        self.depth = 0
        self.pending: int | None = None
        self.is_installed = False
        self.is_received = False
        self.is_raised = False
        self.is_finished = False
        self.borrowed: dict[int, Callable[[int, FrameType | None], object] | int] = {}


_state = _State()


def install() -> None:
    """Handle the signals for the rest of the process. A signal that the parent has set to be ignored stays ignored."""
    _state.is_installed = True
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _handle)


def is_received() -> bool:
    """Return True after a signal; an exception that follows may be a consequence of the interrupt."""
    return _state.is_received


def check() -> None:
    """Raise KeyboardInterrupt if a signal was received, also where a library has caught the first KeyboardInterrupt."""
    if _state.is_received and not _state.is_finished:
        raise KeyboardInterrupt


def finish() -> None:
    """Ignore later signals and a pending one: all outputs of the process are complete. No effect without install."""
    if _state.is_installed:
        _state.is_finished = True
        _state.is_received = False


def ignore() -> None:
    """Ignore the signals until the process has ended."""
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def say(text: str = "interrupted") -> None:
    """Write one line to standard error, also before and after the life of ``sys.stderr``."""
    with contextlib.suppress(OSError):
        os.write(2, text.encode(errors="backslashreplace") + b"\n")


@contextlib.contextmanager
def deferred() -> Iterator[Callable[[], None]]:
    """Defer signals while the body runs; the yielded function delivers a pending one before.

    A KeyboardInterrupt during a write would leave an incomplete file; inside a lock or a callback it could block the
    threads or get lost. A pending signal is delivered at the end of the body at the latest. Outside the main thread,
    where no signals arrive, nothing is deferred.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    before = _state.depth
    try:
        _state.depth = before + 1
        if not _state.is_installed and not before:
            _borrow()
        yield _deliver
    finally:
        try:
            if not _state.is_installed and not before:
                _give_back()
        finally:
            _state.depth = before
        if not before:
            _deliver()


def _borrow() -> None:
    """Set the own handler in place of those of the calling program."""
    _state.borrowed.clear()
    for number in _SIGNALS:
        handler = signal.getsignal(number)
        # None: a handler that was not set from Python and could not be restored.
        if handler is not None and handler is not signal.SIG_IGN:
            _state.borrowed[number] = handler
            signal.signal(number, _handle)


def _give_back() -> None:
    """Restore the handlers of the calling program."""
    for number, handler in _state.borrowed.items():
        signal.signal(number, handler)


def _handle(number: int, _: FrameType | None) -> None:
    """Note a signal, and deliver it unless signals are deferred."""
    if _state.is_finished:
        return
    _state.is_received = _state.is_installed
    if _state.depth or not _state.is_installed:
        _state.pending = number
    else:
        _interrupt()


def _deliver() -> None:
    """Give a pending signal its effect."""
    number, _state.pending = _state.pending, None
    if number is None or _state.is_finished:
        return
    if _state.is_installed:
        _interrupt()
    handler = _state.borrowed.get(number)
    if callable(handler):
        handler(number, None)
    elif handler is not None:
        signal.signal(number, handler)
        signal.raise_signal(number)


def _interrupt() -> None:
    """Raise KeyboardInterrupt the first time; end the process the second time, without its clean-up."""
    if _state.is_raised:
        say()
        os._exit(EXIT_CODE)
    _state.is_raised = True
    raise KeyboardInterrupt
