"""Runs of a sweep on this machine: as many processes at once as there are jobs, each on processors of its own."""

from __future__ import annotations

import os
import queue
import threading
from collections import deque
from collections.abc import Generator, Sequence

from octoreplay.study.process import RunProcess
from octoreplay.study.task import Row, Task, failed


def run_local(tasks: Sequence[Task], num_jobs: int | None = None) -> Generator[tuple[Task, Row]]:
    """Every task with its row, as they finish; ``num_jobs`` at once, as many as there are processors for unless given.

    All tasks have the same number of threads. Closing the generator ends the processes that still run.
    """
    num_threads = max(task.num_threads for task in tasks)
    pool = _Pool(tasks, min(num_jobs or max(1, _num_processors() // num_threads), len(tasks)), num_threads)
    try:
        for _ in tasks:
            yield pool.finished.get()
    finally:
        pool.stop()


class _Pool:
    """Workers, each of which waits for one process at a time."""

    def __init__(self, tasks: Sequence[Task], num_workers: int, num_threads: int) -> None:
        self.finished: queue.SimpleQueue[tuple[Task, Row]] = queue.SimpleQueue()
        self._left = deque(tasks)
        self._processes: dict[int, RunProcess] = {}
        self._lock = threading.Lock()
        self._workers = [
            threading.Thread(target=self._work, args=(slot, num_threads), daemon=True) for slot in range(num_workers)
        ]
        for worker in self._workers:
            worker.start()

    def stop(self) -> None:
        """End all processes and workers."""
        with self._lock:
            self._left.clear()
            for process in self._processes.values():
                process.kill()
        for worker in self._workers:
            worker.join()

    def _work(self, slot: int, num_threads: int) -> None:
        """Do what is left, one after the other."""
        _pin(slot, num_threads)
        while True:
            with self._lock:
                if not self._left:
                    return
                task = self._left.popleft()
                try:
                    process = self._processes[slot] = RunProcess(task)
                except OSError as error:
                    self.finished.put((task, failed(f"no process could be started: {error.strerror}")))
                    continue
            row = process.wait()
            with self._lock:
                del self._processes[slot]
            assert row is not None
            self.finished.put((task, row))


def _num_processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _pin(slot: int, num_threads: int) -> None:
    """Keep this thread, and the processes that it starts, to as many processors as a run has threads."""
    if hasattr(os, "sched_setaffinity"):
        allowed = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {allowed[(slot * num_threads + n) % len(allowed)] for n in range(num_threads)})
