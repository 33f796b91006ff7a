"""Runs of a sweep on a dask.distributed cluster: every worker starts each run as a process of its own."""

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
from octoreplay.study.process import RunProcess
from octoreplay.study.task import Row, Task, failed

logger = logging.getLogger(__name__)

_CONNECT_SECONDS = 5.0
_LOOK_SECONDS = 1.0
"""How often a worker looks whether the sweep is still there."""


def run_on_cluster(tasks: Sequence[Task], scheduler: str) -> Generator[tuple[Task, Row]]:
    """Every task with its row, as they finish on the workers of a scheduler such as ``tcp://host:8786``.

    Workers need the logs and the sweep's folder under the same paths as here. A run whose worker is lost goes to
    another one, and has failed after a few of these. Closing the generator ends the runs. Raises ConfigError where
    dask.distributed is not installed or the address is none, InputError where the scheduler does not answer or is lost.
    """
    distributed = _distributed()
    with _quiet(), _connected(scheduler) as client:
        if not client.scheduler_info(n_workers=1)["workers"]:
            logger.info("%s: has no worker yet; waiting for one", scheduler)
        # Not pure: dask would hand out what it remembers of an equal task.
        waiting = {client.submit(run_here, dataclasses.asdict(task), pure=False): task for task in tasks}
        try:
            for future in distributed.as_completed(list(waiting), loop=client.loop):
                yield waiting.pop(future), _row(future, scheduler)
        finally:
            client.cancel(list(waiting))


def run_here(content: dict[str, Any]) -> Row:
    """Do a task on the worker that calls this; the run ends when the sweep's folder of unfinished runs is gone."""
    if content.get("version") != __version__:
        return failed(
            f"a worker has octoreplay {__version__} and the sweep {content.get('version')}; install the same version"
        )
    task = Task(**content)
    folder = Path(task.unfinished).parent
    if not folder.is_dir():
        return failed(
            f"a worker does not see '{folder}'; workers need the sweep's folder and the logs at the same paths"
        )
    try:
        process = RunProcess(task)
    except OSError as error:
        return failed(f"no process could be started: {error.strerror}")
    while (row := process.wait(_LOOK_SECONDS)) is None:
        if not folder.is_dir():
            process.kill()
    return row


def _row(future: Any, scheduler: str) -> Row:
    """What became of a run. Raises InputError where the scheduler is gone."""
    try:
        row: Row = future.result()
    except CancelledError:
        raise InputError(
            f"{scheduler}: the scheduler was lost; what is finished is kept, and the same command goes on with the"
            " others"
        ) from None
    except _distributed().KilledWorker:
        return failed("the workers that it ran on were lost, one after the other; memory may have run out there")
    # Whatever a worker raises before the run's process starts, such as that the package is not there.
    except Exception as error:
        return failed(f"a worker could not start it: {type(error).__name__}: {error}")
    return row


@contextmanager
def _connected(scheduler: str) -> Generator[Any]:
    """A client of the scheduler, which does not become dask's default one."""
    distributed = _distributed()
    try:
        client = distributed.Client(scheduler, timeout=_CONNECT_SECONDS, set_as_default=False)
    # What is there may be no scheduler, and its answer then means anything.
    except Exception as error:
        raise InputError(
            f"{scheduler}: no dask scheduler answers there within {_CONNECT_SECONDS:g} s; start one with"
            " 'dask scheduler'"
        ) from error
    with client:
        yield client


def _distributed() -> ModuleType:
    """dask.distributed, which is an optional extra."""
    try:
        return importlib.import_module("distributed")
    except ImportError:
        raise ConfigError(
            "scheduler: needs dask.distributed, which is not installed; pip install 'octoreplay[cluster]'"
        ) from None


@contextmanager
def _quiet() -> Generator[None]:
    """What dask says of lost workers and connections is said in the runs' rows, or as one sentence."""
    # dask gives some of its loggers levels of their own.
    names = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]
    levels = {dask_logger: dask_logger.level for dask_logger in map(logging.getLogger, names)}
    for dask_logger in levels:
        dask_logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for dask_logger, level in levels.items():
            dask_logger.setLevel(level)
