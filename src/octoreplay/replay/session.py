"""Replay of a team: integrate, publish, deliver, iterate and measure, tick by tick (Alg. 1 of the paper)."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from typing import Any, TypeVar

from octoreplay.config.fields import MAX_TICKS
from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.rules import Exchanged
from octoreplay.errors import InputError
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import CastFrame, ScanCaster
from octoreplay.records import CENTRAL, RobotPose
from octoreplay.replay.exchange.messages import Acknowledgement, Content, Receipt
from octoreplay.replay.exchange.neighbours import Exchange
from octoreplay.replay.exchange.packet_codec import PacketCodec
from octoreplay.replay.exchange.public_map import check_budget
from octoreplay.replay.joining import Joining
from octoreplay.replay.measure import TickMeasurer, Traffic
from octoreplay.replay.network.graph import CommunicationGraph, Link, TeamNetwork, check_team_graph, step_weights_of
from octoreplay.replay.network.links import Links
from octoreplay.replay.robots.robot import REPLAY, Phase, Publication, Robot, Turn
from octoreplay.replay.robots.team import make_team
from octoreplay.replay.settling import NO_SETTLING, Settling
from octoreplay.replay.tick import Tick, falls_due
from octoreplay.replay.tick_counts import tick_metrics
from octoreplay.replay.timeline import Bodies, FrameSource, Position, Scan, Timeline

_STATE = (
    "is_symmetric", "num_frames_off", "team", "joining", "_network", "_links", "_measurer", "_graph", "_num_ticks",
    "_settling", "_reopened", "_start_ns",
)  # fmt: skip
"""Attributes of a session that change from tick to tick."""

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


class _ThreadCaster(threading.local):
    """Ray caster of each thread: its scratch memory is larger than most maps."""

    def __init__(self, config: ResolvedRun) -> None:
        self.caster = ScanCaster(config.effective_sensor, config.map, config.classes.num_classes)


class Session:
    """Replay of one team; iterate over ``ticks()``.

    Parameters
    ----------
    config : ResolvedRun
        Configuration of the run.
    sources : sequence of FrameSource
        Frames of each robot, in the order of ``config.robots``; none for a session that only settles.
    threads : Executor
        Threads for the work of a tick. The result does not depend on them.
    bodies : Bodies, optional
        Boxes of the robots' bodies; points inside them do not become part of the map.
    reopen : function, optional
        New source of the frames of a robot, given by its index, with another ``T_team_map`` (7 numbers); needed where
        robots begin in their own frames (``align: on-air``). ``sources`` are then in the frames of ``joining``.
    tile : optional
        Part of the space that ``config.map.bounds`` cut out of a run in tiles; the counts of a tick then have parts.

    Attributes
    ----------
    team : Team
        The robots.
    stop_reason : str
        Reason for the end, set after the last tick.
    is_symmetric : bool
        True while every link of all graphs so far carried both ways with the same weight.
    joining : Joining or None
        Frames that robots find during the run; None where they begin in the team's frame.
    num_frames_off : list of dict
        Number of frames of each robot that were left out because the schedule had the robot off, by sensor_index.

    Raises
    ------
    ConfigError
        Epsilon is not below the bound of a graph that occurs, or a budget is too small for one brick.
    InputError
        No robot has a frame.
    """

    def __init__(
        self,
        config: ResolvedRun,
        sources: Sequence[FrameSource[Scan]],
        threads: Executor,
        *,
        bodies: Bodies | None = None,
        reopen: Callable[[int, tuple[float, ...]], FrameSource[Scan]] | None = None,
        tile_cells: int | None = None,
    ) -> None:
        self.config = config
        self.stop_reason = ""
        self.is_symmetric = True
        self.num_frames_off = [dict.fromkeys(range(len(robot.views)), 0) for robot in config.robots]
        robot_ids = [robot.robot_id for robot in config.robots]
        check_budget(config.effective_packet, config.classes.num_classes)
        check_team_graph(config.network, config.consensus, robot_ids)
        self._threads = threads
        self._timeline = Timeline(sources)
        self._bodies = bodies
        self._network = TeamNetwork(config.network, config.consensus, robot_ids)
        self._packet_codec = PacketCodec(config.effective_packet)
        self.team = make_team(config, self._packet_codec)
        self.joining = Joining(config, self._packet_codec, threads) if config.alignment.is_on_air else None
        self._reopen = reopen
        self._of_thread = _ThreadCaster(config)
        self._links: Links[Content] = Links(config)
        self._measurer = TickMeasurer(config, threads, tile_cells)
        if self.joining is not None:
            self._measurer.regroup(self.joining.frames.components)
        self._period_ns = round(config.network.publish_period * 1e9)
        self._graph = self._network.at(0.0, [False] * len(robot_ids), self.team.positions())
        self._num_ticks = 0
        self._settling: Settling | None = None
        # Transform of each robot whose log was opened again.
        self._reopened: dict[int, tuple[float, ...]] = {}
        self._start_ns = self._timeline.first_stamp_ns

    def ticks(self) -> Iterator[Tick]:
        """The team after every tick, settling included; after ``restore``, every further tick."""
        if self._settling is None:
            yield from self.log_ticks()
        # The scans of the last period are integrated, but not published yet.
        yield from self.settling_ticks()

    def log_ticks(self) -> Iterator[Tick]:
        """The team after every tick before settling. Raises InputError without frames."""
        if self._start_ns is None:
            raise InputError("no robot has a frame that can be used")
        while self._has_scans():
            self._check_next_frame(self._start_ns)
            number, stamp_ns = self._num_ticks, self._stamp_of(self._num_ticks)
            self._join(number)
            self._integrate(number, stamp_ns)
            yield self._exchange(number, stamp_ns)

    @property
    def num_ticks(self) -> int:
        """Number of ticks so far."""
        return self._num_ticks

    @property
    def maps(self) -> dict[str, SemanticOctree]:
        """The robots' octrees h_i - h_0 by robot_id, and the centralised map."""
        return {**{robot.robot_id: robot.map for robot in self.team.robots}, CENTRAL: self._measurer.oracle}

    @property
    def evidence(self) -> dict[str, SemanticOctree]:
        """The robots' octrees s_i by robot_id."""
        return {robot.robot_id: robot.evidence.octree for robot in self.team.robots}

    @property
    def largest_log_odds(self) -> float:
        """Largest |log-odds| of any robot's map, relative to the prior."""
        return max(robot.largest_log_odds() for robot in self.team.robots)

    def settling_ticks(self, largest: float | None = None, least_ticks: int = 0) -> Iterator[Tick]:
        """The team after every tick over the last graph with gamma ramped to 0, until no log-odds changes.

        This is the stopping rule of Alg. 1. ``largest`` (default: ``largest_log_odds``) is that of the whole team where
        this is a tile of it. A team that has settled before tick ``least_ticks`` of settling goes on until then.
        """
        if self.config.consensus.settle == 0:
            self.stop_reason = NO_SETTLING
            return
        if self._settling is None:
            largest = self.largest_log_odds if largest is None else largest
            self._settling = Settling(self._graph, self.config, self._links.longest_transmission, largest)
        for phase in self._settling.phases(least_ticks):
            number = self._num_ticks
            tick = self._exchange(number, self._stamp_of(number), phase)
            self._settling.note(tick.metrics.max_change)
            yield tick
            # Frees the versions of maps in its messages.
            del tick
        self.stop_reason = self._settling.stop_reason

    # --- state between ticks ------------------------------------------------------------------------------------------

    @property
    def shared(self) -> dict[str, object]:
        """Objects that the state refers to, but does not contain, by name."""
        return {"config": self.config, "threads": self._threads, "packet_codec": self._packet_codec}

    def state(self) -> dict[str, Any]:
        """Return what ``restore`` needs to continue after the last tick; the next tick changes it."""
        return {"position": self._timeline.position, **{name: getattr(self, name) for name in _STATE}}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue a new session after the tick of a ``state``; reads the logs up to there again.

        A session without ``sources`` can only settle.
        Raises InputError where the logs hold fewer frames than were used.
        """
        position: Position = state["position"]
        for name in _STATE:
            setattr(self, name, state[name])
        if self._bodies is not None and self._settling is None:
            for number in range(self._num_ticks):
                self._advance_bodies(self._stamp_of(number))
        if self._reopen is not None:
            for index, T_team_map in self._reopened.items():
                self._timeline.rewind(index, self._reopen(index, T_team_map))
        if self._timeline.first_stamp_ns is not None:
            self._each(lambda index: self._timeline.skip_to(index, position), range(len(self.team.robots)))

    # --- one tick -----------------------------------------------------------------------------------------------------

    def _exchange(self, number: int, stamp_ns: int, phase: Phase = REPLAY) -> Tick:
        """The rest of a tick after its scans: publish, deliver, iterate, measure."""
        graph, robots, settling = self._graph, self.team.robots, phase.is_settling
        self.is_symmetric &= graph.is_symmetric
        published = self._publish(graph, number, stamp_ns)
        receipts = self._deliver(graph, stamp_ns)
        published_distance = self._measurer.published_distance(number, self.team, graph)
        max_change = self._iterate(graph, phase, number)
        traffic = Traffic(published, self._links.take_counts(), receipts)
        counts = self._measurer.measure(self.team, graph, traffic, published_distance, max_change)
        metrics = tick_metrics(self.config, number, stamp_ns, counts, settling=settling)
        if self.joining is not None:
            metrics = dataclasses.replace(metrics, places=self.joining.frames.places)
            if not settling:
                self.joining.search(robots, is_last=self._timeline.exhausted)
        self._packet_codec.end_tick()
        self._num_ticks = number + 1
        poses = (
            RobotPose(robot.robot_id, robot.T_team_sensor, metrics.frame_of(robot.robot_id))
            for robot in robots
            if robot.T_team_sensor is not None
        )
        return Tick(
            number, stamp_ns, settling, graph, published, tuple(robot.map for robot in robots),
            tuple(robot.evidence.octree for robot in robots), self._measurer.oracle, tuple(poses), metrics, counts,
            self._measurer.num_averaged,
        )  # fmt: skip

    # --- the steps of a tick ------------------------------------------------------------------------------------------

    def _join(self, number: int) -> None:
        """Give robots the frames that the last tick found for them; they integrate all their scans again."""
        if self.joining is None or self._reopen is None:
            return
        moved = self.joining.join(number, number * self._period_ns / 1e9)
        if not moved:
            return
        for index in moved:
            self.team.change_frame(index)
            self.num_frames_off[index] = dict.fromkeys(self.num_frames_off[index], 0)
            self._reopened[index] = self.joining.frames.T_frame_map(index)
            self._timeline.rewind(index, self._reopen(index, self._reopened[index]))
        # What is on the air is in a frame that one of its ends has left.
        self._links.lose(set(moved))
        self._measurer.regroup(self.joining.frames.components)

    def _integrate(self, number: int, stamp_ns: int) -> None:
        """Add every scan with a stamp before the tick to its robot's evidence, and take the graph of the tick.

        Scans are read and integrated in one thread per robot. A robot that the schedule has off has no scans.
        """
        elapsed, before = number * self._period_ns / 1e9, (number - 1) * self._period_ns / 1e9
        schedule, start_ns = self._network.schedule, stamp_ns - number * self._period_ns
        for index in schedule.forgets(before, elapsed).nonzero()[0].tolist():
            self.team.restart(index)
            self._measurer.forget()
        self._advance_bodies(stamp_ns)

        def integrate(index: int) -> None:
            def is_on(frame: Scan) -> bool:
                is_kept = schedule.keeps(index, (frame.stamp_ns - start_ns) / 1e9, elapsed)
                self.num_frames_off[index][frame.sensor_index] += not is_kept
                return is_kept

            frames = filter(is_on, self._timeline.frames_before(index, stamp_ns))
            scans = (self._with_bodies(index, frame) for frame in frames)
            self.team.robots[index].integrate(scans, self._of_thread.caster, number)

        self._each(integrate, range(len(self.team.robots)))
        leaves = self.config.network.after_end == "leave"
        active = self._timeline.active(stamp_ns - self._period_ns if leaves else None)
        in_one_frame = None if self.joining is None else self.joining.frames.in_one_frame
        self._graph = self._network.at(elapsed, active, self.team.positions(), in_one_frame)

    def _advance_bodies(self, stamp_ns: int) -> None:
        """Read the boxes of the robots' bodies up to the stamp of a tick."""
        if self._bodies is not None:
            self._bodies.advance(stamp_ns - self._period_ns, stamp_ns)

    def _with_bodies(self, index: int, frame: Scan) -> Scan:
        """A robot's frame with the boxes of the other robots."""
        if self._bodies is None or isinstance(frame, CastFrame):
            return frame
        return self._bodies.add_to(index, frame)

    def _publish(self, graph: CommunicationGraph, number: int, stamp_ns: int) -> tuple[Publication | None, ...]:
        """Publication of each robot that is active and due in this tick; its packets are handed to the links."""
        self._links.cut(self._network.radio_links)
        robots = self.team.robots
        publishes = self.config.consensus.traits.exchanges is not Exchanged.NOTHING
        due = [index for index in graph.active if publishes and robots[index].is_due(number)]
        with_unpruned = falls_due(number * self._period_ns, self._period_ns, self.config.output.state_every)

        def publish(index: int) -> Publication:
            return robots[index].publication(graph.receivers(index), number, with_unpruned=with_unpruned)

        self._each(lambda index: robots[index].advance_map(number), due)
        published = dict(zip(due, self._each(publish, due), strict=True))
        self._add_own_evidence(published, graph, number)
        for sender, publication in sorted(published.items()):
            for receivers, message in publication.messages:
                for receiver in receivers:
                    self._links.send(sender, receiver, message, stamp_ns)
        return tuple(published.get(index) for index in range(len(robots)))

    def _add_own_evidence(self, published: dict[int, Publication], graph: CommunicationGraph, number: int) -> None:
        """Add the messages to robots in other frames to the publications of a tick."""
        if self.joining is None:
            return
        outbox, robots = self.joining.outbox, self.team.robots
        receivers = {index: [b for a, b in self._network.radio_links if a == index] for index in graph.active}
        messages = self._each(lambda index: outbox(robots[index], receivers[index], number), graph.active)
        for index, own_evidence in zip(graph.active, messages, strict=True):
            if own_evidence:
                others = published.get(index, Publication((), None))
                published[index] = dataclasses.replace(others, own_evidence=own_evidence)

    def _deliver(self, graph: CommunicationGraph, stamp_ns: int) -> dict[Link, Receipt]:
        """Deliver the packets that are due and send the acknowledgements; receipts by (sender, receiver)."""
        receipts: dict[Link, Receipt] = {}
        radio_links = set(self._network.radio_links)
        # Acknowledgements without latency arrive in the same tick, so the links are asked until nothing is due.
        while deliveries := self._links.deliver(stamp_ns, graph.active):
            for delivery in deliveries:
                sender, receiver, content = delivery.sender, delivery.receiver, delivery.content
                end = self._end(sender, receiver)
                if isinstance(content, Acknowledgement):
                    end.acknowledged(sender, content)
                    continue
                receipt, answer = end.receive(sender, content)
                if (sender, receiver) in receipts:
                    receipts[sender, receiver].add(receipt)
                else:
                    receipts[sender, receiver] = receipt
                if answer is not None and (receiver, sender) in radio_links:
                    self._links.send(receiver, sender, answer, stamp_ns)
        return receipts

    def _end(self, sender: int, receiver: int) -> Robot | Exchange:
        """The receiving end of a link: the robot, or what it holds of robots in other frames."""
        if self.joining is not None and sender not in self.joining.frames.members(receiver):
            return self.joining.exchange(receiver)
        return self.team.robots[receiver]

    def _iterate(self, graph: CommunicationGraph, phase: Phase, number: int) -> float:
        """Iterate at every active robot with the maps that arrived; the largest change of a log-odds."""
        step_weights = step_weights_of(graph, self.config.consensus)
        robots = self.team.robots
        turns = [Turn(robots[index], robots[index].take_arrivals(), step_weights[index]) for index in graph.active]
        return max(self.team.iterate(turns, phase, number, self._threads), default=0.0)

    # --- helpers ------------------------------------------------------------------------------------------------------

    def _stamp_of(self, number: int) -> int:
        """Stamp of a tick."""
        assert self._start_ns is not None
        return self._start_ns + number * self._period_ns

    def _has_scans(self) -> bool:
        """True before the first tick, while scans are left, and while robots may still find each other's frames."""
        if not self._timeline.exhausted or self._num_ticks == 0:
            return True
        return self.joining is not None and self._reopen is not None and self.joining.is_open(self._num_ticks)

    def _check_next_frame(self, start_ns: int) -> None:
        """Raise InputError where the next frame is more ticks away than a run may have."""
        next_ns = self._timeline.next_stamp_ns
        if next_ns is not None and (next_ns - start_ns) // self._period_ns >= MAX_TICKS:
            raise InputError(
                f"the frames from {start_ns / 1e9:.3f} s to {next_ns / 1e9:.3f} s span more than {MAX_TICKS:,} ticks "
                f"of {self.config.network.publish_period:g} s; check the stamps, or give clock: log"
            )

    def _each(self, action: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
        """Results of an action on every item, run in parallel threads, in the items' order."""
        return list(self._threads.map(action, items))
