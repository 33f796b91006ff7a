"""A robot of the team with its evidence and its map, and the base class of teams."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from octoreplay.config.resolved import ResolvedRun
from octoreplay.mapping import codec
from octoreplay.mapping.consensus import Evidence, Step, Update, sum_of_evidence, team_step
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import (
    COUNT_SCANS,
    CastFrame,
    ScanCaster,
    add_scan,
    clamped_increments,
    unclamped_increments,
)
from octoreplay.mapping.snapshot import Snapshot
from octoreplay.mapping.stream_size import StreamMeter, StreamPart
from octoreplay.mapping.streams import StreamSize
from octoreplay.records import Float64Array, Int64Array
from octoreplay.replay.exchange.messages import Acknowledgement, HeldMap, MapMessage, Receipt, Source
from octoreplay.replay.exchange.neighbours import Exchange
from octoreplay.replay.exchange.packet_codec import PacketCodec
from octoreplay.replay.timeline import Scan


class Arrival(NamedTuple):
    """State of a robot's map that arrived at another robot."""

    source: Source
    held: HeldMap


RobotT = TypeVar("RobotT", bound="Robot")
RobotT_co = TypeVar("RobotT_co", bound="Robot", covariant=True)


@dataclass(frozen=True)
class Phase:
    """Part of a run that a tick belongs to.

    ``gamma_factor`` scales gamma, and ``extra_flow_bits`` are added to ``flow_bits``, while the team settles.
    """

    gamma_factor: float = 1.0
    extra_flow_bits: int = 0
    is_settling: bool = False


REPLAY = Phase()
"""Phase of the ticks before settling."""


@dataclass(frozen=True, eq=False)
class Turn(Generic[RobotT_co]):
    """A robot's iterations in one tick.

    ``arrived`` are the states that arrived, in order; ``step_weights`` (N,) float64 are the 2 epsilon A_ij of its
    links.
    """

    robot: RobotT_co
    arrived: Sequence[Arrival]
    step_weights: Float64Array


@dataclass(frozen=True)
class MapSizes:
    """Sizes of a published map in other encodings.

    Attributes
    ----------
    stream : StreamSize
        Size of the map's stream.
    num_cells : int
        Known cells.
    unpruned : StreamSize or None
        Size of the stream without pruning; None where it was not measured.
    unpruned_compressed_bytes : int
        Size of the packet without pruning; 0 where it was not measured.
    """

    stream: StreamSize
    num_cells: int
    unpruned: StreamSize | None
    unpruned_compressed_bytes: int


@dataclass(frozen=True, eq=False)
class Publication:
    """Messages of a robot in one tick, each with its receivers, and the sizes of the robot's map.

    ``outbox`` are the messages of the rule, ``own_evidence`` those to robots in other frames. ``sizes`` are None where
    the rule published nothing.
    """

    outbox: Sequence[tuple[tuple[int, ...], MapMessage]]
    sizes: MapSizes | None
    own_evidence: Sequence[tuple[tuple[int, ...], MapMessage]] = ()

    @property
    def messages(self) -> Sequence[tuple[tuple[int, ...], MapMessage]]:
        """All messages."""
        return (*self.outbox, *self.own_evidence)

    @property
    def packet_bytes(self) -> int:
        """Mean number of bytes that the rule sent to a receiver; 0 without receivers."""
        sizes = [message.num_bytes for receivers, message in self.outbox for _ in receivers]
        return round(sum(sizes) / len(sizes)) if sizes else 0


class Robot(ABC):
    """Evidence s_i and map h_i of one robot. Subclasses implement the messages and the iteration of a family of rules.

    ``index`` is the robot's index in ``config.robots``, ``epoch`` its restart epoch. Methods take the number of the
    tick as ``tick``; bricks that change get it as revision. Methods of different robots may run in parallel threads.

    Attributes
    ----------
    source : Source
        Robot and restart epoch of the published map.
    map : SemanticOctree
        h_i - h_0.
    size : StreamSize
        Size of the map's stream, with its leaves merged.
    exchange : Exchange
        Maps that the robot holds, and versions that its neighbours hold.
    T_team_sensor : (4, 4) float64 array or None
        Pose of the sensor at the last scan; None before the first.
    num_scans, num_iterations : int
        Scans and iterations in this restart epoch.
    has_lost_messages : bool
        True where an earlier restart epoch took what others sent.
    """

    def __init__(self, index: int, config: ResolvedRun, packet_codec: PacketCodec, epoch: int = 0) -> None:
        num_classes = config.classes.num_classes
        self.robot_id = config.robots[index].robot_id
        self.index = index
        self.source = Source(index, epoch)
        self.has_lost_messages = epoch > 0
        self.num_scans = 0
        self.num_iterations = 0
        self.T_team_sensor: Float64Array | None = None
        self.exchange = Exchange(config.effective_packet, packet_codec)
        self._config = config
        self._increments = clamped_increments(config.effective_sensor, config.consensus.effective_quantum)
        self._is_average = config.consensus.evidence != "sum"
        if self._is_average:
            self._increments = unclamped_increments(config.effective_sensor)

        def octree(classes: int = num_classes) -> SemanticOctree:
            return SemanticOctree(config.map.resolution, classes)

        self._own_sum = octree()
        self._scan_counts = octree(1) if config.consensus.evidence == "cell-average" else None
        self._log_likelihood = octree() if self._is_average else self._own_sum
        self._scan_tick = -1
        # log q_i as of the last iteration, for the rules that need it.
        consensus = config.consensus
        self._keeps_last = consensus.traits.keeps_last_evidence or consensus.has_anchor
        self._last_evidence = Snapshot(self._log_likelihood)
        self._likelihood_tick = -1
        self._arrived: list[Arrival] = []
        self.map = octree()
        self.size = StreamSize()
        self._meter = StreamMeter(self.map)
        # Sizes of the map without pruning as of a tick: stream, and compressed [bytes].
        self._unpruned_tick: int | None = None
        self._unpruned: tuple[StreamSize | None, int] = (None, 0)

    @property
    def evidence(self) -> Evidence:
        """Evidence that gives log q_i."""
        if self._config.consensus.evidence == "time-average":
            return Evidence(self._own_sum, scale=1.0 / max(self.num_scans, 1))
        return Evidence(self._own_sum, scan_counts=self._scan_counts)

    @property
    def memory_bytes(self) -> int:
        """Bytes of the robot's octrees: evidence, map and the octrees that the rule adds."""
        return sum(o.memory_bytes for o in {id(o): o for o in self._octrees()}.values())

    def _octrees(self) -> list[SemanticOctree]:
        """The robot's octrees, possibly with repetitions."""
        octrees = [self._own_sum, self._log_likelihood, self._last_evidence.saved, self.map]
        return octrees if self._scan_counts is None else [*octrees, self._scan_counts]

    # --- scans --------------------------------------------------------------------------------------------------------

    def integrate(self, frames: Iterable[Scan], caster: ScanCaster, tick: int) -> None:
        """Add the scans of one tick to the evidence."""
        before = self._last_evidence if self._keeps_last and not self._is_average else None
        for frame in frames:
            cells = frame.cells if isinstance(frame, CastFrame) else caster.cast(frame)
            add_scan(self._own_sum, cells, self._increments, tick, before)
            if self._scan_counts is not None:
                add_scan(self._scan_counts, cells, COUNT_SCANS, tick)
            self.num_scans += 1
            self._scan_tick = tick
            self.T_team_sensor = frame.T_team_sensor

    def changed_evidence(self, tick: int) -> Int64Array:
        """Codes (n,) int64 of the bricks whose log q_i changed in this tick.

        With evidence 'time-average' every scan changes all bricks.
        """
        changed = self._own_sum.revisions >= tick
        if self._config.consensus.evidence == "time-average" and self._scan_tick >= tick:
            return self._own_sum.codes.copy()
        return self._own_sum.codes[changed]

    def _update_log_likelihood(self, tick: int) -> None:
        """Update log q_i with the scans of this tick; with evidence 'sum' it is the evidence itself."""
        if self._is_average:
            changed = self.changed_evidence(tick)
            if self._keeps_last:
                self._last_evidence.save(changed)
            sum_of_evidence(self._log_likelihood, [self.evidence], changed, tick)

    def _keep_log_likelihood(self, tick: int) -> None:
        """Note that log q_i is that of the last iteration."""
        self._last_evidence = Snapshot(self._log_likelihood)
        self._likelihood_tick = tick

    # --- exchange -----------------------------------------------------------------------------------------------------

    def is_due(self, tick: int) -> bool:
        """True when the robot publishes in a tick, by its publish_period and publish_phase."""
        return num_due(self._config, self.index, tick - 1, tick) > 0

    def publication(self, receivers: Sequence[int], tick: int, *, with_unpruned: bool) -> Publication:
        """The robot's messages to its receivers in one tick, and the sizes of its map."""
        return Publication(self.publish(receivers, tick), self.map_sizes(tick, with_unpruned=with_unpruned))

    def map_sizes(self, tick: int, *, with_unpruned: bool) -> MapSizes:
        """Sizes of the robot's map. Those without pruning are costly, and not measured unless ``with_unpruned``."""
        measured = self._unpruned_tick
        if with_unpruned and (measured is None or (self.map.revisions >= measured).any()):
            unpruned = self.map.streams(prune=False)
            packed = codec.pack(self.map, unpruned, codec.FULL)
            self._unpruned, self._unpruned_tick = (unpruned.size, len(packed)), tick
        unpruned_size, compressed = self._unpruned if with_unpruned else (None, 0)
        return MapSizes(self.size, self.map.num_cells, unpruned_size, compressed)

    def stream_part(self, tile_cells: int) -> StreamPart:
        """The size of the map's stream as of the last ``size``, for a map in tiles with an edge of ``tile_cells``."""
        return self._meter.part(tile_cells)

    @abstractmethod
    def advance_map(self, tick: int) -> None:
        """Advance the published map to this tick; precedes ``publish``.

        Robots that forward maps read those of others in ``publish``, so all robots' maps are advanced before.
        """

    @abstractmethod
    def publish(self, receivers: Sequence[int], tick: int) -> list[tuple[tuple[int, ...], MapMessage]]:
        """Messages of this tick, each with the indices of its receivers; ``receivers`` are the robot's links."""

    def receive(self, sender: int, message: MapMessage) -> tuple[Receipt, Acknowledgement | None]:
        """Store the maps of a message; its receipt, and the acknowledgement to send (None: none)."""
        receipt, answer = self.exchange.receive(sender, message)
        if receipt.fresh:
            held = self.exchange.held
            self._arrived += [Arrival(source, held[source]) for source in receipt.fresh]
        return receipt, answer

    def acknowledged(self, sender: int, answer: Acknowledgement) -> None:
        """Note the versions that a neighbour holds."""
        self.exchange.acknowledged(sender, answer)

    def take_arrivals(self) -> list[Arrival]:
        """States that arrived since the last call, in the order of arrival."""
        arrived, self._arrived = self._arrived, []
        return arrived

    # --- iterations ---------------------------------------------------------------------------------------------------

    def largest_log_odds(self) -> float:
        """Largest |log-odds| of the map, relative to the prior."""
        return self._change_since(SemanticOctree(self.map.resolution, self.map.num_classes), 0)

    def _change_since(self, before: SemanticOctree, tick: int) -> float:
        """Largest change of a log-odds since the map was ``before``; overwrites ``before``."""
        return team_step([Step(before, (), (), self.map, 0.0, since=tick)], update=Update.COPY, revision=tick)[0]

    def _measure_map(self, tick: int) -> None:
        """Update ``size`` with the map of this tick; bricks that changed in it have its number as revision."""
        tolerance = self._config.map.prune_tolerance
        if tolerance == 0.0:
            self.size = self._meter.update(tick)
        else:
            self.size = self.map.streams(tolerance=tolerance).size


def num_due(config: ResolvedRun, index: int, after: int, tick: int) -> int:
    """Number of publications due after one tick up to another, by a robot's publish_period and publish_phase."""
    robot, period = config.robots[index], config.network.publish_period
    every = round((robot.publish_period or period) / period)
    phase = round(robot.publish_phase / period)
    return (tick - phase) // every - (after - phase) // every


class Team(ABC, Generic[RobotT]):
    """The robots of one family of rules, and their iterations together.

    ``robots`` are in the order of ``config.robots``.
    """

    def __init__(self, config: ResolvedRun, packet_codec: PacketCodec) -> None:
        self._config = config
        self._packet_codec = packet_codec
        self._past_evidence: list[Evidence] = []
        self.robots = [self._new_robot(index, 0) for index in range(len(config.robots))]

    def restart(self, index: int) -> None:
        """Replace a robot by one without memory, in the next restart epoch; ``evidence()`` keeps its old evidence."""
        old = self.robots[index]
        self._past_evidence.append(old.evidence)
        self.robots[index] = self._new_robot(index, old.source.epoch + 1)
        self.robots[index].T_team_sensor = old.T_team_sensor

    def change_frame(self, index: int) -> None:
        """Replace a robot by one without evidence that integrates all its scans again in another frame.

        Its restart epoch is the next one, since its map gets a new history. Nothing that others sent it is lost: robots
        in different frames do not exchange maps.
        """
        self.robots[index] = self._new_robot(index, self.robots[index].source.epoch + 1)
        self.robots[index].has_lost_messages = False

    def evidence(self, members: Sequence[int]) -> list[Evidence]:
        """Evidence of some robots, and that of earlier restart epochs."""
        return [*(self.robots[index].evidence for index in members), *self._past_evidence]

    def positions(self) -> Float64Array:
        """Sensor positions, (N, 3) float64 in metres in the team's frame; NaN before a robot's first scan."""
        positions = np.full((len(self.robots), 3), np.nan)
        for row, robot in zip(positions, self.robots, strict=True):
            if robot.T_team_sensor is not None:
                row[:] = robot.T_team_sensor[:3, 3]
        return positions

    @abstractmethod
    def _new_robot(self, index: int, epoch: int) -> RobotT:
        """A robot without evidence, in a restart epoch."""

    @abstractmethod
    def iterate(self, turns: Sequence[Turn[RobotT]], phase: Phase, tick: int, threads: Executor) -> list[float]:
        """Iterations of one tick at several robots; each robot's largest change of a log-odds.

        The result does not depend on ``threads``.
        """
