"""Limit of the operating system on the number of open files."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence

from octoreplay.config.file_url import FileUrl, InputFile
from octoreplay.errors import InputError

if sys.platform != "win32":
    import resource

_OPENINGS = 3
"""Number of times that a run may have a robot's log open at once: for its description, frames and body."""

_OTHER_FILES = 100
"""Files that a process has open besides logs: libraries, results and pipes."""


def allow_open_files(logs: Sequence[InputFile]) -> None:
    """Raise the process's limit of open files to what a run of some logs needs, one path for each robot and log.

    Raises InputError where the operating system does not allow it.
    """
    if sys.platform == "win32":
        return
    num_files = _OTHER_FILES + _OPENINGS * sum(map(_num_files, logs))
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or num_files <= soft:
        return
    # The system may refuse even a value below the hard limit.
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (num_files, hard))
        return
    raise InputError(
        f"{logs[0]} and {len(logs) - 1:,} more logs need {num_files:,} open files, but the system allows {soft:,};"
        f" raise the limit with 'ulimit -n {num_files}', or replay fewer robots"
    )


def _num_files(path: InputFile) -> int:
    """Number of files of a log: those in its folder, or one."""
    if isinstance(path, FileUrl):
        return 1
    with contextlib.suppress(OSError):
        return max(1, sum(1 for _ in path.iterdir()))
    return 1
