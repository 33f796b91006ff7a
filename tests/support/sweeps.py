"""Helpers for tests of small sweeps and their processes."""

from __future__ import annotations

import csv
import subprocess
from pathlib import Path

from octoreplay.study.numbers import TIMING_COLUMNS

QUICK = ("--resolution", "0.6", "--duration", "2")
"""Options with which a run takes less than a second or two."""


def table(folder: Path) -> list[dict[str, str]]:
    """Rows of the table without the columns that differ when a run is repeated."""
    with (folder / "table.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert all(set(TIMING_COLUMNS) <= set(row) for row in rows)
    return [{name: value for name, value in row.items() if name not in TIMING_COLUMNS} for row in rows]


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
