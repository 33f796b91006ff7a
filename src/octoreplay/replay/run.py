"""One run: resolve the configuration, open the logs, replay the team, record the result."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from octoreplay.config.run import RunConfig
from octoreplay.config.time import TimeConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.read_ahead import ReadAhead
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.robots.team_bodies import TeamBodies
from octoreplay.mapping.sensor import sensor_reach
from octoreplay.mapping.warm_up import second_compiler
from octoreplay.records import FrameCounts, RunSummary
from octoreplay.replay.interrupt import deferred_interrupts
from octoreplay.replay.recorder import Recorder
from octoreplay.replay.session import MAX_TICKS, Session
from octoreplay.replay.warnings import frame_warnings, map_warnings, rule_warnings


@dataclass(frozen=True)
class Progress:
    """Progress of a run.

    ``log_ns`` is the log time since t_0, ``total_ns`` the length of the replayed part of the logs (None: unknown),
    ``total_distance`` the disagreement Phi after the tick.
    """

    log_ns: int
    total_ns: int | None
    tick: int
    total_distance: float
    settling: bool


def replay_team(
    config: RunConfig,
    output: Path | None,
    *,
    progress: Callable[[Progress], None] | None = None,
    num_threads: int | None = None,
) -> RunSummary:
    """Replay a team's logs into agreed maps and write the result to ``output`` (None: no result, only the summary).

    A ``ResolvedRun`` is replayed as it is; any other configuration is resolved first.
    ``progress`` is called after every tick. ``num_threads`` (default: one per robot, at most one per processor) does
    not change the result. Raises ConfigError, InputError and OutputError, and then leaves no file; after a
    KeyboardInterrupt the finished part stays in the partial file beside ``output``.
    """
    started = time.monotonic()
    config = resolve(config)
    num_threads = num_threads or min(len(config.robots), os.cpu_count() or 1)
    with ExitStack() as stack:
        stack.enter_context(second_compiler())
        reach = sensor_reach(config.sensor, config.map)
        logs = [
            stack.enter_context(RobotLog(robot, config.time, config.classes, reach=reach)) for robot in config.robots
        ]
        team_start_ns = min(log.first_stamp_ns for log in logs)
        sources = [stack.enter_context(ReadAhead(log, team_start_ns)) for log in logs]
        hides = config.sensor.hide_robots
        bodies = stack.enter_context(TeamBodies(config.robots, config.time)) if hides else None
        threads = stack.enter_context(ThreadPoolExecutor(num_threads))
        session = Session(config, sources, threads, bodies=bodies)
        writer = stack.enter_context(ResultWriter(output, config)) if output else None
        recorder = Recorder(config, writer, threads)
        total_ns = config.total_ns
        _check_num_ticks(config, total_ns)
        with deferred_interrupts() as deliver_interrupts:
            try:
                for tick in session.ticks():
                    recorder.record(tick)
                    if progress is not None:
                        log_ns = tick.stamp_ns - recorder.start_ns
                        progress(Progress(log_ns, total_ns, tick.number, tick.metrics.total_distance, tick.settling))
                    deliver_interrupts()
            except InputError as error:
                if recorder.last is None:
                    raise InputError(f"{error}: {_causes(logs, config.time)}") from error
                raise
            counts = {log.robot_id: log.counts for log in logs}
            warnings = (
                *config.warnings,
                *rule_warnings(config, session.is_symmetric),
                *map_warnings(recorder.num_known_cells),
                *frame_warnings(*recorder.last_pairs),
            )
            summary = recorder.finish(session.stop_reason, counts, warnings, time.monotonic() - started)
            if writer is not None:
                writer.complete(summary)
        return summary


def _check_num_ticks(config: RunConfig, total_ns: int | None) -> None:
    """Raise ConfigError where a run would have more than MAX_TICKS ticks."""
    num_ticks = (total_ns or 0) / 1e9 / config.network.publish_period
    if num_ticks > MAX_TICKS:
        raise ConfigError(
            f"publish_period: the logs span {(total_ns or 0) / 1e9:.6g} s, which takes {num_ticks:.3g} ticks of "
            f"{config.network.publish_period:g} s, more than {MAX_TICKS:,}; check clock_offset and publish_period"
        )


def _causes(logs: Sequence[RobotLog], time: TimeConfig) -> str:
    """Causes for which frames were not used, robot by robot, with the remedy."""

    def text(counts: FrameCounts) -> str:
        causes = {
            "without a label": counts.no_label, "without a pose": counts.no_pose,
            "late": counts.late, "unreadable": counts.undecodable,
        }  # fmt: skip
        return ", ".join(f"{number} {cause}" for cause, number in causes.items() if number) or "no frames"

    found = "; ".join(f"{log.robot_id}: {text(log.counts)}" for log in logs)
    if time.start > 0 or time.duration is not None:
        return f"{found}; start and duration may leave none of them"
    return f"{found}; compare sensor and poses in 'octoreplay info', or try clock 'log' or a larger pose_gap"
