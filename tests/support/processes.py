"""Helpers for tests that run the command line as a process."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path


def octoreplay(*arguments: object, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run the command line as a process with a terminal width of 100 columns."""
    return subprocess.run(
        [sys.executable, "-m", "octoreplay", *map(str, arguments)], cwd=folder, text=True, capture_output=True,
        env={**os.environ, "COLUMNS": "100", "PYTHONIOENCODING": "utf-8"}, check=False, timeout=300,
    )  # fmt: skip


def fails(code: int, sentence: str, *arguments: object) -> None:
    """Check that a command ends with this code and one sentence on stderr, without a traceback."""
    done = octoreplay(*arguments)
    assert done.returncode == code, done.stderr
    assert re.search(sentence, done.stderr), done.stderr
    assert "Traceback" not in done.stderr
