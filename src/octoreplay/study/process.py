"""Process that executes one task of a sweep."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
import tempfile

from octoreplay.study.task import Row, Task, failed, from_json

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class TaskProcess:
    """Child process that executes a task with the task's number of threads.

    It inherits the processor affinity of the calling thread and ends when its parent ends. Raises OSError if it cannot
    be started.
    """

    def __init__(self, task: Task) -> None:
        self._row = tempfile.TemporaryFile()  # noqa: SIM115 (closed in wait)
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 (closed in wait)
        # With -P nothing is imported from the working folder. In a session of its own the child gets no Ctrl-C.
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "octoreplay.study.task"], stdin=subprocess.PIPE, stdout=self._row,
            stderr=self._errors, env={**os.environ, **dict.fromkeys(_THREADS, str(task.num_threads))},
            start_new_session=True,
        )  # fmt: skip
        assert self._process.stdin is not None
        # If the process has already ended, wait() reports it. The pipe stays open because its end ends the process.
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(dataclasses.asdict(task)).encode() + b"\n")
            self._process.stdin.flush()

    def kill(self) -> None:
        """Kill the process."""
        self._process.kill()

    def wait(self, seconds: float | None = None) -> Row | None:
        """Return the task's row, or None if the process takes longer than ``seconds``."""
        try:
            code = self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        with self._row, self._errors:
            self._row.seek(0)
            self._errors.seek(0)
            text = self._row.read()
            if code == 0 and text:
                return from_json(json.loads(text))
            return failed(_cause(code, self._errors.read().decode("utf-8", "replace")))


def _cause(code: int, errors: str) -> str:
    """Sentence that says why a process ended without a row."""
    if code < 0:
        try:
            name = f" ({signal.Signals(-code).name})"
        except ValueError:
            name = ""
        memory = "; the system may be out of memory" if -code == signal.SIGKILL else ""
        return f"killed by signal {-code}{name}{memory}"
    last = errors.strip().splitlines()[-1:] or ["no error message"]
    return f"ended with exit code {code}: {last[0]}"
