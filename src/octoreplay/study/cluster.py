"""Execution of a sweep's tasks on a dask.distributed cluster, each in a process of its own."""

from __future__ import annotations

import dataclasses
import importlib
import logging
from collections.abc import Generator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from octoreplay._version import __version__
from octoreplay.errors import ConfigError, InputError
from octoreplay.study.process import TaskProcess
from octoreplay.study.task import Row, Task, failed

logger = logging.getLogger(__name__)

_CONNECT_SECONDS = 5.0
_POLL_SECONDS = 1.0
"""Period at which a worker checks that the sweep has not ended."""


def execute_on_cluster(tasks: Sequence[Task], scheduler: str) -> Generator[tuple[Task, Row]]:
    """Execute tasks on the workers of a scheduler such as ``tcp://host:8786``; yield each task with its row.

    Tasks are yielded in the order in which they finish. Workers need the logs and the sweep's folder at the same paths
    as this machine. A task of a lost worker is given to another worker, and fails after a few lost workers. Closing
    the generator ends all tasks.

    Raises ConfigError if dask.distributed is not installed, InputError if the scheduler does not answer or is lost.
    """
    distributed = _distributed()
    with _quiet(), _connected(scheduler) as client:
        if not client.scheduler_info(n_workers=1)["workers"]:
            logger.info("%s: no worker is connected; waiting for one", scheduler)
        # For pure functions dask returns the cached result of an equal call.
        waiting = {client.submit(execute_on_worker, dataclasses.asdict(task), pure=False): task for task in tasks}
        try:
            for future in distributed.as_completed(list(waiting), loop=client.loop):
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
    except _distributed().KilledWorker:
        return failed("every worker that executed the run was lost; the workers may be out of memory")
    # A worker may raise anything before it starts the process, such as ImportError without octoreplay.
    except Exception as error:
        return failed(f"the worker could not start the run: {type(error).__name__}: {error}")
    return row


@contextmanager
def _connected(scheduler: str) -> Generator[Any]:
    """Client of the scheduler that does not become dask's default client."""
    distributed = _distributed()
    try:
        client = distributed.Client(scheduler, timeout=_CONNECT_SECONDS, set_as_default=False)
    # A server of another kind may cause any exception.
    except Exception as error:
        raise InputError(
            f"{scheduler}: no dask scheduler answered within {_CONNECT_SECONDS:g} s; start one with 'dask scheduler'"
        ) from error
    with client:
        yield client


def _distributed() -> ModuleType:
    """Import dask.distributed, an optional dependency."""
    try:
        return importlib.import_module("distributed")
    except ImportError:
        raise ConfigError(
            "scheduler: dask.distributed is not installed; use pip install 'octoreplay[cluster]'"
        ) from None


@contextmanager
def _quiet() -> Generator[None]:
    """Silence dask's logs of lost workers and connections, which the rows and InputError report."""
    # dask sets levels on some of its own loggers.
    names = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]
    levels = {dask_logger: dask_logger.level for dask_logger in map(logging.getLogger, names)}
    for dask_logger in levels:
        dask_logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for dask_logger, level in levels.items():
            dask_logger.setLevel(level)
