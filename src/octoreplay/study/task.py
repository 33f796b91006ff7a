"""One run of a sweep, in a process of its own: a task as JSON on standard input, its row as JSON on standard output.

The process ends with the one that started it, which holds the other end of its standard input.
"""

from __future__ import annotations

import json
import math
import os
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from octoreplay.errors import OctoreplayError
from octoreplay.records import FrameCounts, RunSummary

Row = dict[str, Any]
"""What one run came to, by column."""

OK, DATA_LOST, FAILED = "ok", "data lost", "failed"
"""What ``status`` says."""


@dataclass(frozen=True)
class Task:
    """One run: a team file's text with absolute paths, and where its result goes.

    ``name`` is the run's, ``key`` identifies everything that its numbers depend on, ``labels`` are its first columns.
    The result is kept at ``result`` if ``keep`` is set, and written at ``unfinished`` until then. ``version`` is that
    of the program that made the task, ``num_threads`` how many threads the run has.
    """

    name: str
    key: str
    labels: Mapping[str, Any]
    team: str
    unfinished: str
    result: str
    keep: bool
    truth: str | None
    version: str
    num_threads: int


def failed(sentence: str) -> Row:
    """The row of a run that failed."""
    return {"status": FAILED, "error": " ".join(sentence.split())}


def to_json(row: Row) -> Row:
    """A row that JSON can hold: None for NaN and infinities."""
    return {name: None if isinstance(v, float) and not math.isfinite(v) else v for name, v in row.items()}


def from_json(row: Row) -> Row:
    """What ``to_json`` was given, with NaN for infinities."""
    return {name: math.nan if value is None else value for name, value in row.items()}


def run_task(task: Task) -> Row:
    """Replay, measure and, where there is a truth, evaluate; a run that fails says why in its row."""
    try:
        return _run(task)
    except OctoreplayError as error:
        return failed(str(error))
    except MemoryError:
        return failed("the run needs more memory than there is")
    finally:
        Path(task.unfinished).unlink(missing_ok=True)


def _run(task: Task) -> Row:
    from octoreplay.config.team_file import parse_team
    from octoreplay.replay.run import replay_team
    from octoreplay.result import open_result
    from octoreplay.study.numbers import run_numbers, truth_numbers

    _compile_first()
    unfinished = Path(task.unfinished)
    config = parse_team(task.team, source=task.name, folder=Path("/"))
    summary = replay_team(config, unfinished, num_threads=task.num_threads)
    timing = _timing(summary)
    with open_result(unfinished) as result:
        row = run_numbers(summary, result.metrics)
    if task.truth is not None:
        from octoreplay.evaluate.evaluation import evaluate_result

        row |= truth_numbers(evaluate_result(unfinished, truth=Path(task.truth), over_time=False))
    if task.keep:
        unfinished.replace(task.result)
    lost = "; ".join(f"{robot_id}: {_loss(c)}" for robot_id, c in summary.frame_counts.items() if c.lost_data)
    return {"status": DATA_LOST if lost else OK, "error": lost, **row, **timing}


def _compile_first() -> None:
    """Compile where there are no compiled kernels yet, so that the run's time is the run's."""
    from octoreplay.mapping.kernels import compiler
    from octoreplay.mapping.warm_up import compile_kernels

    if compiler.cache_is_empty():
        compile_kernels()


def _loss(counts: FrameCounts) -> str:
    """What one robot's logs lost."""
    damaged = f", {len(counts.truncated_files)} damaged logs" if counts.truncated_files else ""
    return f"{counts.skipped} images or clouds were not mapped{damaged}"


def _timing(summary: RunSummary) -> Row:
    """The values of TIMING_COLUMNS."""
    factor = summary.log_seconds / summary.wall_seconds if summary.wall_seconds > 0 else math.nan
    return {"wall_seconds": summary.wall_seconds, "realtime_factor": factor, "peak_rss_bytes": _peak_memory()}


def _peak_memory() -> int:
    """The most memory that this process has had resident, in bytes."""
    try:
        # getrusage counts what the process that started this one had as well.
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _end_with_the_parent() -> None:
    """End this process when its input ends, as it does with the process at the other end, however that ends."""
    os.read(0, 1)
    os._exit(1)


def main() -> None:
    """Run the task on standard input."""
    # Nothing that a library prints gets into the row.
    row_file = os.dup(1)
    os.dup2(2, 1)
    task = Task(**json.loads(sys.stdin.readline()))
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
    row = run_task(task)
    with os.fdopen(row_file, "w", encoding="utf-8") as stream:
        json.dump(to_json(row), stream)


if __name__ == "__main__":
    main()
