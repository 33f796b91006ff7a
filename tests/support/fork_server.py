"""Server process that runs the command line in forked children, so that a run needs no imports and no compilation.

Each line on standard input is a request in JSON, each line on standard output its answer: ``start`` gives the process
id of a child, ``wait`` its exit code (negative for a signal that killed it).
"""

from __future__ import annotations

import errno
import json
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import Any

FAULTS = {
    "write": errno.ENOSPC, "fsync": errno.EIO, "open": errno.EACCES, "replace": errno.EIO, "mkdir": errno.ENOSPC,
    "unlink": errno.EIO, "ftruncate": errno.EIO,
}  # fmt: skip
"""Functions of ``os`` that fail on request, and their error."""


class Operations:
    """Count of calls of some functions; the call with number ``fails_at`` fails, and all later ones if ``stays``."""

    def __init__(self, fails_at: int, log: str, *, stays: bool) -> None:
        self.fails_at = fails_at
        self.stays = stays
        self.log = log
        self.num_calls = 0
        self.lock = threading.Lock()

    def install(self) -> None:
        for name, number in FAULTS.items():
            setattr(os, name, self.counted(name, getattr(os, name), number))

    def counted(self, name: str, function: Callable[..., Any], number: int) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            is_read = name == "open" and not arguments[1] & os.O_CREAT
            if is_read or (name == "write" and arguments[0] <= 2):
                return function(*arguments, **options)
            with self.lock:
                self.num_calls += 1
                fails = self.num_calls == self.fails_at or (self.stays and self.num_calls > self.fails_at > 0)
                with open(self.log, "w") as file:  # noqa: PTH123 - Path.open would be counted
                    file.write(str(self.num_calls))
            if fails:
                raise OSError(number, os.strerror(number), *(str(a) for a in arguments[:1] if name != "write"))
            return function(*arguments, **options)

        return call


class Calls:
    """Count of the calls of functions in a process; ``action`` is done at the call with number ``at``."""

    def __init__(self, at: int, action: Callable[[], None], log: str) -> None:
        self.at = at
        self.action = action
        self.log = log
        self.num_calls = 0

    def install(self) -> None:
        sys.setprofile(self.profile)

    def profile(self, frame: Any, event: str, _: Any) -> None:
        if event != "call" or "octoreplay" not in frame.f_code.co_filename:
            return
        self.num_calls += 1
        if self.num_calls == self.at:
            sys.setprofile(None)
            self.action()

    def report(self) -> None:
        sys.setprofile(None)
        with open(self.log, "w") as file:  # noqa: PTH123 - as above
            file.write(str(self.num_calls))


def out_of_memory() -> None:
    """Fail as an allocation does."""
    raise MemoryError


def run(request: dict[str, Any]) -> None:
    """Run one command line in this process, which then ends."""
    os.chdir(request["folder"])
    for descriptor, name in ((1, "stdout"), (2, "stderr")):
        file = os.open(request[name], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        os.dup2(file, descriptor)
        os.close(file)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    sys.argv = ["octoreplay", *request["arguments"]]
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    if "limits" in request:
        import resource

        for name, value in request["limits"].items():
            resource.setrlimit(getattr(resource, name), (value, value))
    if "fails_at" in request:
        Operations(request["fails_at"], request["log"], stays=request.get("stays", False)).install()
    calls = None
    if "calls_until" in request:
        number = request.get("signal")
        action = out_of_memory if number is None else lambda: os.kill(os.getpid(), number)
        calls = Calls(request["calls_until"], action, request["log"])
    from octoreplay import interrupts
    from octoreplay.__main__ import main

    if calls is not None:
        interrupts.install()
        calls.install()
    try:
        main()
    finally:
        if calls is not None:
            calls.report()


def serve() -> None:
    """Answer requests until standard input ends."""
    for line in sys.stdin:
        request = json.loads(line)
        if request["do"] == "wait":
            _, status = os.waitpid(request["pid"], 0)
            answer = os.waitstatus_to_exitcode(status)
        else:
            answer = os.fork()
            if answer == 0:
                run(request)
        sys.stdout.write(f"{answer}\n")
        sys.stdout.flush()


def warm_up(with_readers: bool) -> None:
    """Import and compile what a run needs, and the commands that read its result, by doing it once."""
    import contextlib
    import io
    import tempfile

    from octoreplay import cli
    from support.fixture_paths import PAIR_TEAM

    with tempfile.TemporaryDirectory() as name, contextlib.redirect_stdout(io.StringIO()):
        result = f"{name}/x.mcap"
        runs = [["run", str(PAIR_TEAM), "-o", result, "--duration", "1", "--settle", "1"]]
        reads = [
            ["metrics", result, "--csv", f"{name}/x.csv", "--plot", f"{name}/figures"],
            ["export", result, "-o", f"{name}/x.ply"],
        ]
        for words in [*runs, *(reads if with_readers else [])]:
            assert cli._exit_code(words) == 0, words


if __name__ == "__main__":
    sys.path.insert(0, os.path.dirname(os.path.dirname(__file__)))  # noqa: PTH120 - as the rest of this file
    warm_up(with_readers=sys.argv[1:] == ["with-readers"])
    serve()
