"""Rules gradient, natural, bayes, merge, weighted and local: robots that mix their neighbours' maps into their own."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from concurrent.futures import Executor

import numpy as np

from octoreplay.config.resolved import ResolvedRun
from octoreplay.mapping.consensus import Flows, Step, Update, gamma_at, team_step
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import ScanCaster
from octoreplay.records import Float64Array
from octoreplay.replay.exchange.messages import HeldMap, MapMessage, Source
from octoreplay.replay.exchange.packet_codec import PacketCodec
from octoreplay.replay.exchange.public_map import PublicMap
from octoreplay.replay.robots.anchor import Anchor
from octoreplay.replay.robots.robot import Arrival, Phase, Robot, Team, Turn
from octoreplay.replay.timeline import Scan


class ConsensusRobot(Robot):
    """Robot that publishes h_i and iterates with the maps h_j of its neighbours."""

    def __init__(self, index: int, config: ResolvedRun, packet_codec: PacketCodec, epoch: int, update: Update) -> None:
        super().__init__(index, config, packet_codec, epoch)
        self._rule = config.consensus.traits
        self._update = update
        self._public = PublicMap(config, packet_codec, self.source)
        self._has_budget = config.effective_packet.budget is not None
        self._used: dict[Source, int] = {}
        self._last_step_tick = -1
        self._last_conditions: tuple[object, ...] = ()
        self._nothing = SemanticOctree(config.map.resolution, config.classes.num_classes)
        self._receivers: frozenset[int] = frozenset()
        self._anchor = Anchor(config)

    def integrate(self, frames: Iterable[Scan], caster: ScanCaster, tick: int) -> None:
        """Add the scans of one tick to the evidence, and to the map for rules that do so before they publish."""
        super().integrate(frames, caster, tick)
        if not self._rule.adds_evidence_first or self._scan_tick < tick:
            return
        self._update_log_likelihood(tick)
        step = Step(self.map, (), (), self._log_likelihood, 0.0, last_evidence=self._last_evidence.saved, since=tick)
        team_step([step], update=Update.ADD, revision=tick)
        self._keep_log_likelihood(tick)
        self._measure_map(tick)

    def advance_map(self, tick: int) -> None:
        """Advance the published map to this tick."""
        # The iteration of a tick follows its publication.
        self.exchange.release(self.source)
        self.exchange.hold(self.source, self._public.advance(self.map, self._public.version or 0, tick))

    def publish(self, receivers: Sequence[int], tick: int) -> list[tuple[tuple[int, ...], MapMessage]]:
        """Messages with the robot's map; without changes an empty delta, which keeps the link alive."""
        del tick
        self._receivers = frozenset(receivers)
        return self.exchange.outbox(receivers, [self.source], keep_alive=True)

    def next_step(self, arrived: Sequence[Arrival], step_weights: Float64Array, phase: Phase, tick: int) -> Step:
        """Step of a tick with the newest of the maps that ``arrived``; ``end_step`` must follow."""
        newest = {arrival.source: arrival for arrival in arrived}
        arrived = [newest[source] for source in sorted(newest)]
        self._begin_step(arrived, tick)
        gamma = phase.gamma_factor * gamma_at(self._config.consensus, self.num_iterations)
        # Differences of published maps keep the sum over the robots in spite of rounding in packets.
        base = None if self._public.is_exact else self._published_octree(tick)
        # A brick rests if the same step with the same values changed nothing in it.
        conditions = (
            gamma, phase.extra_flow_bits, phase.is_settling, self._has_published(tick), self._receivers,
            self._anchor.absent,
            *((source, tick - held.version, step_weights[source.origin]) for source, held in arrived),
        )  # fmt: skip
        is_steady = conditions == self._last_conditions and all(held.version == tick for _, held in arrived)
        since = self._last_step_tick if is_steady and base is None else None
        self._last_conditions, self._last_step_tick = conditions, tick
        return self._step(arrived, step_weights, phase, gamma, base, tick, since)

    def end_step(self, tick: int) -> None:
        """Complete the iteration of ``next_step``."""
        self._finish_step(tick)
        self._end_tick(tick)

    def iterate_on_arrival(
        self, arrived: Sequence[Arrival], step_weights: Float64Array, phase: Phase, tick: int
    ) -> float:
        """Iterate once for each of the maps that ``arrived``, in order; the largest change of a log-odds."""
        consensus = self._config.consensus
        self._begin_step(arrived, tick)
        factor = phase.gamma_factor
        share = factor / len(arrived) if consensus.gamma_per_arrival == "divided" else factor
        before = self.map.copy()
        for arrival in arrived:
            gamma = share * gamma_at(consensus, self.num_iterations)
            # The sum over robots is kept only when both ends of a link exchange the same difference.
            keeps_sum = self._rule.needs_symmetric_links and self._is_mutual(arrival, tick)
            base = self._published_octree(tick) if keeps_sum or not self._public.is_exact else None
            step = self._step([arrival], step_weights, phase, gamma, base, tick)
            team_step(
                [step], update=self._update, revision=tick, clamp=self._config.effective_sensor.clamp,
                quantum=quantum_in(self._config, phase),
            )  # fmt: skip
            self._finish_step(tick)
        self._end_tick(tick)
        # One arrival may undo the change of another, so the change over the whole tick counts.
        return self._change_since(before, tick)

    def _begin_step(self, arrived: Sequence[Arrival], tick: int) -> None:
        """Prepare the evidence for the iterations of a tick."""
        self._update_log_likelihood(tick)
        origins = (source.origin for source, _ in arrived)
        self._anchor.advance(origins, self.map, self._log_likelihood, self._last_evidence.saved, tick)

    def _end_tick(self, tick: int) -> None:
        """Complete the iterations of a tick; an iteration uses only maps that arrived since the last one."""
        self.exchange.forget_contents(self.source)
        self._measure_map(tick)

    def _step(
        self, arrived: Sequence[Arrival], step_weights: Float64Array, phase: Phase, gamma: float,
        base: SemanticOctree | None, tick: int, since: int | None = None,
    ) -> Step:  # fmt: skip
        """Step with the maps that ``arrived``; bricks at rest ``since`` a revision are skipped."""
        neighbours = [held.octree for _, held in arrived]
        if not self._rule.mixes_differences:
            base = self._nothing
        elif base is not None and self._has_budget:
            neighbours = [self._used_once(base, source, held) for source, held in arrived]
        target = self._log_likelihood if self._anchor.target is None else self._anchor.target
        last = self._last_evidence.saved if self._update is Update.MERGE else None
        return Step(
            self.map, neighbours, [float(step_weights[source.origin]) for source, _ in arrived], target, gamma, base,
            last, since, self._flows(arrived, phase, tick),
        )  # fmt: skip

    def _flows(self, arrived: Sequence[Arrival], phase: Phase, tick: int) -> Flows | None:
        """Flows of the mutual links; None for a rule or a run without flows."""
        bits = self._config.effective_flow_bits
        if not bits:
            return None
        gate = 0.0 if phase.is_settling else self._config.consensus.flow_gate
        return Flows(bits + phase.extra_flow_bits, [self._is_mutual(arrival, tick) for arrival in arrived], gate)

    def _is_mutual(self, arrival: Arrival, tick: int) -> bool:
        """True where both ends of a link published to each other in this tick."""
        has_sent = self._has_published(tick) and arrival.source.origin in self._receivers
        return has_sent and arrival.held.version == tick

    def _has_published(self, tick: int) -> bool:
        """True where the robot published in this tick."""
        return self._public.version == tick

    def _published_octree(self, tick: int) -> SemanticOctree | None:
        """The published map of this tick; None where nothing was published or, without budget, an older version."""
        version = self._public.version
        if version is None or (version < tick and not self._has_budget):
            return None
        return self._public.octree

    def _used_once(self, own: SemanticOctree, source: Source, held: HeldMap) -> SemanticOctree:
        """A neighbour's map, with the bricks of ``own`` where neither robot has sent the brick since the last use.

        The difference of a brick that waits for the budget stays for many ticks. Both ends of the link use it once,
        when one of them sends the brick; adding it in every tick would not converge.
        """
        since = self._used.get(source, 0)
        self._used[source] = held.version
        fresh = np.union1d(own.codes[own.revisions >= since], held.octree.codes[held.octree.revisions >= since])
        mixed = SemanticOctree(own.resolution, own.num_classes)
        mixed.overwrite(own, np.flatnonzero(~np.isin(own.codes, fresh)))
        mixed.overwrite(held.octree, np.flatnonzero(np.isin(held.octree.codes, fresh)))
        return mixed

    def _finish_step(self, tick: int) -> None:
        """Count an iteration and store its evidence."""
        self.num_iterations += 1
        if self._keeps_last:
            self._keep_log_likelihood(tick)


class ConsensusTeam(Team[ConsensusRobot]):
    """Robots that mix maps; ``update`` is the branch of the kernel that the rule takes."""

    def __init__(self, config: ResolvedRun, packet_codec: PacketCodec, *, update: Update) -> None:
        self._update = update
        super().__init__(config, packet_codec)

    def _new_robot(self, index: int, epoch: int) -> ConsensusRobot:
        return ConsensusRobot(index, self._config, self._packet_codec, epoch, self._update)

    def iterate(self, turns: Sequence[Turn[ConsensusRobot]], phase: Phase, tick: int, threads: Executor) -> list[float]:
        """One iteration per robot, all robots brick by brick; in mode 'on-arrival' one iteration per arrived map."""
        consensus, clamp = self._config.consensus, self._config.effective_sensor.clamp
        turns = [dataclasses.replace(turn, arrived=self._chosen(turn, tick)) for turn in turns]
        is_sync = consensus.mode == "sync"
        together = [turn for turn in turns if is_sync or not turn.arrived]
        alone = [turn for turn in turns if not is_sync and turn.arrived]
        steps = list(threads.map(lambda t: t.robot.next_step(t.arrived, t.step_weights, phase, tick), together))
        changes = team_step(
            steps,
            update=self._update,
            revision=tick,
            clamp=clamp,
            quantum=quantum_in(self._config, phase),
            threads=threads,
        )
        list(threads.map(lambda turn: turn.robot.end_step(tick), together))
        return changes + list(
            threads.map(lambda t: t.robot.iterate_on_arrival(t.arrived, t.step_weights, phase, tick), alone)
        )

    def _chosen(self, turn: Turn[ConsensusRobot], tick: int) -> list[Arrival]:
        """Arrivals that an iteration uses: those from neighbours, or ``merge_maps`` of their newest ones in turn."""
        arrived, most = _from_neighbours(turn), self._config.consensus.merge_maps
        if most is None or self._config.consensus.traits.mixes_differences:
            return arrived
        newest = {arrival.source: arrival for arrival in arrived}
        sources = sorted(newest)
        first = tick * most
        chosen = {sources[(first + place) % len(sources)] for place in range(min(most, len(sources)))}
        return [newest[source] for source in sources if source in chosen]


def quantum_in(config: ResolvedRun, phase: Phase) -> float:
    """Quantum of the iterations: rules without flows do not round while the team settles."""
    consensus = config.consensus
    return 0.0 if phase.is_settling and not consensus.traits.has_flows else consensus.effective_quantum


def _from_neighbours(turn: Turn[Robot]) -> list[Arrival]:
    """Arrivals over links of this tick's graph, without maps of a sender's earlier restart epochs."""
    epoch_of = turn.robot.exchange.epoch_of
    return [
        arrival
        for arrival in turn.arrived
        if turn.step_weights[arrival.source.origin] > 0 and arrival.source.epoch == epoch_of(arrival.source.origin)
    ]
