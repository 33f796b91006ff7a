"""Frames read and decoded in a background thread, a few ahead of the consumer."""

from __future__ import annotations

from collections.abc import Iterator
from queue import Empty, Full, Queue
from threading import Event, Thread
from types import TracebackType
from typing import Self

from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.robots.sensor_logs import SensorLogs
from octoreplay.records import Frame

NUM_AHEAD = 4
"""Largest number of waiting frames; it bounds the memory, whatever the length of the log."""

# Period at which a waiting thread checks whether the log was closed.
_POLL_SECONDS = 0.1


class ReadAhead:
    """Frames of one robot's log, read in a thread; a context manager that ends the thread before the log is closed.

    ``team_start_ns`` is that of ``RobotLog.frames``. Errors of the thread are raised by the iterator of ``frames``.
    """

    def __init__(self, log: RobotLog | SensorLogs, team_start_ns: int | None = None) -> None:
        self._log = log
        self._team_start_ns = team_start_ns
        self._queue: Queue[Frame | Exception | None] = Queue(NUM_AHEAD)
        self._is_closed = Event()
        self._thread = Thread(target=self._read, name=f"read {log.robot_id}", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._is_closed.set()
        self._thread.join()

    def frames(self) -> Iterator[Frame]:
        """Yield the frames from the beginning; may be called once."""
        while (item := self._take()) is not None:
            if isinstance(item, Exception):
                raise item
            yield item

    def _take(self) -> Frame | Exception | None:
        """Next frame or error; None at the end and when the log is closed."""
        while not self._is_closed.is_set():
            try:
                return self._queue.get(timeout=_POLL_SECONDS)
            except Empty:
                continue
        return None

    def _read(self) -> None:
        """Read frames until the end, an error, or the closing of the log."""
        try:
            for frame in self._log.frames(self._team_start_ns, is_wanted=lambda: not self._is_closed.is_set()):
                if not self._put(frame):
                    return
            self._put(None)
        except Exception as error:
            self._put(error)

    def _put(self, item: Frame | Exception | None) -> bool:
        """Put an item into the queue when there is room; False when the log was closed."""
        while not self._is_closed.is_set():
            try:
                self._queue.put(item, timeout=_POLL_SECONDS)
            except Full:
                continue
            return True
        return False
