"""Standard streams of a process that do not fail: the files of a command do not depend on who reads its text."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from typing import Any, TextIO


class _Stream(io.FileIO):
    """Standard stream that drops what cannot be written, and keeps the first error."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor, "wb", closefd=False)
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write bytes; after an error do nothing."""
        if self.error is None:
            try:
                return super().write(data) or 0
            except OSError as error:
                self.error = error
        return memoryview(data).nbytes


def protect_streams() -> None:
    """Replace standard output and standard error by streams that do not fail.

    Descriptors that the parent has closed are opened on the null device, because a result file would get their number,
    and libraries print to it. Characters that the terminal's encoding does not have are escaped.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    sys.stdout, sys.stderr = _protected(sys.stdout, 1), _protected(sys.stderr, 2)


def output_error() -> OSError | None:
    """Return the error that ended standard output; None if all text was written."""
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    return raw.error if isinstance(raw, _Stream) else None


def _protected(stream: TextIO | None, descriptor: int) -> TextIO:
    """Return a stream with the encoding of ``stream`` that does not fail."""
    return io.TextIOWrapper(
        io.BufferedWriter(_Stream(descriptor)),
        encoding="utf-8" if stream is None else stream.encoding,
        errors="backslashreplace",
        line_buffering=True,
    )
