"""The command line, called in this process or started as a process of its own."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest import mock

from octoreplay import cli

# Tables depend on the width of the terminal.
ENVIRONMENT = {"COLUMNS": "100", "PYTHONIOENCODING": "utf-8"}


def octoreplay(*arguments: object, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Call the command line in this process, 100 columns wide; exceptions that no exit code covers are raised."""
    words = [str(argument) for argument in arguments]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stderr(err):
        log = cli.log_handler()
    logging.root.addHandler(log)
    try:
        with (
            mock.patch.dict(os.environ, ENVIRONMENT),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            contextlib.chdir(folder or Path.cwd()),
        ):
            code = cli._exit_code(words)
    finally:
        logging.root.removeHandler(log)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def octoreplay_process(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line as a process, 100 columns wide."""
    return subprocess.run(
        command(*arguments), text=True, capture_output=True, check=False, timeout=300,
        env={**os.environ, **ENVIRONMENT, **environment},
    )  # fmt: skip


def command(*arguments: object) -> list[str]:
    """Return the words that start the command line as a process."""
    return [sys.executable, "-m", "octoreplay", *map(str, arguments)]


@contextlib.contextmanager
def started(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """Start the command line as a process that reacts to SIGINT; it is killed at the end of the body."""
    # Processes in the background of a shell ignore SIGINT, and so would their children.
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        process = subprocess.Popen(command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    finally:
        signal.signal(signal.SIGINT, previous)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def wait_for(condition: Callable[[], bool], seconds: float = 120.0) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.01)


def assert_fails(code: int, sentence: str, *arguments: object) -> None:
    """Check that a command ends with an exit code and with a message on stderr that matches ``sentence``."""
    done = octoreplay(*arguments)
    assert done.returncode == code, done.stderr
    assert re.search(sentence, done.stderr), done.stderr


def output_of(code: int, *arguments: object) -> str:
    """Return what a command prints: stderr after wrong usage or where stdout is empty, else stdout."""
    done = octoreplay(*arguments)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stderr if code == 2 or not done.stdout else done.stdout
