"""Rule latest: robots that forward evidence, and keep in each cell that of the robot whose change came last."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor

import numpy as np

from octoreplay.config.resolved import ResolvedRun
from octoreplay.mapping.cell_changes import take_changes
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.snapshot import Snapshot
from octoreplay.records import Int64Array
from octoreplay.replay.exchange.messages import HeldMap, Source
from octoreplay.replay.exchange.packet_codec import PacketCodec
from octoreplay.replay.robots.forwarding import ForwardingRobot
from octoreplay.replay.robots.robot import Arrival, Phase, Team, Turn

_States = tuple[SemanticOctree, SemanticOctree, Int64Array]
"""New and old state of one robot's evidence, and the codes (n,) int64 of the bricks that may differ."""


class LatestRobot(ForwardingRobot):
    """Robot that forwards evidence; in each cell, h_i is the evidence of the robot whose change it took last.

    In a tick it takes the changes of its own evidence and of each state that arrived, ordered by origin and restart
    epoch, so that the last of these wins where several change a cell in the same tick.
    """

    def __init__(self, index: int, config: ResolvedRun, packet_codec: PacketCodec, epoch: int = 0) -> None:
        super().__init__(index, config, packet_codec, epoch)
        self._taken: dict[Source, HeldMap] = {}

    def take(self, arrived: Sequence[Arrival], tick: int) -> float:
        """Take the changes of a tick into the map; the largest change of a log-odds."""
        self._update_log_likelihood(tick)
        saved = self._last_evidence.saved
        states = {self.source: (self._log_likelihood, saved, saved.codes)}
        states.update({source: self._arrived_states(source, held) for source, held in dict(arrived).items()})
        before = Snapshot(self.map)
        before.save(np.unique(np.concatenate([codes for *_, codes in states.values()])))
        for source in sorted(states):
            new, old, codes = states[source]
            take_changes(self.map, new, old, codes, tick)
        self._keep_log_likelihood(tick)
        self.num_iterations += 1
        self._measure_map(tick)
        return self._change_since(before.saved, tick)

    def _arrived_states(self, source: Source, new: HeldMap) -> _States:
        """States of the evidence of another robot, or of an earlier restart epoch."""
        old = self._taken.get(source)
        self._taken[source] = new
        if old is None:
            return new.octree, SemanticOctree(self.map.resolution, self.map.num_classes), new.octree.codes
        return new.octree, old.octree, new.octree.codes[new.octree.revisions >= old.version]


class LatestTeam(Team[LatestRobot]):
    """Robots that forward evidence and overwrite their maps with its changes."""

    def _new_robot(self, index: int, epoch: int) -> LatestRobot:
        return LatestRobot(index, self._config, self._packet_codec, epoch)

    def iterate(self, turns: Sequence[Turn[LatestRobot]], phase: Phase, tick: int, threads: Executor) -> list[float]:
        """Take the changes that arrived at each robot; the rule has no gamma."""
        del phase
        return list(threads.map(lambda turn: turn.robot.take(turn.arrived, tick), turns))
