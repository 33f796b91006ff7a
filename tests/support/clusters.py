"""A dask scheduler with two workers, started as processes."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.command_line import wait_for


@dataclasses.dataclass
class Cluster:
    address: str
    scheduler: subprocess.Popen[bytes]
    workers: list[subprocess.Popen[bytes]]

    def children(self) -> list[Path]:
        """Child processes of the workers, as folders in /proc."""
        lists = (path for worker in self.workers for path in Path(f"/proc/{worker.pid}/task").glob("*/children"))
        return [Path("/proc") / pid for path in lists for pid in path.read_text().split()]


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Cluster]:
    """Scheduler with two workers."""
    pytest.importorskip("distributed")
    file = tmp_path / "scheduler.json"
    started: list[subprocess.Popen[bytes]] = []

    def start(*arguments: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            [sys.executable, "-m", "dask", *arguments, "--no-dashboard"], cwd=tmp_path, stderr=subprocess.DEVNULL
        )
        started.append(process)
        return process

    try:
        scheduler = start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file))
        # The scheduler creates its file before it writes it.
        wait_for(lambda: file.exists() and file.read_text().endswith("}"))
        address = json.loads(file.read_text())["address"]
        workers = [start("worker", address, "--nthreads", "1", "--no-nanny") for _ in range(2)]
        yield Cluster(address, scheduler, workers)
    finally:
        for process in started:
            process.kill()
            process.wait()
