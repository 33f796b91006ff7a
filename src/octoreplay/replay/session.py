"""A run: the robots' logs replayed on one clock, their maps exchanged and agreed on tick by tick."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from octoreplay.config import RunConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.discover import resolve
from octoreplay.io.result_writer import ResultWriter
from octoreplay.io.robot_log import RobotLog
from octoreplay.mapping.consensus import sum_of_evidence, team_step
from octoreplay.mapping.metrics import MapComparer, MapComparison
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.warm_up import second_compiler
from octoreplay.records import (
    FrameCounts,
    LinkMetrics,
    RobotMetrics,
    RobotPose,
    RunSummary,
    TickMetrics,
)
from octoreplay.replay.graph import (
    CommunicationGraph,
    build_graph,
    check_team_graph,
    settle_ticks_max,
    step_size,
)
from octoreplay.replay.interrupt import deferred_interrupts
from octoreplay.replay.recorder import Recorder
from octoreplay.replay.robot import Arrival, PublishedMap, Robot
from octoreplay.replay.tick import Tick, falls_due
from octoreplay.replay.timeline import FrameSource, Timeline

CONVERGED = "converged"
SETTLE_MAX = "settle_max reached"
NO_SETTLING = "settling is off"

MAX_TICKS = 10_000_000
"""Most ticks of one run: a day at 100 Hz is 8.6 million."""

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Progress:
    """How far a run is: log time since t_0, the whole log's length where it is known, and the disagreement."""

    log_ns: int
    total_ns: int | None
    tick: int
    total_distance: float
    settling: bool


class Session:
    """A team that replays frames and runs the consensus; iterate over ``ticks()``.

    ``config`` is resolved and has a class table; ``sources`` give each robot's frames, in the order of
    ``config.robots``. Raises ConfigError where epsilon is above the bound of a graph that occurs, and InputError where
    no robot has a frame. The result does not depend on ``num_threads``.
    """

    def __init__(self, config: RunConfig, sources: Sequence[FrameSource], *, num_threads: int | None = None) -> None:
        if config.classes is None:
            raise InputError("a session needs a class table")
        self.config = config
        self.stop_reason = ""
        num_classes = config.classes.num_classes
        self._robot_ids = tuple(robot.robot_id for robot in config.robots)
        check_team_graph(config.network, config.consensus, self._robot_ids)
        self._timeline = Timeline(sources)
        self._robots = tuple(Robot(robot_id, config, num_classes) for robot_id in self._robot_ids)
        self._oracle = SemanticOctree(config.map.resolution, num_classes)
        self._comparer = MapComparer(len(self._robots), config.map.prior(num_classes))
        self._period_ns = round(config.network.publish_period * 1e9)
        self.num_threads = num_threads or min(len(self._robots), os.cpu_count() or 1)
        self._graph = build_graph(config.network, self._robot_ids, [False] * len(self._robots))

    def ticks(self) -> Iterator[Tick]:
        """The team after every tick, settling included; ``stop_reason`` is set at the end."""
        start_ns = self._timeline.first_stamp_ns
        if start_ns is None:
            raise InputError("no robot has a frame that can be used")
        with ThreadPoolExecutor(self.num_threads) as self._threads:
            number = 0
            while not self._timeline.exhausted or number == 0:
                yield self._tick(number, start_ns + number * self._period_ns)
                number += 1
            # The scans of the last period are in now; they have been published by nobody yet.
            yield from self._settle(number, start_ns)

    def _settle(self, number: int, start_ns: int) -> Iterator[Tick]:
        """Ticks over the last graph with gamma ramped to 0, until no log-odds changes (Alg. 1's stopping rule)."""
        consensus = self.config.consensus
        if consensus.settle == 0:
            self.stop_reason = NO_SETTLING
            return
        most = settle_ticks_max(self._graph, consensus, step_size(self._graph, consensus))
        for n in range(1, most + 1):
            factor = max(0.0, 1.0 - n / consensus.settle)
            tick = self._tick(number, start_ns + number * self._period_ns, factor, settling=True)
            yield tick
            number += 1
            if tick.metrics.max_change < consensus.settle_tolerance:
                self.stop_reason = CONVERGED
                return
        self.stop_reason = SETTLE_MAX

    def _tick(self, number: int, stamp_ns: int, gamma_factor: float = 1.0, *, settling: bool = False) -> Tick:
        """One tick, in the order of the paper: integrate, publish, deliver, iterate, measure."""
        if not settling:
            self._integrate(number, stamp_ns)
            active = self._active(stamp_ns)
            if active != self._graph.active:
                flags = [i in active for i in range(len(self._robots))]
                self._graph = build_graph(self.config.network, self._robot_ids, flags)
        graph = self._graph
        published = self._publish(graph, number)
        changes = self._iterate(graph, published, gamma_factor, number)
        metrics = self._measure(graph, published, max(changes, default=0.0), number, stamp_ns, settling)
        return Tick(
            number, stamp_ns, settling, graph, published, tuple(robot.map for robot in self._robots), self._oracle,
            tuple(RobotPose(r.robot_id, r.T_team_sensor) for r in self._robots if r.T_team_sensor is not None), metrics,
        )  # fmt: skip

    def _integrate(self, number: int, stamp_ns: int) -> None:
        """Every scan with a stamp before the tick goes into its robot's evidence, read in the robot's thread."""

        def integrate(index: int) -> None:
            self._robots[index].integrate(self._timeline.frames_before(index, stamp_ns), number)

        self._each(integrate, range(len(self._robots)))

    def _active(self, stamp_ns: int) -> tuple[int, ...]:
        """Indices of the robots that take part in the tick."""
        leaves = self.config.network.after_end == "leave"

        def is_active(index: int) -> bool:
            last_ns = self._timeline.last_stamp_ns(index)
            if last_ns is None:
                return False
            ended = self._timeline.has_ended(index) and last_ns < stamp_ns - self._period_ns
            return not (leaves and ended)

        return tuple(index for index in range(len(self._robots)) if is_active(index))

    def _publish(self, graph: CommunicationGraph, number: int) -> tuple[PublishedMap | None, ...]:
        """Every active robot's map as a packet, and once what all its receivers make of it: the bytes are the same."""
        if self.config.consensus.rule == "local":
            return (None,) * len(self._robots)
        talking = [self._robots[index] for index in graph.active]
        with_unpruned = falls_due(number * self._period_ns, self._period_ns, self.config.output.state_every)
        packets = self._each(lambda robot: robot.publish(with_unpruned=with_unpruned), talking)
        maps = dict(zip(graph.active, packets, strict=True))
        return tuple(maps.get(index) for index in range(len(self._robots)))

    def _iterate(
        self, graph: CommunicationGraph, published: Sequence[PublishedMap | None], factor: float, number: int
    ) -> list[float]:
        """Every active robot's iterations with the maps that its neighbours published; the largest changes."""
        consensus = self.config.consensus
        epsilon = step_size(graph, consensus)
        arrived = {
            index: [
                Arrival(sender, packet.octree, 2.0 * epsilon * float(graph.weights[index, sender]))
                for sender in graph.neighbours(index)
                if (packet := published[sender]) is not None
            ]
            for index in graph.active
        }
        # One iteration with all maps, also where none arrived; the others make one for each map.
        together = [index for index in graph.active if consensus.mode == "sync" or not arrived[index]]
        alone = [index for index in graph.active if index not in together]
        robots = self._robots
        steps = self._each(lambda i: robots[i].next_step(published[i], arrived[i], factor, number), together)
        changes = team_step(steps, rule=consensus.rule, revision=number, threads=self._threads)
        self._each(lambda i: robots[i].end_step(number), together)
        changes += self._each(lambda i: robots[i].iterate_on_arrival(published[i], arrived[i], factor, number), alone)
        return changes

    def _measure(
        self,
        graph: CommunicationGraph,
        published: Sequence[PublishedMap | None],
        max_change: float,
        number: int,
        stamp_ns: int,
        settling: bool,
    ) -> TickMetrics:
        """The metrics of the tick, on its result."""
        changed = np.unique(np.concatenate([robot.changed_evidence(number) for robot in self._robots]))
        sum_of_evidence(self._oracle, [robot.evidence for robot in self._robots], changed, number)
        maps = [robot.map for robot in self._robots]
        comparison = self._comparer.compare(maps, self._oracle, graph.links, number, self._threads)
        robots = tuple(
            self._robot_metrics(index, index in graph.active, published[index], comparison)
            for index in range(len(self._robots))
        )
        num_leaves = sum(robot.num_leaves for robot in robots)
        return TickMetrics(
            tick=number,
            stamp_ns=stamp_ns,
            settling=settling,
            total_distance=comparison.total_distance,
            total_distance_all=comparison.total_distance_all,
            distance_per_leaf=comparison.total_distance / max(num_leaves, 1),
            distance_per_cell_and_link=comparison.total_distance / max(comparison.num_link_cells, 1),
            num_known_cells=comparison.num_known_cells,
            label_disagreement=comparison.label_disagreement,
            max_change=max_change,
            robots=robots,
            links=self._link_metrics(graph, published),
        )

    def _robot_metrics(
        self, index: int, active: bool, published: PublishedMap | None, comparison: MapComparison
    ) -> RobotMetrics:
        """One robot's part of the metrics."""
        robot = self._robots[index]
        num_cells = int(comparison.num_cells[index])
        return RobotMetrics(
            robot_id=robot.robot_id,
            active=active,
            num_scans=robot.num_scans,
            num_iterations=robot.num_iterations,
            agreement=float(comparison.agreement[index]),
            agreement_occupied=float(comparison.agreement_occupied[index]),
            num_leaves=robot.streams.num_leaves,
            num_cells=num_cells,
            observed_volume=num_cells * robot.map.resolution**3,
            entropy_bits=float(comparison.entropy_bits[index]),
            memory_bytes=robot.memory_bytes,
            packet_bytes=len(published.packet) if published else 0,
            octree_bytes=published.octree_bytes if published else 0,
            grid_bytes=published.grid_bytes if published else 0,
            unpruned_bytes=published.unpruned_bytes if published else 0,
            unpruned_compressed_bytes=published.unpruned_compressed_bytes if published else 0,
        )

    def _link_metrics(
        self, graph: CommunicationGraph, published: Sequence[PublishedMap | None]
    ) -> tuple[LinkMetrics, ...]:
        """What went over each directed link; every packet arrives in its own tick."""
        directed = sorted([*graph.links, *((b, a) for a, b in graph.links)])
        entries = []
        for sender, receiver in directed:
            packet = published[sender]
            size = len(packet.packet) if packet else 0
            sent = int(packet is not None)
            entries.append(
                LinkMetrics(
                    sender=self._robot_ids[sender], receiver=self._robot_ids[receiver], sent_bytes=size, num_sent=sent,
                    num_delivered=sent, num_lost=0, num_late=0, bytes_per_second=size / self._period_ns * 1e9,
                )
            )  # fmt: skip
        return tuple(entries)

    def _each(self, action: Callable[..., _Result], items: Iterable[object]) -> list[_Result]:
        """The action on every item, in parallel threads; results in the items' order."""
        return list(self._threads.map(action, items))


def replay_team(
    config: RunConfig,
    output: Path | None,
    *,
    progress: Callable[[Progress], None] | None = None,
    num_threads: int | None = None,
) -> RunSummary:
    """Replay a team's logs into agreed maps and write the result to ``output`` (None: only the summary).

    ``progress`` is called after every tick. Raises ConfigError, InputError and OutputError, and then leaves nothing
    behind; after a KeyboardInterrupt what was finished stays in the partial file beside ``output``.
    """
    started = time.monotonic()
    config = resolve(config)
    assert config.classes is not None
    with ExitStack() as stack:
        stack.enter_context(second_compiler())
        logs = [stack.enter_context(RobotLog(robot, config.time, config.classes)) for robot in config.robots]
        session = Session(config, logs, num_threads=num_threads)
        threads = stack.enter_context(ThreadPoolExecutor(session.num_threads))
        writer = stack.enter_context(ResultWriter(output, config, config.classes)) if output else None
        recorder = Recorder(config, writer, threads)
        total_ns = _total_ns(logs)
        _check_num_ticks(config, total_ns)
        try:
            for tick in session.ticks():
                with deferred_interrupts():
                    recorder.record(tick)
                if progress is not None:
                    log_ns = tick.stamp_ns - recorder.start_ns
                    progress(Progress(log_ns, total_ns, tick.number, tick.metrics.total_distance, tick.settling))
        except InputError as error:
            if recorder.last is None:
                raise InputError(f"{error}: {_causes(logs)}") from error
            raise
        counts = {log.robot_id: log.counts for log in logs}
        warnings = _warnings(logs, recorder)
        with deferred_interrupts():
            summary = recorder.finish(session.stop_reason, counts, warnings, time.monotonic() - started)
            if writer is not None:
                writer.complete(summary)
        return summary


def _total_ns(logs: Sequence[RobotLog]) -> int | None:
    """Length of the logs together, where they say it."""
    starts = [log.start_ns for log in logs if log.start_ns is not None]
    ends = [log.end_ns for log in logs if log.end_ns is not None]
    return max(ends) - min(starts) if starts and ends else None


def _check_num_ticks(config: RunConfig, total_ns: int | None) -> None:
    """Raise ConfigError where a run would take more ticks than anybody waits for."""
    num_ticks = (total_ns or 0) / 1e9 / config.network.publish_period
    if num_ticks > MAX_TICKS:
        raise ConfigError(
            f"publish_period: the logs span {(total_ns or 0) / 1e9:.6g} s, which takes {num_ticks:.3g} ticks of "
            f"{config.network.publish_period:g} s, more than {MAX_TICKS:,}; check clock_offset and publish_period"
        )


def _warnings(logs: Sequence[RobotLog], recorder: Recorder) -> tuple[str, ...]:
    """What a user should know of a run that went well."""
    sentences = []
    if recorder.last is not None and recorder.last.metrics.num_known_cells == 0:
        sentences.append("the maps are empty: no ray passes the mapped region; check bounds, max_range and the poses")
    spans = [(log.start_ns, log.end_ns, log.robot_id) for log in logs]
    for start, _, robot_id in spans:
        others = [(a, b) for a, b, other in spans if other != robot_id]
        if start is not None and others and all(b is not None and b < start for _, b in others):
            sentences.append(f"{robot_id} starts when all other robots have ended; check the clock_offsets")
    return tuple(sentences)


def _causes(logs: Sequence[RobotLog]) -> str:
    """Why frames were not used, robot by robot."""

    def text(counts: FrameCounts) -> str:
        causes = {
            "without a label": counts.no_label, "without a pose": counts.no_pose,
            "without intrinsics": counts.no_intrinsics, "late": counts.late, "unreadable": counts.undecodable,
        }  # fmt: skip
        return ", ".join(f"{number} {cause}" for cause, number in causes.items() if number) or "no frames"

    found = "; ".join(f"{log.robot_id}: {text(log.counts)}" for log in logs)
    return f"{found}; compare sensor and poses in 'octoreplay info', or try clock 'log' or a larger pose_gap"
