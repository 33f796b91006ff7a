"""Time, peak memory and files of a command of octoreplay that starts processes of its own."""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

MEBIBYTE = 1024
"""One MiB [KiB]."""


class Peaks(NamedTuple):
    """Costs of a command.

    Attributes
    ----------
    seconds : float
        Time.
    processor_seconds : float
        Processor time of all its processes.
    own, child : float
        Peak memory of its process, and of its largest child [MiB].
    folder : float
        Peak size of a folder [MB].
    """

    seconds: float
    processor_seconds: float
    own: float
    child: float
    folder: float


def octoreplay(*words: object, folder: Path | None = None) -> Peaks:
    """Run a command; ``folder`` is watched while it runs. Ends this process where the command fails."""
    started, own, child, size = time.perf_counter(), 0, 0, 0
    before = _processor_seconds()
    process = subprocess.Popen([sys.executable, "-m", "octoreplay", *map(str, words)], stdout=subprocess.DEVNULL)
    while process.poll() is None:
        own = max(own, _peak(process.pid))
        child = max([child, *map(_peak, _children(process.pid))])
        size = max(size, 0 if folder is None else _size(folder))
        time.sleep(0.1)
    if process.returncode:
        raise SystemExit(f"octoreplay {' '.join(map(str, words))} ended with code {process.returncode}")
    seconds, used = time.perf_counter() - started, _processor_seconds() - before
    return Peaks(seconds, used, own / MEBIBYTE, child / MEBIBYTE, size / 1e6)


def _processor_seconds() -> float:
    """Processor time of all processes that this one has started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _peak(pid: int) -> int:
    """Peak resident memory of a process [KiB]; 0 where it has ended."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("VmHWM:")), 0)


def _children(pid: int) -> list[int]:
    """Child processes of a process."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            try:
                fields = (folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[1]) == pid:
                found.append(int(folder.name))
    return found


def _size(folder: Path) -> int:
    """Bytes of the files in a folder."""
    size = 0
    for path in folder.rglob("*"):
        try:
            size += path.stat().st_size
        except OSError:
            continue
    return size
