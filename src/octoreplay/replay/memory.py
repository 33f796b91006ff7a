"""Memory of a run: its limit, and a forecast of its growth."""

from __future__ import annotations

import contextlib
import logging
import os
import resource
import sys
from collections import deque
from pathlib import Path

from octoreplay.errors import EARLY, MemoryLimitError

_log = logging.getLogger(__name__)

WINDOW = 10
"""Number of ticks over which the growth is measured."""
LEAST_SHARE = 0.25
"""Share of the memory in use from which a forecast is made: maps grow fast at first."""

_AVAILABLE = Path("/proc/meminfo")
_RESIDENT = Path("/proc/self/statm")
_CONTAINER = Path("/sys/fs/cgroup/memory.max")


def resident_bytes() -> int:
    """Return the memory of this process in use [byte]; its peak where the system does not give the present one."""
    try:
        return int(_RESIDENT.read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, LookupError, ValueError):
        # Linux gives the peak in kilobytes, macOS in bytes.
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def free_bytes() -> int | None:
    """Return the memory that this process can get before the machine swaps [byte]; None where that is unknown."""
    found = []
    with contextlib.suppress(OSError, LookupError, ValueError):
        lines = dict(line.split(":", 1) for line in _AVAILABLE.read_text(encoding="ascii").splitlines())
        found.append(int(lines["MemAvailable"].split()[0]) * 1024)
    # Without a limit the file holds the word max.
    with contextlib.suppress(OSError, ValueError):
        found.append(int(_CONTAINER.read_text(encoding="ascii")) - resident_bytes())
    return min(found, default=None)


class MemoryWatch:
    """Check of a run's memory after every tick.

    ``limit`` is the largest memory of the process [byte], None for no limit. ``total_ns`` is the length of the replayed
    logs, None where it is unknown.
    """

    def __init__(self, limit: int | None, total_ns: int | None) -> None:
        self._limit = limit
        self._total_ns = total_ns
        self._samples: deque[tuple[int, int]] = deque(maxlen=WINDOW + 1)
        self._has_warned = False

    def check(self, log_ns: int) -> None:
        """Check the memory ``log_ns`` after the start; warn once where the run will need more than there is.

        Raises MemoryLimitError above the limit.
        """
        used = resident_bytes()
        if self._limit is not None and used > self._limit:
            raise MemoryLimitError(
                f"memory_limit: the run takes {used / 1e9:.3g} GB {log_ns / 1e9:.1f} s after the start, more than"
                f" {self._limit / 1e9:.3g} GB; continue with --resume and a larger limit, start again with --tiles, or"
                " use a larger resolution or a smaller max_range"
            )
        self._samples.append((log_ns, used))
        if not self._has_warned and len(self._samples) > WINDOW:
            self._forecast()

    def _forecast(self) -> None:
        """Warn where the growth of the last ticks leads to more memory than there is."""
        (first_ns, before), (log_ns, used) = self._samples[0], self._samples[-1]
        seconds, free = (log_ns - first_ns) / 1e9, free_bytes()
        room = min((size for size in (self._limit, None if free is None else used + free) if size), default=None)
        if room is None or used <= before or seconds <= 0 or used < LEAST_SHARE * room:
            return
        growth = (used - before) / seconds
        until_full = (room - used) / growth
        left = None if self._total_ns is None else (self._total_ns - log_ns) / 1e9
        if left is not None and until_full >= left:
            return
        self._has_warned = True
        at_end = "" if left is None else f" and {(used + growth * left) / 1e9:.3g} GB at the end of the logs"
        _log.warning(
            "warning: the maps grow by %.3g MB per second of log time: at this rate the run takes all of %.3g GB in"
            " %.0f s of log time%s; use a larger resolution or a smaller max_range, or"
            " replay it with --tiles auto",
            growth / 1e6, room / 1e9, until_full, at_end, extra=EARLY,
        )  # fmt: skip
