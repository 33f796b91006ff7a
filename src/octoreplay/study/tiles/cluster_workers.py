"""Workers of a run in tiles on a dask.distributed cluster: each request is answered in a process of its own."""

from __future__ import annotations

import contextlib
import logging
import pickle
import threading
import time
import uuid
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from octoreplay._version import __version__
from octoreplay.errors import ConfigError, InputError, OctoreplayError
from octoreplay.io.output_file import write_whole, writing
from octoreplay.study.dask_client import check_address, connected, distributed
from octoreplay.study.tiles.worker import MAX_TRIES, DiedError, Request, Setup, WorkerProcess, died, warn_of_death

_log = logging.getLogger(__name__)

MEMORY = "MEMORY"
"""Resource of dask workers that a request takes [byte]."""

_POLL_SECONDS = 1.0
_MARKER = "running-*"


def check_cluster(scheduler: str, num_jobs: int, *, is_auto: bool, has_limit: bool) -> None:
    """Raise ConfigError for a scheduler with options that are not for it."""
    check_address(scheduler)
    if num_jobs != 1:
        raise ConfigError("--jobs applies to this machine and --scheduler to a cluster; leave one out")
    if is_auto and not has_limit:
        raise ConfigError(
            "tiles: the memory of a cluster's workers is unknown; give that of one process as --memory-limit with"
            " --tiles auto"
        )


class ClusterWorkers:
    """Workers of a scheduler such as ``tcp://host:8786`` (``Workers``).

    The workers need the work folder and the logs at the same paths. Requests go on while a marker file is in the work
    folder; they end at most a second after it is removed. Raises ConfigError without dask.distributed, and InputError
    where the scheduler does not answer.
    """

    def __init__(self, setup: Setup, scheduler: str) -> None:
        self._setup = setup
        self._scheduler = scheduler

    def __enter__(self) -> Self:
        folder = self._setup.folder
        with ExitStack() as stack:
            self._client = stack.enter_context(connected(self._scheduler))
            stale = list(folder.glob(_MARKER))
            with writing(folder):
                for path in stale:
                    path.unlink()
            if stale:
                # Requests of a run that was killed end.
                time.sleep(2 * _POLL_SECONDS)
            self._marker = folder / f"running-{uuid.uuid4().hex}"
            write_whole(self._marker, "")
            stack.callback(self._marker.unlink, missing_ok=True)
            self._closing = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._closing.close()

    def answers(self, requests: Sequence[Request]) -> Iterator[Any]:
        """Yield the answers to requests in the order in which they come; see ``Workers``."""
        waiting = {self._submitted(request): (request, 1) for request in requests}
        completed = distributed().as_completed(list(waiting), loop=self._client.loop)
        try:
            for future in completed:
                request, number = waiting.pop(future)
                answer = self._answer(future, request)
                if not isinstance(answer, DiedError):
                    yield answer
                    continue
                if number == MAX_TRIES:
                    raise died(request.name, str(answer))
                warn_of_death(request.name, str(answer))
                again = self._submitted(request)
                waiting[again] = request, number + 1
                completed.add(again)
        finally:
            with contextlib.suppress(Exception):
                self._client.cancel(list(waiting))

    def _submitted(self, request: Request) -> Any:
        """Future of a request; a worker that declares its memory takes as many requests as fit into it."""
        workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
        declared = [worker["resources"].get(MEMORY) for worker in workers]
        declares = bool(declared) and None not in declared
        if declares and max(declared) < request.memory_bytes:
            _log.info(
                "%s: takes about %.2g GB, more than any worker's %s; waiting for one with more",
                request.name, request.memory_bytes / 1e9, MEMORY,
            )  # fmt: skip
        # Other versions could not read the objects; dask's own pickles would be read before the versions are compared.
        data = pickle.dumps((self._setup, request), protocol=5)
        return self._client.submit(
            answer_on_worker, __version__, str(self._marker), data, pure=False,
            resources={MEMORY: request.memory_bytes} if declares else None,
        )  # fmt: skip

    def _answer(self, future: Any, request: Request) -> Any:
        """Answer of a finished request, or the DiedError of its process."""
        try:
            answer = future.result()
        except CancelledError:
            raise InputError(
                f"{self._scheduler}: the connection to the scheduler was lost; continue with --resume"
            ) from None
        except distributed().KilledWorker:
            raise died(request.name, "was lost with its worker") from None
        # A worker may raise anything before it starts the process, such as ImportError without octoreplay.
        except Exception as error:
            raise InputError(
                f"{request.name}: the worker could not start it: {type(error).__name__}: {error}"
            ) from error
        if isinstance(answer, OctoreplayError):
            raise answer
        return answer


def answer_on_worker(version: str, marker: str, data: bytes) -> Any:
    """Answer a request in a process on this worker; return its answer, its OctoreplayError or its DiedError."""
    if version != __version__:
        return InputError(
            f"the worker has octoreplay {__version__}, the run {version}; install the same version, and --resume"
        )
    path = Path(marker)
    if not path.exists():
        return InputError(
            f"the worker cannot see '{path.parent}'; workers need the folder of the result and the logs at the same"
            " paths; continue with --resume"
        )
    setup, request = pickle.loads(data)
    process, is_done = WorkerProcess(setup), threading.Event()
    watcher = threading.Thread(target=_end_without, args=(path, process, is_done), daemon=True)
    watcher.start()
    try:
        return process.answer(request)
    except (DiedError, OctoreplayError) as error:
        return error
    finally:
        is_done.set()
        watcher.join()
        process.stop()


def _end_without(marker: Path, process: WorkerProcess, is_done: threading.Event) -> None:
    """Kill a process when the run that needs it has ended."""
    while not is_done.wait(_POLL_SECONDS):
        if not marker.exists():
            process.kill()
            return
