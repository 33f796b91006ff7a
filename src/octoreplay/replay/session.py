"""A run: the robots' logs replayed on one clock, their maps exchanged and agreed on tick by tick."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from octoreplay.config.packets import PacketConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.time import TimeConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.read_ahead import ReadAhead
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.robots.team_bodies import TeamBodies
from octoreplay.mapping.consensus import Evidence, sum_of_evidence
from octoreplay.mapping.metrics import MapComparer, MapComparison
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import sensor_reach
from octoreplay.mapping.warm_up import second_compiler
from octoreplay.records import (
    CONVERGED,
    Float64Array,
    Frame,
    FrameCounts,
    LinkMetrics,
    RobotMetrics,
    RobotPose,
    RunSummary,
    TickMetrics,
)
from octoreplay.replay.exchange.encoder import PacketEncoder
from octoreplay.replay.exchange.messages import Acknowledgement, Content, Receipt
from octoreplay.replay.exchange.public_map import least_budget
from octoreplay.replay.interrupt import deferred_interrupts
from octoreplay.replay.network.graph import CommunicationGraph, Link, TeamNetwork, check_team_graph, step_size
from octoreplay.replay.network.links import LinkCounts, Links
from octoreplay.replay.recorder import Recorder
from octoreplay.replay.robots.consensus import ConsensusRobot
from octoreplay.replay.robots.flood import FloodRobot
from octoreplay.replay.robots.ratio import RatioRobot
from octoreplay.replay.robots.robot import MapSizes, Publication, Robot, Turn
from octoreplay.replay.settling import num_quiet_ticks, num_settle_ticks
from octoreplay.replay.tick import Tick, falls_due
from octoreplay.replay.timeline import Bodies, FrameSource, Timeline

SETTLE_MAX = "settle_max reached"
NO_SETTLING = "settling is off"

MAX_TICKS = 10_000_000
"""Most ticks of one run: a day at 100 Hz is 8.6 million."""

_Item = TypeVar("_Item")
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
    ``config.robots``, and ``bodies`` where the robots are, which then do not become part of the map. Raises ConfigError
    where epsilon is above the bound of a graph that occurs, and InputError where no robot has a frame. The result does
    not depend on ``num_threads``. ``is_symmetric`` says whether on all graphs so far every link carried both ways, with
    the same weight.
    """

    def __init__(
        self,
        config: RunConfig,
        sources: Sequence[FrameSource],
        *,
        bodies: Bodies | None = None,
        num_threads: int | None = None,
    ) -> None:
        if config.classes is None:
            raise InputError("a session needs a class table")
        self.config = config
        self.stop_reason = ""
        self.is_symmetric = True
        self._num_classes = config.classes.num_classes
        self._robot_ids = tuple(robot.robot_id for robot in config.robots)
        _check_budget(config.packet, self._num_classes)
        check_team_graph(config.network, config.consensus, self._robot_ids)
        self._network = TeamNetwork(config.network, config.consensus, self._robot_ids)
        self._timeline = Timeline(sources)
        self._bodies = bodies
        self._encoder = PacketEncoder(config.packet)
        families: dict[str, type[Robot]] = {"flood": FloodRobot, "ratio": RatioRobot}
        self._family = families.get(config.consensus.rule, ConsensusRobot)
        self._robots = [self._new_robot(index, 0) for index in range(len(self._robot_ids))]
        self._past_lives: list[Evidence] = []
        self._links: Links[Content] = Links(config)
        self._oracle = SemanticOctree(config.map.resolution, self._num_classes)
        self._comparer = MapComparer(len(self._robots), config.map.prior(self._num_classes))
        self._period_ns = round(config.network.publish_period * 1e9)
        self.num_threads = num_threads or min(len(self._robots), os.cpu_count() or 1)
        self._graph = self._network.at(0.0, [False] * len(self._robots), self._positions())

    def ticks(self) -> Iterator[Tick]:
        """The team after every tick, settling included; ``stop_reason`` is set at the end."""
        start_ns = self._timeline.first_stamp_ns
        if start_ns is None:
            raise InputError("no robot has a frame that can be used")
        with ThreadPoolExecutor(self.num_threads) as self._threads:
            number = 0
            while not self._timeline.exhausted or number == 0:
                self._check_next_frame(start_ns)
                yield self._tick(number, start_ns + number * self._period_ns)
                number += 1
            # The scans of the last period are in now; they have been published by nobody yet.
            yield from self._settle(number, start_ns)

    def _check_next_frame(self, start_ns: int) -> None:
        """Raise InputError where the next frame is more ticks away than a run may have: nobody waits for it."""
        next_ns = self._timeline.next_stamp_ns
        if next_ns is not None and (next_ns - start_ns) // self._period_ns >= MAX_TICKS:
            raise InputError(
                f"the frames from {start_ns / 1e9:.3f} s to {next_ns / 1e9:.3f} s span more than {MAX_TICKS:,} ticks "
                f"of {self.config.network.publish_period:g} s; check the stamps, or give clock: log"
            )

    def _settle(self, number: int, start_ns: int) -> Iterator[Tick]:
        """Ticks over the last graph with gamma ramped to 0, until no log-odds changes (Alg. 1's stopping rule)."""
        consensus = self.config.consensus
        if consensus.settle == 0:
            self.stop_reason = NO_SETTLING
            return
        slowest = self._links.longest_transmission
        quiet_ticks = num_quiet_ticks(self._graph, self.config, slowest)
        most = num_settle_ticks(self._graph, self.config, slowest)
        num_quiet = 0
        for n in range(1, most + 1):
            factor = max(0.0, 1.0 - n / consensus.settle)
            tick = self._tick(number, start_ns + number * self._period_ns, factor, settling=True)
            yield tick
            number += 1
            num_quiet = num_quiet + 1 if tick.metrics.max_change < consensus.settle_tolerance else 0
            if num_quiet >= quiet_ticks:
                self.stop_reason = CONVERGED
                return
        self.stop_reason = SETTLE_MAX

    def _tick(self, number: int, stamp_ns: int, gamma_factor: float = 1.0, *, settling: bool = False) -> Tick:
        """One tick, in the order of the paper: integrate, publish, deliver, iterate, measure."""
        if not settling:
            elapsed, before = number * self._period_ns / 1e9, (number - 1) * self._period_ns / 1e9
            self._forget(before, elapsed)
            self._integrate(number, stamp_ns)
            self._graph = self._network.at(elapsed, self._active(stamp_ns), self._positions())
        graph = self._graph
        self.is_symmetric &= graph.is_symmetric
        published = self._publish(graph, number, stamp_ns)
        receipts = self._deliver(graph, stamp_ns)
        changes = self._iterate(graph, gamma_factor, number)
        metrics = self._measure(graph, published, receipts, max(changes, default=0.0), number, stamp_ns, settling)
        self._encoder.end_tick()
        return Tick(
            number, stamp_ns, settling, graph, published, tuple(robot.map for robot in self._robots), self._oracle,
            tuple(RobotPose(r.robot_id, r.T_team_sensor) for r in self._robots if r.T_team_sensor is not None), metrics,
        )  # fmt: skip

    # --- who is there -------------------------------------------------------------------------------------------------

    def _new_robot(self, index: int, epoch: int) -> Robot:
        """A robot that knows nothing yet."""
        return self._family(index, self.config, self._num_classes, self._encoder, epoch)

    def _forget(self, after: float, until: float) -> None:
        """A robot that went off and forgets, in (after, until] seconds since the start, begins another life."""
        for index in np.flatnonzero(self._network.schedule.forgets(after, until)).tolist():
            robot = self._robots[index]
            # What it saw was seen: the oracle does not forget.
            self._past_lives.append(robot.evidence)
            self._robots[index] = self._new_robot(index, robot.source.epoch + 1)
            self._robots[index].T_team_sensor = robot.T_team_sensor
            self._comparer.forget()

    def _active(self, stamp_ns: int) -> list[bool]:
        """Which robots (N,) have begun and not left."""
        leaves = self.config.network.after_end == "leave"

        def is_active(index: int) -> bool:
            last_ns = self._timeline.last_stamp_ns(index)
            if last_ns is None:
                return False
            ended = self._timeline.has_ended(index) and last_ns < stamp_ns - self._period_ns
            return not (leaves and ended)

        return [is_active(index) for index in range(len(self._robots))]

    def _positions(self) -> Float64Array:
        """Where the robots' sensors are, (N, 3) in metres in the team's frame; NaN before the first scan."""
        positions = np.full((len(self._robots), 3), np.nan)
        for row, robot in zip(positions, self._robots, strict=True):
            if robot.T_team_sensor is not None:
                row[:] = robot.T_team_sensor[:3, 3]
        return positions

    # --- the steps of a tick ------------------------------------------------------------------------------------------

    def _integrate(self, number: int, stamp_ns: int) -> None:
        """Every scan with a stamp before the tick goes into its robot's evidence, read in the robot's thread.

        A robot that is off sees nothing.
        """
        schedule, start_ns = self._network.schedule, stamp_ns - number * self._period_ns
        if self._bodies is not None:
            self._bodies.advance(stamp_ns - self._period_ns, stamp_ns)

        def integrate(index: int) -> None:
            frames = self._timeline.frames_before(index, stamp_ns)
            now = (stamp_ns - start_ns) / 1e9
            seen = (frame for frame in frames if schedule.keeps(index, (frame.stamp_ns - start_ns) / 1e9, now))
            self._robots[index].integrate((self._with_bodies(index, frame) for frame in seen), number)

        self._each(integrate, range(len(self._robots)))

    def _with_bodies(self, index: int, frame: Frame) -> Frame:
        """A robot's frame with the boxes of the other robots in it."""
        if self._bodies is None:
            return frame
        return self._bodies.add_to(index, frame)

    def _publish(self, graph: CommunicationGraph, number: int, stamp_ns: int) -> tuple[Publication | None, ...]:
        """Every active robot that is due hands its packets to its links."""
        self._links.cut(graph.links)
        if self.config.consensus.rule == "local":
            return (None,) * len(self._robots)
        due = [index for index in graph.active if self._is_due(index, number)]
        with_unpruned = falls_due(number * self._period_ns, self._period_ns, self.config.output.state_every)

        def publish(index: int) -> Publication:
            robot = self._robots[index]
            return Publication(
                robot.publish(graph.receivers(index), number), robot.map_sizes(with_unpruned=with_unpruned)
            )

        published = dict(zip(due, self._each(publish, due), strict=True))
        for sender, publication in published.items():
            for receivers, message in publication.outbox:
                for receiver in receivers:
                    self._links.send(sender, receiver, message, stamp_ns)
        return tuple(published.get(index) for index in range(len(self._robots)))

    def _is_due(self, index: int, number: int) -> bool:
        """True when a robot publishes in the tick."""
        robot, period = self.config.robots[index], self.config.network.publish_period
        every = round((robot.publish_period or period) / period)
        return number % every == round(robot.publish_phase / period) % every

    def _deliver(self, graph: CommunicationGraph, stamp_ns: int) -> dict[Link, Receipt]:
        """Packets that are due go to their receivers, which answer; what became of them, by (sender, receiver)."""
        receipts: dict[Link, Receipt] = {}
        # Answers without delay arrive in the same tick, so the links are asked again.
        while deliveries := self._links.deliver(stamp_ns, graph.active):
            for delivery in deliveries:
                sender, receiver, content = delivery.sender, delivery.receiver, delivery.content
                robot = self._robots[receiver]
                if isinstance(content, Acknowledgement):
                    robot.exchange.acknowledged(sender, content)
                    continue
                receipt, answer = robot.receive(sender, content)
                receipts.setdefault((sender, receiver), Receipt()).add(receipt)
                if answer is not None and sender in graph.receivers(receiver):
                    self._links.send(receiver, sender, answer, stamp_ns)
        return receipts

    def _iterate(self, graph: CommunicationGraph, factor: float, number: int) -> list[float]:
        """Every active robot's iterations with the maps that arrived; the largest changes."""
        step_weights = 2.0 * step_size(graph, self.config.consensus) * graph.weights
        robots = self._robots
        turns = [Turn(robots[index], robots[index].take_arrivals(), step_weights[index]) for index in graph.active]
        return self._family.iterate_team(turns, factor, number, self.config, self._threads)

    def _measure(
        self,
        graph: CommunicationGraph,
        published: Sequence[Publication | None],
        receipts: Mapping[Link, Receipt],
        max_change: float,
        number: int,
        stamp_ns: int,
        settling: bool,
    ) -> TickMetrics:
        """The metrics of the tick, on its result."""
        changed = np.unique(np.concatenate([robot.changed_evidence(number) for robot in self._robots]))
        evidence = [*(robot.evidence for robot in self._robots), *self._past_lives]
        sum_of_evidence(self._oracle, evidence, changed, number)
        maps = [robot.map for robot in self._robots]
        comparison = self._comparer.compare(maps, self._oracle, graph.pairs, number, self._threads)
        counts = self._links.take_counts()
        links = self._link_metrics(graph, counts, receipts)
        robots = tuple(
            self._robot_metrics(index, index in graph.active, published[index], links, comparison)
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
            links=links,
        )

    def _robot_metrics(
        self,
        index: int,
        active: bool,
        published: Publication | None,
        links: Sequence[LinkMetrics],
        comparison: MapComparison,
    ) -> RobotMetrics:
        """One robot's part of the metrics."""
        robot = self._robots[index]
        num_cells = int(comparison.num_cells[index])
        sizes = published.sizes if published else MapSizes()
        sent_bytes = sum(link.sent_bytes for link in links if link.sender == robot.robot_id)
        if published and self.config.packet.cast == "broadcast":
            # One packet reaches all its receivers.
            sent_bytes -= sum((len(receivers) - 1) * message.num_bytes for receivers, message in published.outbox)
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
            sent_bytes=sent_bytes,
            packet_bytes=published.packet_bytes if published else 0,
            octree_bytes=sizes.octree_bytes,
            grid_bytes=sizes.grid_bytes,
            unpruned_bytes=sizes.unpruned_bytes,
            unpruned_compressed_bytes=sizes.unpruned_compressed_bytes,
        )

    def _link_metrics(
        self, graph: CommunicationGraph, counts: Mapping[Link, LinkCounts], receipts: Mapping[Link, Receipt]
    ) -> tuple[LinkMetrics, ...]:
        """What went over each directed link; also over one that is gone, when something was still on its way."""
        used = {link for link, count in counts.items() if count != LinkCounts()}
        entries = []
        for sender, receiver in sorted(used.union(graph.links)):
            count = counts.get((sender, receiver), LinkCounts())
            receipt = receipts.get((sender, receiver), Receipt())
            entries.append(
                LinkMetrics(
                    sender=self._robot_ids[sender], receiver=self._robot_ids[receiver],
                    **dataclasses.asdict(count), num_stale=receipt.num_stale, num_gaps=receipt.num_gaps,
                    num_damaged=receipt.num_damaged, bytes_per_second=count.sent_bytes / self._period_ns * 1e9,
                )
            )  # fmt: skip
        return tuple(entries)

    def _each(self, action: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
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
        session = Session(config, sources, bodies=bodies, num_threads=num_threads)
        threads = stack.enter_context(ThreadPoolExecutor(session.num_threads))
        writer = stack.enter_context(ResultWriter(output, config, config.classes)) if output else None
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
            warnings = (*_rule_warnings(config, session.is_symmetric), *_warnings(logs, recorder))
            summary = recorder.finish(session.stop_reason, counts, warnings, time.monotonic() - started)
            if writer is not None:
                writer.complete(summary)
        return summary


def _check_num_ticks(config: RunConfig, total_ns: int | None) -> None:
    """Raise ConfigError where a run would take more ticks than anybody waits for."""
    num_ticks = (total_ns or 0) / 1e9 / config.network.publish_period
    if num_ticks > MAX_TICKS:
        raise ConfigError(
            f"publish_period: the logs span {(total_ns or 0) / 1e9:.6g} s, which takes {num_ticks:.3g} ticks of "
            f"{config.network.publish_period:g} s, more than {MAX_TICKS:,}; check clock_offset and publish_period"
        )


def _check_budget(packet: PacketConfig, num_classes: int) -> None:
    """Refuse a budget that some brick would never fit into."""
    least = least_budget(packet, num_classes)
    if packet.budget is not None and packet.budget < least:
        raise ConfigError(
            f"budget: {packet.budget} bytes may not hold one brick of {num_classes} classes; give at least {least}, or"
            " a smaller content"
        )


def _rule_warnings(config: RunConfig, is_symmetric: bool) -> tuple[str, ...]:
    """What a user should know of a rule on this network, whose links carried the same both ways or did not."""
    rule, ids = config.consensus.rule, [robot.robot_id for robot in config.robots]
    if rule == "merge":
        return ("rule 'merge' adds up what it heard before again and again; it is a baseline, not a map to trust",)
    if rule != "bayes":
        return ()
    links = [config.link_config(a, b) for a in ids for b in ids if a != b]
    causes = {
        "links that do not carry the same both ways": not is_symmetric,
        "losses": any(link.mean_loss > 0 for link in links),
        "maps that arrive in a later tick": any(link.latency > 0 or link.rate is not None for link in links),
        "robots that publish at different times": len({(r.publish_period, r.publish_phase) for r in config.robots}) > 1,
        "maps that a budget holds back": config.packet.budget is not None,
        "robots that go off": any(entry.robots_off for entry in config.network.schedule),
    }
    found = [cause for cause, is_there in causes.items() if is_there]
    if not found:
        return ()
    # What a robot that is gone held is gone with 'ratio' too, and that rule knows no budget.
    others = "'flood' does" if causes["robots that go off"] or config.packet.budget else "'ratio' or 'flood' does"
    sentence = (
        "rule 'bayes' keeps the team's sum only when both ends of a link hear each other in every tick; with"
        f" {', '.join([*found[:-2], ' and '.join(found[-2:])])} it drifts from the mean; rule {others} not"
    )
    return (sentence,)


def _warnings(logs: Sequence[RobotLog], recorder: Recorder) -> tuple[str, ...]:
    """What a user should know of a run that went well."""
    sentences = []
    if recorder.last is not None and recorder.last.metrics.num_known_cells == 0:
        sentences.append(
            "the maps are empty: no ray passes the mapped region; check bounds, max_range, body_box and the poses"
        )
    sensors: dict[tuple[Path, str], str] = {}
    for log in logs:
        for source in ((path.resolve(), log.sensor_topic) for path in log.robot.logs):
            other = sensors.setdefault(source, log.robot_id)
            if other != log.robot_id:
                sentences.append(f"{other} and {log.robot_id} map the same messages of {source[0]}, which count twice")
    spans = [(log.robot.start_ns, log.robot.end_ns, log.robot_id) for log in logs]
    for start, _, robot_id in spans:
        others = [(a, b) for a, b, other in spans if other != robot_id]
        if start is not None and others and all(b is not None and b < start for _, b in others):
            sentences.append(f"{robot_id} starts when all other robots have ended; check the clock_offsets")
    return tuple(sentences)


def _causes(logs: Sequence[RobotLog], time: TimeConfig) -> str:
    """Why frames were not used, robot by robot."""

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
