"""One run: resolve the configuration, open the logs, replay the team, record the result."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from octoreplay import interrupts
from octoreplay.config.fields import MAX_TICKS
from octoreplay.config.run import RunConfig
from octoreplay.config.time import TimeConfig
from octoreplay.errors import ConfigError, InputError, MemoryLimitError
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.team_bodies import TeamBodies
from octoreplay.mapping.warm_up import second_compiler
from octoreplay.records import FilePath, FrameCounts
from octoreplay.replay.checkpoint import Checkpoints, can_resume
from octoreplay.replay.frames import without_computed_frames
from octoreplay.replay.memory import MemoryWatch
from octoreplay.replay.recorder import Recorder
from octoreplay.replay.session import Session
from octoreplay.replay.sources import TeamSources
from octoreplay.replay.warnings import coverage_warnings, map_warnings, packet_warnings, rule_warnings
from octoreplay.run_metrics import RunSummary

_log = logging.getLogger(__name__)


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
    output: FilePath | None,
    *,
    progress: Callable[[Progress], None] | None = None,
    num_threads: int | None = None,
    restart: bool = False,
    resume: bool = False,
    checkpoint_every: float | None = None,
    memory_limit: int | None = None,
) -> RunSummary:
    """Replay a team's logs into agreed maps and write the result to ``output`` (None: no result, only the summary).

    A ``ResolvedRun`` is replayed as it is; any other configuration is resolved first.
    ``progress`` is called after every tick. ``num_threads`` (default: one per robot, at most one per processor) does
    not change the result. Raises ConfigError, InputError and OutputError. After an error or a KeyboardInterrupt the
    finished ticks stay in the partial file beside ``output``, which a note of the exception names; without a tick no
    file is left. A partial file of an earlier run is an error, unless ``restart`` removes it, or ``resume`` continues
    after its last check point and ends with the bytes of an undisturbed run. Without a check point ``resume`` starts
    from the beginning. ``checkpoint_every`` is the least time between check points [s], 0 for none; by default they
    take at most 3 % of the time. Above ``memory_limit`` [byte] of memory the run ends with MemoryLimitError, as after
    any error; a warning says where it will take more than there is.
    """
    started = time.monotonic()
    output = None if output is None else Path(output)
    config = resolve(config)
    if config.alignment.is_on_air:
        config = without_computed_frames(config)
    total_ns = config.total_ns
    check_num_ticks(config, total_ns)
    num_threads = num_threads or min(len(config.robots), os.cpu_count() or 1)
    with ExitStack() as stack:
        stack.enter_context(second_compiler())
        team = stack.enter_context(TeamSources(config))
        hides = config.sensor.hide_robots
        bodies = stack.enter_context(TeamBodies(config.robots, config.time)) if hides else None
        threads = stack.enter_context(ThreadPoolExecutor(num_threads))
        session = Session(config, team.sources, threads, bodies=bodies, reopen=team.reopen)
        continues = output is not None and resume and can_resume(output)
        writer = None
        if output is not None:
            if resume and not continues:
                _log.info("%s: nothing to resume; starts from the beginning", output)
            writer = stack.enter_context(ResultWriter(output, config, restart=restart or resume, continues=continues))
        recorder = stack.enter_context(Recorder(config, writer, threads))
        checkpoints = None if writer is None else Checkpoints(session, recorder, writer, checkpoint_every)
        if checkpoints is not None:
            checkpoints.restore() if continues else checkpoints.remove()
        memory = MemoryWatch(memory_limit, total_ns)
        with interrupts.deferred() as deliver_interrupts:
            try:
                for tick in session.ticks():
                    recorder.record(tick)
                    log_ns = tick.stamp_ns - recorder.start_ns
                    if progress is not None:
                        progress(Progress(log_ns, total_ns, tick.number, tick.metrics.total_distance, tick.settling))
                    # Frees the versions of maps in its messages.
                    del tick
                    if checkpoints is not None:
                        checkpoints.save_if_due()
                    memory.check(log_ns)
                    deliver_interrupts()
            except (KeyboardInterrupt, MemoryLimitError):
                if checkpoints is not None:
                    checkpoints.save()
                raise
            except InputError as error:
                if recorder.last is None:
                    raise InputError(f"{error}: {frame_causes(team.counts, config.time)}") from error
                raise
            team.leave_out(session.num_frames_off)
            warnings = (
                *config.warnings,
                *rule_warnings(config, session.is_symmetric),
                *packet_warnings(config),
                *map_warnings(0 if recorder.last is None else recorder.last.metrics.num_known_cells),
                *recorder.frame_warnings(),
                *coverage_warnings(team.counts),
            )
            summary = recorder.finish(
                session.stop_reason, team.counts, warnings, time.monotonic() - started, session.joining
            )
            if writer is not None and checkpoints is not None:
                deliver_interrupts()
                writer.complete(summary)
                checkpoints.remove()
        return summary


def check_num_ticks(config: RunConfig, total_ns: int | None) -> None:
    """Raise ConfigError where a run would have more than MAX_TICKS ticks."""
    num_ticks = (total_ns or 0) / 1e9 / config.network.publish_period
    if config.consensus.settle:
        # Settling ends at the earliest after its ramp, and after the longest delay of a packet.
        latencies = [config.link.latency, *(dict(values).get("latency", 0.0) for *_, values in config.link_overrides)]
        num_settling = max(config.consensus.settle, max(latencies) / config.network.publish_period)
        if num_ticks <= MAX_TICKS < num_ticks + num_settling:
            raise ConfigError(
                f"settle, latency: {num_settling:,.0f} settling ticks after {num_ticks:,.0f} ticks of logs are more"
                f" than {MAX_TICKS:,}; give smaller ones, or settle 0"
            )
    if num_ticks > MAX_TICKS:
        raise ConfigError(
            f"publish_period: the logs span {(total_ns or 0) / 1e9:.6g} s, which takes {num_ticks:.3g} ticks of "
            f"{config.network.publish_period:g} s, more than {MAX_TICKS:,}; check clock_offset and publish_period"
        )


def frame_causes(counts: Mapping[str, FrameCounts], time: TimeConfig) -> str:
    """Causes for which frames were not used, robot by robot, with the remedy."""

    def text(of_robot: FrameCounts) -> str:
        causes = {
            "without a label": of_robot.no_label, "without a pose": of_robot.no_pose,
            "late": of_robot.late, "unreadable": of_robot.undecodable,
        }  # fmt: skip
        return ", ".join(f"{number} {cause}" for cause, number in causes.items() if number) or "no frames"

    found = "; ".join(f"{robot_id}: {text(of_robot)}" for robot_id, of_robot in counts.items())
    if time.start > 0 or time.duration is not None:
        return f"{found}; start and duration may leave none of them"
    return f"{found}; compare sensor and poses in 'octoreplay info', or try clock 'log' or a larger pose_gap"
