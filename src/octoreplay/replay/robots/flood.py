"""Rule flood: robots that forward the evidence of all robots and sum it.

The sum is exact on every connected graph, in spite of lost, repeated and reordered packets.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor

import numpy as np

from octoreplay.config.resolved import ResolvedRun
from octoreplay.mapping.consensus import Evidence, sum_of_evidence
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.snapshot import Snapshot
from octoreplay.replay.exchange.messages import Source
from octoreplay.replay.exchange.packet_codec import PacketCodec
from octoreplay.replay.robots.forwarding import ForwardingRobot
from octoreplay.replay.robots.robot import Arrival, Phase, Team, Turn


class FloodRobot(ForwardingRobot):
    """Robot that forwards evidence; h_i is the sum over the robots divided by N."""

    def __init__(self, index: int, config: ResolvedRun, packet_codec: PacketCodec, epoch: int = 0) -> None:
        super().__init__(index, config, packet_codec, epoch)
        self._summed: dict[Source, int] = {}

    def sum_up(self, arrived: Sequence[Arrival], tick: int) -> float:
        """Update the sum where evidence changed; the largest change of a log-odds."""
        self._update_log_likelihood(tick)
        changed = [self.changed_evidence(tick)]
        for source, held in arrived:
            since = self._summed.get(source, -1)
            changed.append(held.octree.codes[held.octree.revisions >= since])
            self._summed[source] = held.version
        # The robot's evidence is newer than its published version. All robots add in the same order for equal sums.
        octrees = {source: held.octree for source, held in self.exchange.held.items()}
        octrees[self.source] = self._log_likelihood
        share = 1.0 / len(self._config.robots)
        terms = [Evidence(octrees[source], scale=share) for source in sorted(octrees)]
        codes = np.unique(np.concatenate(changed))
        before = Snapshot(self.map)
        before.save(codes)
        sum_of_evidence(self.map, terms, codes, tick)
        self.num_iterations += 1
        self._measure_map(tick)
        return self._change_since(before.saved, tick)

    def _octrees(self) -> list[SemanticOctree]:
        return [*super()._octrees(), *(held.octree for held in self.exchange.held.values())]


class FloodTeam(Team[FloodRobot]):
    """Robots that forward and sum evidence."""

    def _new_robot(self, index: int, epoch: int) -> FloodRobot:
        return FloodRobot(index, self._config, self._packet_codec, epoch)

    def iterate(self, turns: Sequence[Turn[FloodRobot]], phase: Phase, tick: int, threads: Executor) -> list[float]:
        """Sum the evidence that each robot holds; the rule has no gamma."""
        del phase
        return list(threads.map(lambda turn: turn.robot.sum_up(turn.arrived, tick), turns))
