"""Calls in a forked child with limits on time and memory, which are measured for each call."""

from __future__ import annotations

import gc
import json
import os
import resource
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from octoreplay.errors import OctoreplayError
from octoreplay.mapping.warm_up import compile_if_needed

SAFETY = 6 << 30
"""Address space that a child may take on top of its own, so that a failed test does not harm the machine [byte]."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of one call: an error's text ('' for none), whether octoreplay foresaw it, time [s] and memory [byte]."""

    text: str
    is_foreseen: bool
    seconds: float
    num_bytes: int

    def problem(self, seconds: float, num_bytes: int) -> str:
        """Problem of the call; '' for none."""
        if not self.is_foreseen:
            return self.text
        if self.seconds > seconds:
            return f"took {self.seconds:.1f} s: {self.text}"
        return f"took {self.num_bytes / 1e6:.0f} MB: {self.text}" if self.num_bytes > num_bytes else ""


def outcomes(calls: Sequence[Callable[[], Any]], seconds: float = 20.0) -> Iterator[Outcome]:
    """Yield the outcome of each call. A call that ends the child, or takes longer than ``seconds``, costs a new one."""
    compile_if_needed()
    done = 0
    while done < len(calls):
        source, target = os.pipe()
        child = os.fork()
        if child == 0:
            _run(calls[done:], seconds, target)
        os.close(target)
        with os.fdopen(source, encoding="utf-8") as lines:
            for line in lines:
                yield Outcome(*json.loads(line))
                done += 1
        _, status = os.waitpid(child, 0)
        if done < len(calls):
            number = os.waitstatus_to_exitcode(status)
            yield Outcome(f"ended the process: {signal.Signals(-number).name if number < 0 else number}", False, 0.0, 0)
            done += 1


def outcome(call: Callable[[], Any], seconds: float = 20.0) -> Outcome:
    """Return the outcome of one call."""
    return next(outcomes([call], seconds))


def _run(calls: Sequence[Callable[[], Any]], seconds: float, target: int) -> None:
    """Make the calls in this child, write their outcomes, and end it."""
    try:
        own = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")
        # The objects of the parent take no time in collections between calls.
        gc.freeze()
        resource.setrlimit(resource.RLIMIT_AS, (own + SAFETY, own + SAFETY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        with os.fdopen(target, "w", encoding="utf-8") as lines:
            for call in calls:
                signal.setitimer(signal.ITIMER_REAL, seconds)
                lines.write(json.dumps(_measured(call)) + "\n")
                lines.flush()
    finally:
        os._exit(0)


def _measured(call: Callable[[], Any]) -> tuple[str, bool, float, int]:
    """Fields of the outcome of a call."""
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    before, start = _memory("VmRSS"), time.perf_counter()
    text, is_foreseen = "", True
    try:
        call()
    except OctoreplayError as error:
        text = str(error)
    except BaseException as error:
        frames, at = error.__traceback__, ""
        while frames is not None:
            name = frames.tb_frame.f_code.co_filename
            at = f"{name}:{frames.tb_lineno}" if "octoreplay" in name else at
            frames = frames.tb_next
        text, is_foreseen = f"{type(error).__name__}: {error} at {at}"[:1000], False
    return text, is_foreseen, time.perf_counter() - start, max(0, _memory("VmHWM") - before)


def _memory(name: str) -> int:
    """A line of /proc/self/status [byte]."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(name):
            return int(line.split()[1]) * 1024
    return 0
