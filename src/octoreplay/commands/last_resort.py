"""Report of an error that no exit code covers: a defect of octoreplay or of a library, or too little memory."""

from __future__ import annotations

import os
import platform
import shlex
import sys
import tempfile
import traceback
from importlib import metadata

from octoreplay._version import __version__
from octoreplay.config.file_url import without_credentials

_LIBRARIES = ("click", "mcap", "numba", "numpy", "open3d-cpu", "open3d", "rich", "rosbags", "scipy")


def sentence(error: Exception) -> str:
    """Return one sentence on an error, which names the file with the report."""
    # The variables of the frames may hold the memory that is missing.
    traceback.clear_frames(error.__traceback__)
    try:
        saved = f"the report is in {_save(_report(error))}"
    except (OSError, MemoryError) as failed:
        saved = f"no report could be saved ({failed or type(failed).__name__})"
    if isinstance(error, MemoryError):
        return f"out of memory; use a larger --resolution or a part of the logs; {saved}"
    if isinstance(error, OSError):
        return f"{error}; {saved}"
    text = " ".join(str(error).split())[:300]
    return f"unexpected {type(error).__name__}{': ' * bool(text)}{text}; this is a defect of octoreplay; {saved}"


def _report(error: Exception) -> str:
    """Traceback, command line and versions."""
    versions = [f"octoreplay {__version__}", f"Python {sys.version}", platform.platform()]
    for name in _LIBRARIES:
        try:
            versions.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    trace = "".join(traceback.format_exception(error))
    return without_credentials("\n".join([shlex.join(sys.argv), "", trace, *versions, ""]))


def _save(report: str) -> str:
    """Save a report in the folder for temporary files, else in the working folder, and return its path."""
    for folder in (None, "."):
        try:
            descriptor, path = tempfile.mkstemp(prefix="octoreplay-report-", suffix=".txt", dir=folder)
        except OSError:
            if folder is not None:
                raise
            continue
        with os.fdopen(descriptor, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(report)
        break
    return path
