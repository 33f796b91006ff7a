"""Connection to a dask.distributed scheduler."""

from __future__ import annotations

import importlib
import logging
import re
from collections.abc import Generator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

from octoreplay.errors import ConfigError, InputError

_log = logging.getLogger(__name__)

_CONNECT_SECONDS = 5.0


@contextmanager
def connected(scheduler: str) -> Generator[Any]:
    """Yield a client of a scheduler such as ``tcp://host:8786``, which does not become dask's default client.

    Raises ConfigError if dask.distributed is not installed, InputError if the scheduler does not answer.
    """
    dask = distributed()
    with _quiet():
        try:
            client = dask.Client(scheduler, timeout=_CONNECT_SECONDS, set_as_default=False)
        # A server of another kind may cause any exception.
        except Exception as error:
            raise InputError(
                f"{scheduler}: no dask scheduler answered within {_CONNECT_SECONDS:g} s; start one with"
                " 'dask scheduler'"
            ) from error
        with client:
            if not client.scheduler_info(n_workers=1)["workers"]:
                _log.info("%s: no worker is connected; waiting for one", scheduler)
            yield client


def check_address(scheduler: str) -> None:
    """Raise ConfigError for a text that is no address of a scheduler."""
    if not re.fullmatch(r"(tcp|tls|ucx|ws|wss)://[^/\s]+:\d{1,5}/?", scheduler):
        raise ConfigError(f"scheduler: '{scheduler}' is not an address such as tcp://host:8786")


def distributed() -> ModuleType:
    """Import dask.distributed, an optional dependency. Raises ConfigError where it is missing."""
    try:
        return importlib.import_module("distributed")
    except ImportError:
        raise ConfigError(
            "scheduler: dask.distributed is not installed; use pip install 'octoreplay[cluster]'"
        ) from None


@contextmanager
def _quiet() -> Generator[None]:
    """Silence dask's logs of lost workers and connections, which octoreplay reports in its own words."""
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
