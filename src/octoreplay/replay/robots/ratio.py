"""Rule ratio: robots that exchange running sums (source: mapping/running_sums.py)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor

from octoreplay.config.resolved import ResolvedRun
from octoreplay.errors import ConfigError
from octoreplay.mapping import running_sums
from octoreplay.mapping.consensus import Step, Update, team_step
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.replay.exchange.messages import HeldMap, MapMessage, Source
from octoreplay.replay.exchange.packet_codec import PacketCodec
from octoreplay.replay.robots.robot import Arrival, Phase, Robot, Team, Turn

REST = 8.0
"""Change of a map below which it rests [units]: rounding keeps moving masses by up to six units a tick."""

_HEADROOM = 4
"""Factor by which a mass may exceed the largest log-odds times the number of robots."""


class RatioRobot(Robot):
    """Robot with a mass y_i and a weight z_i, of which it gives equal shares to its receivers; h_i = y_i / z_i.

    A receiver gets the running sum of all its shares so far. The sum is paused while the link is down.
    """

    def __init__(self, index: int, config: ResolvedRun, packet_codec: PacketCodec, epoch: int = 0) -> None:
        super().__init__(index, config, packet_codec, epoch)
        self.mass = SemanticOctree(config.map.resolution, config.classes.num_classes)
        self._weight = running_sums.WHOLE_WEIGHT
        self._total = SemanticOctree(config.map.resolution, config.classes.num_classes)
        self._total_weight = 0
        # Difference between the total and a receiver's sum; for a link that is down, the sum itself.
        self._offsets: dict[int, HeldMap] = {}
        self._paused: dict[int, HeldMap] = {}
        self._receivers: frozenset[int] = frozenset()
        self._taken: dict[Source, HeldMap] = {}

    def advance_map(self, tick: int) -> None:
        """The running sums depend on the receivers, so ``publish`` advances them."""

    def publish(self, receivers: Sequence[int], tick: int) -> list[tuple[tuple[int, ...], MapMessage]]:
        """Share the mass among the receivers, and send the running sums."""
        self._pause(self._receivers.difference(receivers), tick)
        self._resume(frozenset(receivers).difference(self._receivers), tick)
        self._receivers = frozenset(receivers)
        # A robot with little weight keeps it: a weight near 0 cannot be divided by.
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
        """Newest sums that arrived, each with the one used before; adds their weights to the robot's weight."""
        growths: list[running_sums.Arrival] = []
        for source, new in sorted(dict(arrived).items()):
            old = self._taken.get(source)
            self._taken[source] = new
            if old is None and self.has_lost_messages:
                # Shares that were sent to an earlier restart epoch are lost with it.
                continue
            self._weight += new.weight - (old.weight if old else 0)
            growths.append((new.octree, old.octree if old else None))
        return growths

    def end_iteration(self, tick: int) -> float:
        """Add new evidence to the mass and compute the map; the largest change of a log-odds."""
        self._update_log_likelihood(tick)
        running_sums.add_evidence(
            self.mass, self._log_likelihood, self._last_evidence.saved, self._likelihood_tick + 1, tick
        )
        if self._weight >= running_sums.LEAST_WEIGHT:
            change = running_sums.recover_map(self.mass, self._weight, self.map, tick, REST * running_sums.UNIT)
        else:
            # Most of the mass is in transit and the rest is too coarse: new evidence is added to the last map instead.
            step = Step(self.map, (), (), self._log_likelihood, 0.0, None, self._last_evidence.saved)
            (change,) = team_step([step], update=Update.ADD, revision=tick)
        self._keep_log_likelihood(tick)
        self.num_iterations += 1
        self._measure_map(tick)
        return change

    def _sum_for(self, receiver: int, tick: int) -> HeldMap:
        """Running sum of one receiver's shares."""
        offset = self._offsets.get(receiver)
        if offset is None:
            return HeldMap(self._total.copy(), tick, self._total_weight)
        octree = running_sums.difference(self._total, offset.octree)
        return HeldMap(octree, tick, self._total_weight - offset.weight)

    def _pause(self, receivers: frozenset[int], tick: int) -> None:
        """Pause the sums of receivers whose links went down."""
        for receiver in receivers:
            self._paused[receiver] = self._sum_for(receiver, tick)
            self._offsets.pop(receiver, None)

    def _resume(self, receivers: frozenset[int], tick: int) -> None:
        """Start or resume the sums of receivers whose links came up; shares in between are not theirs."""
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

    def __init__(self, config: ResolvedRun, packet_codec: PacketCodec) -> None:
        _check_range(config)
        super().__init__(config, packet_codec)

    def _new_robot(self, index: int, epoch: int) -> RatioRobot:
        return RatioRobot(index, self._config, self._packet_codec, epoch)

    def iterate(self, turns: Sequence[Turn[RatioRobot]], phase: Phase, tick: int, threads: Executor) -> list[float]:
        """Add the growth of the received sums and the new evidence to each robot's mass; the rule has no gamma."""
        del phase
        masses = [(turn.robot.mass, turn.robot.growths(turn.arrived)) for turn in turns]
        running_sums.receive_team(masses, tick, threads)
        return list(threads.map(lambda turn: turn.robot.end_iteration(tick), turns))


def _check_range(config: ResolvedRun) -> None:
    """Raise ConfigError where masses could exceed the range of the sums."""
    sensor = config.effective_sensor
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
