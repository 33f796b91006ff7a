"""Robots that forward the evidence of all robots, by origin: the exchange of the rules flood and latest.

Neighbours pass on versions of every robot's evidence. It takes N maps in memory and in packets, where the consensus
rules take one.
"""

from __future__ import annotations

from collections.abc import Sequence

from octoreplay.config.resolved import ResolvedRun
from octoreplay.replay.exchange.messages import HeldMap, MapMessage
from octoreplay.replay.exchange.packet_codec import PacketCodec
from octoreplay.replay.exchange.public_map import PublicMap
from octoreplay.replay.robots.robot import Robot


class ForwardingRobot(Robot):
    """Robot that publishes all evidence that it holds.

    After a restart without memory, the robot receives the evidence of its earlier epochs from the others.
    """

    def __init__(self, index: int, config: ResolvedRun, packet_codec: PacketCodec, epoch: int = 0) -> None:
        super().__init__(index, config, packet_codec, epoch)
        self._public = PublicMap(config, packet_codec, self.source)

    def advance_map(self, tick: int) -> None:
        """Advance the published evidence to this tick."""
        self._update_log_likelihood(tick)
        mine = self.exchange.held.get(self.source)
        if not self._is_behind(mine):
            return
        # The scans of a tick precede its publication.
        new = self._public.advance(
            self._log_likelihood, (self._public.version or 0) + 1, tick, num_shares=max(len(self.exchange.held), 1)
        )
        if mine is None or (new.octree.revisions >= mine.version).any():
            self.exchange.hold(self.source, new)

    def publish(self, receivers: Sequence[int], tick: int) -> list[tuple[tuple[int, ...], MapMessage]]:
        """Evidence, by origin, that the neighbours are not known to hold."""
        del tick
        return self.exchange.outbox(receivers, sorted(self.exchange.held), keep_alive=False)

    def _is_behind(self, mine: HeldMap | None) -> bool:
        """True when some of the evidence is not published, because it is new or held back by the budget."""
        if mine is None or not self._public.is_exact:
            return True
        return bool((self._log_likelihood.revisions >= mine.version + 1).any())
