"""Helpers for tests that run small sweeps as processes."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from octoreplay.study.numbers import TIMING_COLUMNS

PAIR = Path(__file__).parents[1] / "fixtures" / "pair"
TEAM = PAIR / "team.yaml"
QUICK = ("--resolution", "0.6", "--duration", "2")
"""Options with which a run takes less than a second or two."""


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "octoreplay", "sweep", *map(str, arguments)]


def sweep(*arguments: object, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a sweep as a process and wait for it."""
    return subprocess.run(
        command(*arguments), cwd=folder, text=True, capture_output=True, check=False, timeout=300,
        env={**os.environ, "COLUMNS": "100", "PYTHONIOENCODING": "utf-8"},
    )  # fmt: skip


def table(folder: Path) -> list[dict[str, str]]:
    """Rows of the table without the columns that differ when a run is repeated."""
    with (folder / "table.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert all(set(TIMING_COLUMNS) <= set(row) for row in rows)
    return [{name: value for name, value in row.items() if name not in TIMING_COLUMNS} for row in rows]


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.01)


def children(process: subprocess.Popen[str]) -> list[Path]:
    """Child processes of a sweep, as folders in /proc."""
    lists = Path(f"/proc/{process.pid}/task").glob("*/children")
    return [Path("/proc") / pid for path in lists for pid in path.read_text().split()]


def is_running(process: Path) -> bool:
    """False if a process has ended, also if it is a zombie."""
    try:
        return (process / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
