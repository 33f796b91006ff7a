"""Execution of a sweep's tasks on a dask.distributed cluster, each in a process of its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Generator, Sequence
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

from octoreplay._version import __version__
from octoreplay.errors import InputError
from octoreplay.study.dask_client import connected, distributed
from octoreplay.study.process import TaskProcess
from octoreplay.study.task import Row, Task, failed

_POLL_SECONDS = 1.0
"""Period at which a worker checks that the sweep has not ended."""


def execute_on_cluster(tasks: Sequence[Task], scheduler: str) -> Generator[tuple[Task, Row]]:
    """Execute tasks on the workers of a scheduler such as ``tcp://host:8786``; yield each task with its row.

    Tasks are yielded in the order in which they finish. Workers need the logs and the sweep's folder at the same paths
    as this machine. A task of a lost worker is given to another worker, and fails after a few lost workers. Closing
    the generator ends all tasks.

    Raises ConfigError if dask.distributed is not installed, InputError if the scheduler does not answer or is lost.
    """
    dask = distributed()
    with connected(scheduler) as client:
        # For pure functions dask returns the cached result of an equal call.
        waiting = {client.submit(execute_on_worker, dataclasses.asdict(task), pure=False): task for task in tasks}
        try:
            for future in dask.as_completed(list(waiting), loop=client.loop):
                yield waiting.pop(future), _row(future, scheduler)
        finally:
            client.cancel(list(waiting))


def execute_on_worker(content: dict[str, Any]) -> Row:
    """Execute a task in a process on this worker, until the sweep's folder of unfinished results is removed."""
    if content.get("version") != __version__:
        return failed(
            f"the worker has octoreplay {__version__}, the sweep {content.get('version')}; install the same version"
        )
    task = Task(**content)
    folder = Path(task.unfinished).parent
    if not folder.is_dir():
        return failed(
            f"the worker cannot see '{folder}'; workers need the sweep's folder and the logs at the same paths"
        )
    try:
        process = TaskProcess(task)
    except OSError as error:
        return failed(f"the process could not be started: {error.strerror}")
    while (row := process.wait(_POLL_SECONDS)) is None:
        if not folder.is_dir():
            process.kill()
    return row


def _row(future: Any, scheduler: str) -> Row:
    """Row of a finished task. Raises InputError if the scheduler was lost."""
    try:
        row: Row = future.result()
    except CancelledError:
        raise InputError(
            f"{scheduler}: the connection to the scheduler was lost; finished runs are kept, and the same command"
            " continues with the others"
        ) from None
    except distributed().KilledWorker:
        return failed("every worker that executed the run was lost; the workers may be out of memory")
    # A worker may raise anything before it starts the process, such as ImportError without octoreplay.
    except Exception as error:
        return failed(f"the worker could not start the run: {type(error).__name__}: {error}")
    return row
