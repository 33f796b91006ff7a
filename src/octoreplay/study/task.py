"""Execution of one run of a sweep in a process of its own.

The process reads a task as JSON from standard input and writes its row as JSON to standard output. It ends when its
standard input is closed, thus when its parent ends.
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
from octoreplay.records import FrameCounts
from octoreplay.run_metrics import RunSummary

Row = dict[str, Any]
"""Numbers and texts of one run by column."""

OK, DATA_LOST, FAILED = "ok", "data lost", "failed"
"""Values of the column ``status``."""


@dataclass(frozen=True)
class Task:
    """One run of a sweep, as given to a process.

    Attributes
    ----------
    name : str
        Name of the run.
    key : str
        Hash of everything that the run's numbers depend on.
    labels : mapping
        First columns of the row.
    team : str
        Text of the team file, with absolute paths.
    unfinished : str
        Path of the result while it is written.
    result : str
        Path of the result if it is kept.
    keep : bool
        True to keep the result.
    truth : str or None
        Path of the ground truth, None to skip the evaluation.
    version : str
        Version of octoreplay that made the task.
    num_threads : int
        Threads of the run.
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
    """Row of a failed run."""
    return {"status": FAILED, "error": " ".join(sentence.split())}


def to_json(row: Row) -> Row:
    """Row for JSON, with None for NaN and infinities."""
    return {name: None if isinstance(v, float) and not math.isfinite(v) else v for name, v in row.items()}


def from_json(row: Row) -> Row:
    """Row that was given to ``to_json``, with NaN for infinities."""
    return {name: math.nan if value is None else value for name, value in row.items()}


def execute_task(task: Task) -> Row:
    """Replay, measure and, if the truth is known, evaluate. If that fails, the row holds the reason."""
    from octoreplay.io.results.result_writer import partial_path

    try:
        return _replay_and_measure(task)
    except OctoreplayError as error:
        return failed(str(error))
    except MemoryError:
        return failed("out of memory")
    finally:
        for path in (Path(task.unfinished), partial_path(Path(task.unfinished))):
            path.unlink(missing_ok=True)


def _replay_and_measure(task: Task) -> Row:
    """Row of a task; errors are raised."""
    from octoreplay.config.team_file import parse_team
    from octoreplay.io.output_file import publish, writing
    from octoreplay.replay.run import replay_team
    from octoreplay.result import open_result
    from octoreplay.study.numbers import run_numbers, truth_numbers

    _compile_first()
    unfinished = Path(task.unfinished)
    config = parse_team(task.team, name=task.name, folder=Path("/"))
    summary = replay_team(config, unfinished, num_threads=task.num_threads, checkpoint_every=0.0)
    timing = _timing(summary)
    with open_result(unfinished) as result:
        row = run_numbers(summary, result.metrics)
    if task.truth is not None:
        from octoreplay.evaluate.evaluation import evaluate_result

        row |= truth_numbers(evaluate_result(unfinished, truth=Path(task.truth), over_time=False))
    if task.keep:
        with writing(Path(task.result)):
            publish(unfinished, Path(task.result))
    lost = "; ".join(f"{robot_id}: {_loss(c)}" for robot_id, c in summary.frame_counts.items() if c.lost_data)
    return {"status": DATA_LOST if lost else OK, "error": lost, **row, **timing}


def _compile_first() -> None:
    """Compile the kernels if needed, so that the run's time does not include compilation."""
    from octoreplay.mapping.warm_up import compile_if_needed

    compile_if_needed()


def _loss(counts: FrameCounts) -> str:
    """Data that one robot's logs lost."""
    damaged = f", {len(counts.truncated_files)} damaged logs" if counts.truncated_files else ""
    return f"{counts.skipped} images or clouds not mapped{damaged}"


def _timing(summary: RunSummary) -> Row:
    """Values of TIMING_COLUMNS."""
    factor = summary.log_seconds / summary.wall_seconds if summary.wall_seconds > 0 else math.nan
    return {"wall_seconds": summary.wall_seconds, "realtime_factor": factor, "peak_rss_bytes": _peak_memory()}


def _peak_memory() -> int:
    """Peak resident memory of this process in bytes."""
    try:
        # Unlike VmHWM, getrusage includes the memory that the parent had when it forked.
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _end_with_the_parent() -> None:
    """End this process when its standard input is closed, which happens whenever the parent ends."""
    os.read(0, 1)
    os._exit(1)


def main() -> None:
    """Execute the task on standard input."""
    # Standard output is for the row only; prints of libraries go to standard error.
    row_file = os.dup(1)
    os.dup2(2, 1)
    task = Task(**json.loads(sys.stdin.readline()))
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
    row = execute_task(task)
    with os.fdopen(row_file, "w", encoding="utf-8") as stream:
        json.dump(to_json(row), stream)


if __name__ == "__main__":
    main()
