"""The robots that share out their evidence in running sums: rule ratio (mapping/running_sums.py has the source)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor

from octoreplay.config.run import RunConfig
from octoreplay.errors import ConfigError
from octoreplay.mapping import running_sums
from octoreplay.mapping.consensus import Step, Update, team_step
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.replay.exchange.messages import HeldMap, MapMessage, Source
from octoreplay.replay.exchange.packet_codec import PacketCodec
from octoreplay.replay.robots.robot import Arrival, Robot, Team, Turn

REST = 8.0
"""Units by which a map may be off: rounding moves masses by up to six in every tick for ever."""

_HEADROOM = 4
"""A mass stays below this many times the largest log-odds times the number of robots."""


class RatioRobot(Robot):
    """A robot that keeps a mass y_i and a weight z_i, and gives equal shares of both to its receivers; h_i = y_i / z_i.

    Receivers get the running sum of all shares so far. While a link is down it is given nothing: its receiver's sum
    stands still, and goes on from there when the link is back.
    """

    def __init__(
        self, index: int, config: RunConfig, num_classes: int, packet_codec: PacketCodec, epoch: int = 0
    ) -> None:
        super().__init__(index, config, num_classes, packet_codec, epoch)
        self.mass = SemanticOctree(config.map.resolution, num_classes)
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
        # Who hears little keeps what it has: giving on and on would leave it nothing to divide by.
        num_shares = len(receivers) if self._weight >= running_sums.LEAST_WEIGHT else 0
        running_sums.share_out(self.mass, self._total, num_shares, tick - 1)
        share, self._weight = running_sums.share_weight(self._weight, num_shares)
        self._total_weight += share
        outgoing = []
        together = tuple(receiver for receiver in receivers if receiver not in self._offsets)
        for group in filter(None, (together, *((receiver,) for receiver in receivers if receiver in self._offsets))):
            self.exchange.hold(self.source, self._sum_for(group[0], tick))
            outgoing += self.exchange.outbox(group, [self.source], keep_alive=True)
        return outgoing

    def growths(self, arrived: Sequence[Arrival]) -> list[running_sums.Arrival]:
        """The newest sums that arrived, each with the one that was there before; their weights are taken in."""
        growths: list[running_sums.Arrival] = []
        for source, new in sorted(dict(arrived).items()):
            old = self._taken.get(source)
            self._taken[source] = new
            if old is None and self.source.epoch > 0:
                # The shares that were sent to an earlier life are lost with it.
                continue
            self._weight += new.weight - (old.weight if old else 0)
            growths.append((new.octree, old.octree if old else None))
        return growths

    def end_iteration(self, tick: int) -> float:
        """Take in new evidence, and recover the map from the mass; the largest change of a log-odds."""
        self._update_log_likelihood(tick)
        running_sums.add_evidence(
            self.mass, self._log_likelihood, self._last_log_likelihood, self._likelihood_tick + 1, tick
        )
        if self._weight >= running_sums.LEAST_WEIGHT:
            change = running_sums.recover_map(self.mass, self._weight, self.map, tick, REST * running_sums.UNIT)
        else:
            # Most of the mass is under way: what is left shows its rounding. New evidence is added to the last map.
            step = Step(self.map, (), (), self._log_likelihood, 0.0, None, self._last_log_likelihood)
            (change,) = team_step([step], update=Update.BAYES, revision=tick)
        self._keep_log_likelihood(tick)
        self.num_iterations += 1
        self._update_streams()
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
        return [*super()._octrees(), self.mass, self._total, *(held.octree for held in kept)]


class RatioTeam(Team[RatioRobot]):
    """Robots that exchange running sums."""

    def __init__(self, config: RunConfig, num_classes: int, packet_codec: PacketCodec) -> None:
        _check_range(config)
        super().__init__(config, num_classes, packet_codec)

    def _new_robot(self, index: int, epoch: int) -> RatioRobot:
        return RatioRobot(index, self._config, self._num_classes, self._packet_codec, epoch)

    def iterate(
        self, turns: Sequence[Turn[RatioRobot]], gamma_factor: float, tick: int, threads: Executor
    ) -> list[float]:
        """Add the growth of the received sums and the new evidence to each robot's mass; the rule has no gamma."""
        del gamma_factor
        masses = [(turn.robot.mass, turn.robot.growths(turn.arrived)) for turn in turns]
        running_sums.receive_team(masses, tick, threads)
        return list(threads.map(lambda turn: turn.robot.end_iteration(tick), turns))


def _check_range(config: RunConfig) -> None:
    """Refuse a team whose masses could become too large for the sums: raises ConfigError."""
    sensor = config.sensor
    numbers = [sensor.clamp_min, sensor.clamp_max]
    if config.consensus.evidence != "sum":
        numbers = [sensor.hit, sensor.miss, sensor.hit_other or 0.0]
    most = running_sums.MAX_MASS * running_sums.UNIT / _HEADROOM / len(config.robots)
    largest = max(abs(number) for number in numbers)
    if largest > most:
        raise ConfigError(
            f"rule: 'ratio' holds log-odds of up to {most:.4g} for {len(config.robots)} robots, and this sensor model"
            f" gives {largest:g}; lower clamp_min and clamp_max, or use rule 'flood'"
        )
