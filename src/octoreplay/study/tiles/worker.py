"""Worker processes of a run in tiles: each waits for requests and answers them one by one."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Protocol, Self

from octoreplay.config.resolved import ResolvedRun
from octoreplay.errors import InputError, OctoreplayError

MAX_TRIES = 3
"""Number of processes that may die on one request."""

_NUM_ALLOCATIONS = 20_000
"""Allocations between two collections of garbage: a tick of a large team makes more objects than Python's 700."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Setup:
    """Settings of a run for its workers.

    Attributes
    ----------
    config : ResolvedRun
        Configuration of the whole run.
    folder : path
        Folder of the work files.
    num_threads : int
        Threads of a worker.
    memory_limit : int or None
        Largest memory of a worker [byte].
    """

    config: ResolvedRun
    folder: Path
    num_threads: int
    memory_limit: int | None = None


@dataclass(frozen=True)
class Request:
    """Work for a worker: a function of a module, called with the ``Setup`` and the arguments; all can be pickled.

    ``name`` is its subject in messages, such as that of a tile. ``memory_bytes`` is the memory that it takes by a
    forecast.
    """

    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...] = ()
    memory_bytes: int = 1_000_000_000


class DiedError(Exception):
    """The worker process ended without an answer."""


class WorkerProcess:
    """A worker process, started with the first request and again after its death."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._process: subprocess.Popen[bytes] | None = None

    def answer(self, request: Request) -> Any:
        """Return the answer to a request. Raises the error of the request, and DiedError."""
        try:
            if self._process is None:
                # With -P nothing is imported from the working folder. In a session of its own the child gets no Ctrl-C.
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-c", f"from {__name__} import serve; serve()"], stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE, start_new_session=True,
                )  # fmt: skip
                self._send(self._setup)
            self._send(request)
            assert self._process.stdout is not None
            answer = pickle.load(self._process.stdout)
        except (OSError, EOFError, pickle.UnpicklingError) as error:
            code = self.stop()
            raise DiedError(f"ended with code {code}" if code >= 0 else f"was killed by signal {-code}") from error
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def _send(self, content: object) -> None:
        assert self._process is not None
        assert self._process.stdin is not None
        pickle.dump(content, self._process.stdin, protocol=5)
        self._process.stdin.flush()

    def kill(self) -> None:
        """Kill the process; the request that it works on ends with DiedError."""
        if self._process is not None:
            with contextlib.suppress(OSError):
                self._process.kill()

    def stop(self) -> int:
        """End the process; return its exit code."""
        process, self._process = self._process, None
        if process is None:
            return 0
        with contextlib.suppress(OSError):
            process.kill()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        return process.wait()


class Workers(Protocol):
    """Workers of one run; a context manager that ends their work."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: object) -> None: ...

    def answers(self, requests: Sequence[Request]) -> Iterator[Any]:
        """Yield the answers to requests in the order in which they come.

        A request whose process died is given to another one, MAX_TRIES times. Raises the error of a request, and
        InputError where all processes died or the workers are lost.
        """
        ...


class LocalWorkers:
    """Worker processes on this machine (``Workers``)."""

    def __init__(self, setup: Setup, num_jobs: int) -> None:
        self._all = [WorkerProcess(setup) for _ in range(num_jobs)]
        self._free: SimpleQueue[WorkerProcess] = SimpleQueue()
        for worker in self._all:
            self._free.put(worker)
        self._is_closed = threading.Event()
        self._threads = ThreadPoolExecutor(num_jobs)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._is_closed.set()
        for worker in self._all:
            worker.stop()
        self._threads.shutdown(cancel_futures=True)

    def answers(self, requests: Sequence[Request]) -> Iterator[Any]:
        """Yield the answers to requests in the order in which they come; see ``Workers``."""
        futures = [self._threads.submit(self._answer, request) for request in requests]
        for future in as_completed(futures):
            yield future.result()

    def _answer(self, request: Request) -> Any:
        """Answer of any free worker."""
        worker = self._free.get()
        try:
            for number in range(MAX_TRIES):
                try:
                    return worker.answer(request)
                except DiedError as error:
                    if self._is_closed.is_set() or number == MAX_TRIES - 1:
                        raise died(request.name, str(error)) from error
                    warn_of_death(request.name, str(error))
        finally:
            self._free.put(worker)
        raise AssertionError


def died(name: str, cause: str) -> InputError:
    """Return the error of a request whose processes all died."""
    return InputError(
        f"{name}: its process {cause}, {MAX_TRIES} times; if memory ran out, give a smaller --tiles or fewer --jobs,"
        " and --resume"
    )


def warn_of_death(name: str, cause: str) -> None:
    """Warn of a process that died."""
    _log.warning("warning: %s: its process %s; it is started again", name, cause)


def serve() -> None:
    """Answer the requests of the parent process until it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # The warnings of a run are those of all its tiles; the parent gives them once.
    logging.disable(logging.WARNING)
    gc.set_threshold(_NUM_ALLOCATIONS)
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    # Whatever else prints must not mix with the answers.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    _end_with_parent()
    setup = pickle.load(sys.stdin.buffer)
    assert isinstance(setup, Setup)
    while True:
        try:
            request = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        pickle.dump(_answer_to(setup, request), answers, protocol=5)
        answers.flush()


def _answer_to(setup: Setup, request: Request) -> Any:
    """Answer to a request, or its error."""
    try:
        return request.function(setup, *request.arguments)
    except OctoreplayError as error:
        return error
    except Exception:
        return RuntimeError(f"{request.name}:\n{traceback.format_exc()}")


def _end_with_parent() -> None:
    """End this process when its parent ends."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            threading.Event().wait(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
