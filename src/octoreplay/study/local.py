"""Execution of a sweep's tasks on this machine: parallel processes, each on processors of its own."""

from __future__ import annotations

import os
import queue
import threading
from collections import deque
from collections.abc import Generator, Sequence

from octoreplay.study.process import TaskProcess
from octoreplay.study.task import Row, Task, failed


def execute_locally(tasks: Sequence[Task], num_jobs: int | None = None) -> Generator[tuple[Task, Row]]:
    """Execute tasks in parallel processes; yield each task with its row, in the order in which they finish.

    ``num_jobs`` is the number of processes at once, by default processors / threads of a task. All tasks have the same
    number of threads. Closing the generator kills the processes that have not finished.
    """
    num_threads = max(task.num_threads for task in tasks)
    pool = _WorkerPool(tasks, min(num_jobs or max(1, _num_processors() // num_threads), len(tasks)), num_threads)
    try:
        for _ in tasks:
            yield pool.finished.get()
    finally:
        pool.stop()


class _WorkerPool:
    """Worker threads that start one process at a time each and wait for it."""

    def __init__(self, tasks: Sequence[Task], num_workers: int, num_threads: int) -> None:
        self.finished: queue.SimpleQueue[tuple[Task, Row]] = queue.SimpleQueue()
        self._left = deque(tasks)
        self._processes: dict[int, TaskProcess] = {}
        self._lock = threading.Lock()
        self._workers = [
            threading.Thread(target=self._work, args=(slot, num_threads), daemon=True) for slot in range(num_workers)
        ]
        for worker in self._workers:
            worker.start()

    def stop(self) -> None:
        """Kill all processes and join the workers."""
        with self._lock:
            self._left.clear()
            for process in self._processes.values():
                process.kill()
        for worker in self._workers:
            worker.join()

    def _work(self, slot: int, num_threads: int) -> None:
        """Execute the remaining tasks one by one."""
        _pin(slot, num_threads)
        while True:
            with self._lock:
                if not self._left:
                    return
                task = self._left.popleft()
                try:
                    process = self._processes[slot] = TaskProcess(task)
                except OSError as error:
                    self.finished.put((task, failed(f"the process could not be started: {error.strerror}")))
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
    """Restrict this thread and the processes that it starts to ``num_threads`` processors."""
    if hasattr(os, "sched_setaffinity"):
        allowed = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {allowed[(slot * num_threads + n) % len(allowed)] for n in range(num_threads)})
