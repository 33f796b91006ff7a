"""The robots that forward what everybody saw: rule flood.

Every robot's own evidence travels from neighbour to neighbour in versions, and each robot sums what it has. That is
exact on every connected graph, whatever is lost, repeated or overtaken on the way, and costs N maps in memory and on
the air where the consensus rules take one.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor

import numpy as np

from octoreplay.config.run import RunConfig
from octoreplay.mapping.consensus import Evidence, sum_of_evidence
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.replay.exchange.messages import HeldMap, MapMessage, Source
from octoreplay.replay.exchange.packet_codec import PacketCodec
from octoreplay.replay.exchange.public_map import PublicMap
from octoreplay.replay.robots.robot import Arrival, Robot, Team, Turn


class FloodRobot(Robot):
    """A robot that publishes everybody's evidence as far as it has it; h_i is the sum over the robots divided by N.

    A robot that forgot gets the evidence of its earlier lives back from the others.
    """

    def __init__(
        self, index: int, config: RunConfig, num_classes: int, packet_codec: PacketCodec, epoch: int = 0
    ) -> None:
        super().__init__(index, config, num_classes, packet_codec, epoch)
        self._public = PublicMap(config, packet_codec, self.source)
        self._summed: dict[Source, int] = {}

    def publish(self, receivers: Sequence[int], tick: int) -> list[tuple[tuple[int, ...], MapMessage]]:
        """Of everybody's evidence what the neighbours are not known to have."""
        self._update_log_likelihood(tick)
        held = self.exchange.held
        mine = held.get(self.source)
        evidence = self._log_likelihood
        if self._is_behind(mine):
            # A scan of this tick is in before it is published: what changed after the last version is newer by one.
            new = self._public.advance(evidence, evidence.revisions - 1, tick, num_shares=max(len(held), 1))
            if mine is None or (new.octree.revisions >= mine.version).any():
                self.exchange.hold(self.source, new)
        return self.exchange.outbox(receivers, sorted(held), keep_alive=False)

    def sum_up(self, arrived: Sequence[Arrival], tick: int) -> float:
        """Sum up what is there, where it changed; the largest change of a log-odds."""
        self._update_log_likelihood(tick)
        changed = [self.changed_evidence(tick)]
        for source, held in arrived:
            since = self._summed.get(source, -1)
            changed.append(held.octree.codes[held.octree.revisions >= since])
            self._summed[source] = held.version
        # The robot's own evidence is newer than what it published; equal sums need the same order everywhere.
        octrees = {source: held.octree for source, held in self.exchange.held.items()}
        octrees[self.source] = self._log_likelihood
        share = 1.0 / len(self._config.robots)
        terms = [Evidence(octrees[source], scale=share) for source in sorted(octrees)]
        before = self.map.copy()
        sum_of_evidence(self.map, terms, np.unique(np.concatenate(changed)), tick)
        self.num_iterations += 1
        self._update_streams()
        return self._change_since(before, tick)

    def _is_behind(self, mine: HeldMap | None) -> bool:
        """True when the evidence, or what the budget left of it, is not all published."""
        if mine is None or not self._public.is_exact:
            return True
        return bool((self._log_likelihood.revisions >= mine.version + 1).any())

    def _octrees(self) -> list[SemanticOctree]:
        return [*super()._octrees(), *(held.octree for held in self.exchange.held.values())]


class FloodTeam(Team[FloodRobot]):
    """Robots that forward and sum evidence."""

    def _new_robot(self, index: int, epoch: int) -> FloodRobot:
        return FloodRobot(index, self._config, self._num_classes, self._packet_codec, epoch)

    def iterate(
        self, turns: Sequence[Turn[FloodRobot]], gamma_factor: float, tick: int, threads: Executor
    ) -> list[float]:
        """Sum the evidence that each robot holds; the rule has no gamma."""
        del gamma_factor
        return list(threads.map(lambda turn: turn.robot.sum_up(turn.arrived, tick), turns))
