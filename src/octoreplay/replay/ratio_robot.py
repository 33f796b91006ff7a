"""The robots that share out their evidence in running sums: rule ratio (mapping/running_sums.py has the source)."""

from __future__ import annotations

from collections.abc import Sequence

from octoreplay.config import RunConfig
from octoreplay.mapping import running_sums
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import Float64Array
from octoreplay.replay.exchange import HeldMap, MapMessage, PacketEncoder, Source
from octoreplay.replay.robot import Arrival, Robot


class RatioRobot(Robot):
    """A robot that keeps a mass y_i and a weight z_i, and gives equal shares of both to its receivers; h_i = y_i / z_i.

    Receivers get the running sum of all shares so far. While a link is down it is given nothing: its receiver's sum
    stands still, and goes on from there when the link is back.
    """

    def __init__(self, index: int, config: RunConfig, num_classes: int, encoder: PacketEncoder, epoch: int = 0) -> None:
        super().__init__(index, config, num_classes, encoder, epoch)
        self._mass = SemanticOctree(config.map.resolution, num_classes)
        self._weight = running_sums.WHOLE_WEIGHT
        self._total = SemanticOctree(config.map.resolution, num_classes)
        self._total_weight = 0
        # What a receiver's sum is short of the total; where its link is down, the sum itself.
        self._offsets: dict[int, HeldMap] = {}
        self._paused: dict[int, HeldMap] = {}
        self._receivers: frozenset[int] = frozenset()
        self._taken: dict[Source, HeldMap] = {}

    def publish(self, receivers: Sequence[int], tick: int) -> list[tuple[tuple[int, ...], MapMessage]]:
        """Share out the mass, and send the running sums."""
        self._pause(self._receivers.difference(receivers), tick)
        self._resume(frozenset(receivers).difference(self._receivers), tick)
        self._receivers = frozenset(receivers)
        running_sums.share_out(self._mass, self._total, len(receivers), tick - 1)
        share, self._weight = running_sums.share_weight(self._weight, len(receivers))
        self._total_weight += share if receivers else 0
        held = self.exchange.held
        outgoing = []
        together = tuple(receiver for receiver in receivers if receiver not in self._offsets)
        for group in filter(None, (together, *((receiver,) for receiver in receivers if receiver in self._offsets))):
            held[self.source] = self._sum_for(group[0], tick)
            outgoing += self.exchange.outbox(group, [self.source], keep_alive=True)
        return outgoing

    def iterate(self, arrived: Sequence[Arrival], step_weights: Float64Array, factor: float, tick: int) -> float:
        """Take in what the senders' sums grew by and the robot's own new evidence; the largest change of a log-odds."""
        del step_weights, factor
        self._update_log_likelihood(tick)
        arrivals = []
        for source, new in sorted(dict(arrived).items()):
            old = self._taken.get(source)
            self._taken[source] = new
            if old is None and self.source.epoch > 0:
                # The shares that were sent to an earlier life are lost with it.
                continue
            self._weight += new.weight - (old.weight if old else 0)
            arrivals.append((new.octree, old.octree if old else None))
        running_sums.take_in(self._mass, arrivals, tick)
        running_sums.add_evidence(
            self._mass, self._log_likelihood, self._last_log_likelihood, self._likelihood_tick + 1, tick
        )
        self._keep_log_likelihood(tick)
        self.num_iterations += 1
        change = running_sums.recovered(self._mass, self._weight, self.map, tick)
        self._prune()
        return change

    def _sum_for(self, receiver: int, tick: int) -> HeldMap:
        """The running sum of what one receiver was given."""
        offset = self._offsets.get(receiver)
        if offset is None:
            return HeldMap(self._total.copy(), tick, self._total_weight)
        octree = running_sums.difference(self._total, offset.octree)
        return HeldMap(octree, tick, self._total_weight - offset.weight)

    def _pause(self, receivers: frozenset[int], tick: int) -> None:
        """Links went down: their receivers are given nothing from here on."""
        for receiver in receivers:
            self._paused[receiver] = self._sum_for(receiver, tick)
            self._offsets.pop(receiver, None)

    def _resume(self, receivers: frozenset[int], tick: int) -> None:
        """Links came up, for the first time or again: what was summed up meanwhile is not for their receivers."""
        for receiver in receivers:
            paused = self._paused.pop(receiver, None)
            if paused is None and self._total_weight:
                self._offsets[receiver] = HeldMap(self._total.copy(), tick, self._total_weight)
            elif paused is not None and paused.weight != self._total_weight:
                octree = running_sums.difference(self._total, paused.octree)
                self._offsets[receiver] = HeldMap(octree, tick, self._total_weight - paused.weight)

    def _octrees(self) -> list[SemanticOctree]:
        kept = [*self._offsets.values(), *self._paused.values(), *self._taken.values()]
        return [*super()._octrees(), self._mass, self._total, *(held.octree for held in kept)]
