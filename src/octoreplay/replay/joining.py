"""Robots that begin a run in their own frames and find each other's frames from the evidence that they receive.

A robot sends its own evidence s_i, in its own frame, to robots in other frames; these keep the newest one and mix
nothing. A pair of robots is aligned (``registration.align_pair``) when received evidence is new and has grown. Where
the pose is accepted, the two components of robots get one frame in the next tick.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from octoreplay.config.resolved import ResolvedRun
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import TEAM
from octoreplay.registration.own_map import OwnMap
from octoreplay.registration.pairs import AcceptLimits, PairAlignment, align_pair
from octoreplay.registration.team import worst_contradiction
from octoreplay.replay.exchange.messages import MapMessage
from octoreplay.replay.exchange.neighbours import Exchange
from octoreplay.replay.exchange.packet_codec import PacketCodec
from octoreplay.replay.exchange.public_map import PublicMap
from octoreplay.replay.frames import TeamFrames
from octoreplay.replay.own_maps import own_map_of
from octoreplay.replay.robots.robot import Robot
from octoreplay.run_metrics import Join
from octoreplay.transforms import inverse


@dataclass(frozen=True, eq=False)
class _Attempt:
    """Alignment of two robots, first < second, by one of them: its own evidence, and what it received of the other."""

    first: int
    second: int
    evidence: tuple[SemanticOctree, SemanticOctree]
    aligner: int


class Joining:
    """Exchange of evidence between robots in different frames, and the joins that follow from it.

    Attributes
    ----------
    frames : TeamFrames
        Frames of the robots in the present tick.
    joins : list of Join
        Joins so far, in order.
    """

    def __init__(self, config: ResolvedRun, packet_codec: PacketCodec, threads: Executor) -> None:
        num_robots = len(config.robots)
        self.frames = TeamFrames(config)
        self.joins: list[Join] = []
        self._config = config
        self._packet_codec = packet_codec
        self._threads = threads
        self._limits = AcceptLimits()
        self._exchanges = [Exchange(config.effective_packet, packet_codec) for _ in range(num_robots)]
        self._public: dict[int, PublicMap] = {}
        self._found: list[PairAlignment] = []
        # Version of the received evidence and cells of both maps at the last attempt of a pair.
        self._tried: dict[tuple[int, int], tuple[int, int, int]] = {}
        self._every = max(1, round(config.alignment.align_every / config.network.publish_period))
        self._last_chance: int | None = None

    # --- exchange of evidence -----------------------------------------------------------------------------------------

    def exchange(self, robot: int) -> Exchange:
        """Return the evidence that a robot holds of robots in other frames."""
        return self._exchanges[robot]

    def outbox(self, robot: Robot, receivers: Sequence[int], tick: int) -> list[tuple[tuple[int, ...], MapMessage]]:
        """Messages of a tick with a robot's evidence to those of its ``receivers`` that are in other frames."""
        members = self.frames.members(robot.index)
        strangers = [receiver for receiver in receivers if receiver not in members]
        if tick % self._every != 0 or not strangers:
            return []
        public = self._public.get(robot.index)
        if public is None:
            public = self._public[robot.index] = PublicMap(self._config, self._packet_codec, robot.source)
        evidence, exchange = robot.evidence.octree, self._exchanges[robot.index]
        # The scans of a tick precede its publication.
        exchange.hold(robot.source, public.advance(evidence, (public.version or 0) + 1, tick))
        return exchange.outbox(strangers, [robot.source], keep_alive=False)

    # --- search and joins ---------------------------------------------------------------------------------------------

    def search(self, robots: Sequence[Robot], *, is_last: bool) -> None:
        """Align the pairs of robots in different frames whose evidence arrived and grew since the last attempt.

        Accepted poses take effect at the next ``join``. ``is_last``: the logs have ended, and any growth counts.
        """
        pairs = itertools.combinations(range(len(robots)), 2)
        attempts = [attempt for pair in pairs if (attempt := self._attempt(robots, *pair, is_last=is_last))]
        maps = self._maps([octree for attempt in attempts for octree in attempt.evidence])
        aligned = self._threads.map(lambda attempt: self._align(robots, attempt, maps), attempts)
        accepted = [pair for pair in aligned if pair.is_accepted]
        self._found = sorted(accepted, key=lambda pair: -pair.verification.score)

    def join(self, tick: int, seconds: float) -> tuple[int, ...]:
        """Join the components between which poses were found; return the robots whose frames changed, in order."""
        ids = [robot.robot_id for robot in self._config.robots]
        # Frame of each robot when the poses were found, and the transforms of these frames to the present ones.
        frame_then = [self.frames.frame_id(index) for index in range(len(ids))]
        T_now_then = {frame_id: np.eye(4) for frame_id in frame_then}
        moved: set[int] = set()
        found, self._found = self._found, []
        for pair in found:
            stays, moves = pair.first, pair.second
            if moves in self.frames.members(stays):
                continue
            T = T_now_then[frame_then[stays]] @ pair.T_first_second @ inverse(T_now_then[frame_then[moves]])
            changed = self.frames.join(stays, moves, T)
            if stays in changed:
                stays, moves, T = moves, stays, inverse(T)
            for frame_id in {frame_then[index] for index in changed}:
                T_now_then[frame_id] = T @ T_now_then[frame_id]
            moved.update(changed)
            names, frame_id = tuple(ids[index] for index in changed), self.frames.frame_id(stays)
            self.joins.append(Join(tick, seconds, ids[stays], ids[moves], names, frame_id, pair.verification.score))
        for index in moved:
            # The evidence in the new frame has a history of its own.
            self._public.pop(index, None)
        return tuple(sorted(moved))

    def origins(self) -> dict[str, str]:
        """Return a phrase on the origin of each robot's frame, by robot_id."""
        places = {place.robot_id: place.frame_id for place in self.frames.places}
        phrases = {
            robot_id: f"frame '{frame_id}'" + (" (given in the team file)" if frame_id == TEAM else "")
            for robot_id, frame_id in places.items()
        }
        for join in self.joins:
            for robot_id in join.moved:
                phrases[robot_id] = (
                    f"frame '{places[robot_id]}' from {join.seconds:g} s on: {join.second} aligned with {join.first}, L"
                    f" {join.score:.0f}"
                )
        return phrases

    def is_open(self, tick: int) -> bool:
        """True after the last scan until the last evidence was sent, has arrived and was tried."""
        if len(self.frames.components) == 1:
            return False
        if self._last_chance is None:
            self._last_chance = tick + self._every + self._longest_delay()
        return bool(self._found) or tick < self._last_chance

    # --- helpers ------------------------------------------------------------------------------------------------------

    def _attempt(self, robots: Sequence[Robot], first: int, second: int, *, is_last: bool) -> _Attempt | None:
        """The alignment of a pair that is due, by the first robot that holds evidence in the other one's frame."""
        if second in self.frames.members(first):
            return None
        own = [robots[index].evidence.octree for index in (first, second)]
        for aligner, other in ((first, second), (second, first)):
            held = self._exchanges[aligner].held.get(robots[other].source)
            if held is None:
                continue
            evidence = (own[0], held.octree) if aligner == first else (held.octree, own[1])
            sizes = evidence[0].num_cells, evidence[1].num_cells
            version, *tried = self._tried.get((first, second), (-1, 0, 0))
            growth = 0.0 if is_last else self._config.alignment.align_growth
            has_grown = any(size > (1.0 + growth) * last for size, last in zip(sizes, tried, strict=True))
            if not has_grown or (held.version == version and not is_last):
                return None
            self._tried[first, second] = (held.version, *sizes)
            return _Attempt(first, second, evidence, aligner)
        return None

    def _maps(self, octrees: Sequence[SemanticOctree]) -> dict[int, OwnMap]:
        """Maps for registration of some octrees, by the octree's identity."""
        unique = {id(octree): octree for octree in octrees}
        maps = self._threads.map(lambda octree: own_map_of(self._config, octree), unique.values())
        return dict(zip(unique, maps, strict=True))

    def _align(self, robots: Sequence[Robot], attempt: _Attempt, maps: Mapping[int, OwnMap]) -> PairAlignment:
        """The alignment of an attempt; refused where the aligner holds evidence that contradicts it."""
        pair = align_pair([maps[id(octree)] for octree in attempt.evidence], 0, 1, limits=self._limits)
        pair = dataclasses.replace(pair, first=attempt.first, second=attempt.second)
        if pair.is_accepted and self._is_contradicted(robots, attempt.aligner, pair):
            return dataclasses.replace(pair, refusal="contradicts the evidence of another robot")
        return pair

    def _is_contradicted(self, robots: Sequence[Robot], aligner: int, pair: PairAlignment) -> bool:
        """True where other evidence in the found frame that the aligner holds contradicts its own clearly."""
        other, T = pair.second, pair.T_first_second
        if aligner == pair.second:
            other, T = pair.first, inverse(T)
        held = self._exchanges[aligner].held
        heard = [held.get(robots[index].source) for index in self.frames.members(other)]
        octrees = [robots[aligner].evidence.octree, *(entry.octree for entry in heard if entry is not None)]
        maps = [own_map_of(self._config, octree) for octree in octrees]
        poses = [np.eye(4) for _ in maps]
        return worst_contradiction(maps, poses, [0], range(1, len(maps)), T, self._limits) is not None

    def _longest_delay(self) -> int:
        """Largest delay of a packet in ticks, without waiting times."""
        ids = [robot.robot_id for robot in self._config.robots]
        links = [self._config.link_config(a, b) for a, b in itertools.permutations(ids, 2)]
        longest = max((link.latency + link.jitter for link in links), default=0.0)
        return math.ceil(longest / self._config.network.publish_period)
