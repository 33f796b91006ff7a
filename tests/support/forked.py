"""Command line in processes that start quickly: children of a server (``fork_server.py``) that has all imports."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import uuid
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self


@dataclass(frozen=True)
class Done:
    """Exit code (negative: killed by a signal), texts, and number of counted calls of a process."""

    code: int
    out: str
    err: str
    count: int


class Child:
    """Process of a command line."""

    def __init__(self, server: ForkServer, pid: int, files: dict[str, Path]) -> None:
        self.pid = pid
        self._server = server
        self._files = files

    def wait(self) -> Done:
        """Wait until the process has ended."""
        code = self._server.ask({"do": "wait", "pid": self.pid})
        texts = {name: path.read_text(errors="replace") if path.is_file() else "" for name, path in self._files.items()}
        for path in self._files.values():
            if path.is_file():
                path.unlink()
        return Done(code, texts["stdout"], texts["stderr"], int(texts["log"] or 0))


class ForkServer:
    """Server of forked command lines; a context manager. Commands that read results are faster ``with_readers``."""

    def __init__(self, scratch: Path, *, with_readers: bool = False) -> None:
        self._scratch = scratch
        self._process = subprocess.Popen(
            [sys.executable, Path(__file__).with_name("fork_server.py"), *(["with-readers"] if with_readers else [])],
            text=True, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, start_new_session=True, env={**os.environ, "COLUMNS": "100"},
        )  # fmt: skip

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(60)
        self._process.stdout.close()

    def ask(self, request: dict[str, Any]) -> int:
        """Send a request and return the answer."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())

    def start(self, *arguments: object, folder: Path, **options: Any) -> Child:
        """Start a command line in a folder."""
        name = uuid.uuid4().hex
        files = {key: self._scratch / f"{name}.{key}" for key in ("stdout", "stderr", "log")}
        request = {"do": "start", "arguments": [str(word) for word in arguments], "folder": str(folder)}
        pid = self.ask({**request, **{key: str(path) for key, path in files.items()}, **options})
        return Child(self, pid, files)

    def run(self, *arguments: object, folder: Path, **options: Any) -> Done:
        """Run a command line in a folder."""
        return self.start(*arguments, folder=folder, **options).wait()
