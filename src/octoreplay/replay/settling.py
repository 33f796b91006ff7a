"""Settling: ticks after the last scan in which gamma ramps to 0 and flows get finer, until no log-odds changes.

Losses, delays and budgets make it take longer; the functions here bound by how much.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np

from octoreplay.config.consensus import ConsensusConfig
from octoreplay.config.fields import MAX_TICKS
from octoreplay.config.network import LinkConfig
from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.rules import Exchanged
from octoreplay.config.run import RunConfig
from octoreplay.records import CONVERGED
from octoreplay.replay.network.graph import CommunicationGraph, step_size
from octoreplay.replay.robots.robot import Phase

SETTLE_MAX = "settle_max reached"
NO_SETTLING = "settling is off"

QUIET_PROB = 1e-3
"""Probability that losses alone keep a link silent for as long as settling has to be without change."""

BUDGET_TICKS = 100
"""Largest number of ticks that a change waits for the budget while a team settles."""

FLOOD_TICKS = 10_000
"""Largest number of ticks that settling waits for evidence that a budget holds back."""


FINER_TICKS = 8
"""Least number of settling ticks that flows add to the default maximum."""

BITS_PER_TICK = 2
"""Growth of ``flow_bits`` in each settling tick."""


class Settling:
    """Settling of one team over its last graph.

    Iterate over ``phases()`` and call ``note()`` after every tick. ``stop_reason`` is set at the end.
    ``longest_transmission`` is the longest time that a packet kept a link busy [s], ``largest`` the largest |log-odds|
    relative to the prior in any map.
    """

    def __init__(
        self, graph: CommunicationGraph, config: ResolvedRun, longest_transmission: float, largest: float
    ) -> None:
        self.stop_reason = SETTLE_MAX
        self._consensus = config.consensus
        self._num_finer = num_finer_ticks(config, largest)
        self._quiet_ticks = num_quiet_ticks(graph, config, longest_transmission)
        self._most = min(num_settle_ticks(graph, config, longest_transmission, self._num_finer), MAX_TICKS)
        self._tolerance = config.consensus.settle_tolerance
        if config.effective_flow_bits:
            # No flow is below the quantum.
            self._tolerance = min(self._tolerance, config.consensus.effective_quantum)
        self._num_quiet = 0
        self._num_ticks = 0

    def phases(self, least_ticks: int = 0) -> Iterator[Phase]:
        """Phase of each settling tick that is left, up to tick ``least_ticks`` at least.

        In tick n the factor of gamma is 1 - n / settle, and 0 after the ramp. Flows have 2 n bits more, until every
        step is the quantum.
        """
        while self._num_ticks < self._most and not (self._num_ticks >= least_ticks and self._has_converged()):
            self._num_ticks += 1
            n = self._num_ticks
            if n <= self._num_finer:
                # Coarse flows rest before the maps agree.
                self._num_quiet = 0
            extra_bits = BITS_PER_TICK * min(n, self._num_finer)
            yield Phase(max(0.0, 1.0 - n / self._consensus.settle), extra_bits, is_settling=True)
        if self._has_converged():
            self.stop_reason = CONVERGED

    def _has_converged(self) -> bool:
        """True where enough ticks in a row changed nothing."""
        return self._num_ticks >= self._num_finer and self._num_quiet >= self._quiet_ticks

    def note(self, max_change: float) -> None:
        """Note the largest change of a log-odds in the last tick."""
        self._num_quiet = self._num_quiet + 1 if max_change < self._tolerance else 0


def num_finer_ticks(config: RunConfig, largest: float) -> int:
    """Number of settling ticks in which flows get finer, until every step is the quantum; 0 without flows.

    It is the least n with floor(log2 ``largest``) - (flow_bits + 2 n) <= log2 quantum. ``largest`` is the largest
    |log-odds| of the maps; flows do not raise it.
    """
    if not config.effective_flow_bits or largest == 0.0:
        return 0
    # frexp gives floor(log2 x) + 1 exactly.
    num_bits = math.frexp(largest)[1] - math.frexp(config.consensus.effective_quantum)[1]
    return max(0, math.ceil((num_bits - config.effective_flow_bits) / BITS_PER_TICK))


def num_quiet_ticks(graph: CommunicationGraph, config: ResolvedRun, transmission: float = 0.0) -> int:
    """Number of ticks without any change after which a team has settled: 1 without losses and delays.

    A link on which every packet was lost in all of these ticks has probability QUIET_PROB. ``transmission`` is the
    longest time that a packet keeps a link busy [s].
    """
    links = [link for link in _link_configs(graph, config).values() if link.mean_loss < 1.0]
    num_losses = max((_num_losses(link.repeated_loss) for link in links), default=1)
    slower = _repeats(config, links) * _sources_in_turn(config) * _slowest_period(config)
    # A packet that finds a link busy waits for one transmission, and takes another.
    return num_losses * slower + _delay(links, config, 2.0 * transmission)


def num_settle_ticks(
    graph: CommunicationGraph, config: ResolvedRun, transmission: float = 0.0, num_finer: int = 0
) -> int:
    """Largest number of settling ticks, with each weight reduced to its link's share of packets that arrive.

    Flows add ``num_finer`` ticks, and at least FINER_TICKS.
    """
    consensus = config.consensus
    if not consensus.traits.has_step_size:
        consensus = dataclasses.replace(consensus, epsilon=None)
    epsilon = step_size(graph, consensus)
    links = _link_configs(graph, config)
    weights = graph.weights.copy()
    for (sender, receiver), link in links.items():
        weights[receiver, sender] *= 1.0 - link.mean_loss
    most = settle_ticks_max(dataclasses.replace(graph, weights=weights), consensus, epsilon)
    if consensus.settle == 0 or consensus.settle_max is not None:
        return most
    ramp, has_budget = consensus.settle, config.effective_packet.budget is not None
    all_links = list(links.values())
    slower = _repeats(config, all_links) * _slowest_period(config)
    slower *= 1 + _delay(all_links, config, 2.0 * transmission)
    if has_budget and consensus.traits.exchanges is Exchanged.EVIDENCE:
        # The time until all waiting evidence is sent is unknown, but finite, since no new evidence comes.
        return max(most, FLOOD_TICKS)
    slower *= BUDGET_TICKS if has_budget else 1
    finer = max(FINER_TICKS, num_finer) if config.effective_flow_bits else 0
    return ramp + (most - ramp) * slower + num_quiet_ticks(graph, config, transmission) - 1 + finer


def settle_ticks_max(graph: CommunicationGraph, consensus: ConsensusConfig, epsilon: float) -> int:
    """Largest number of settling ticks on a graph without losses and delays; 0 without settling.

    It is ``settle_max``, or ``settle`` + 12 / -log10 lambda_2 rounded up: so many ticks after gamma's ramp shrink the
    disagreement by 1e12. Rules that weigh certainty mix maps that agree with half of epsilon.
    """
    if consensus.settle == 0:
        return 0
    if consensus.settle_max is not None:
        return consensus.settle_max
    if consensus.traits.weighs_certainty:
        epsilon *= 0.5
    rate = min(max(graph.lambda_2(epsilon), 1e-12), 1.0 - 1e-9)  # keeps the number of ticks above 0 and finite
    return consensus.settle + math.ceil(12.0 / -math.log10(rate))


def _link_configs(graph: CommunicationGraph, config: ResolvedRun) -> dict[tuple[int, int], LinkConfig]:
    """Link configuration of each directed link."""
    ids = graph.robot_ids
    return {(a, b): config.link_config(ids[a], ids[b]) for a, b in graph.links}


def _num_losses(loss: float) -> int:
    """Number of losses in a row whose probability falls below QUIET_PROB."""
    return 1 if loss <= 0.0 else max(1, math.ceil(math.log(QUIET_PROB) / math.log(loss)))


def _slowest_period(config: ResolvedRun) -> int:
    """Ticks between two maps of the robot with the longest publish period."""
    period = config.network.publish_period
    return max(round((robot.publish_period or period) / period) for robot in config.robots)


def _repeats(config: ResolvedRun, links: Sequence[LinkConfig]) -> int:
    """Number of packets until one makes up for a lost packet: the next one, or the next key frame."""
    packet = config.effective_packet
    waits = packet.packets == "delta" and not packet.acknowledge and any(link.mean_loss > 0.0 for link in links)
    return packet.key_frame_every if waits else 1


def _sources_in_turn(config: ResolvedRun) -> int:
    """Number of ticks in which each robot's evidence is first in a budget once; 1 where evidence does not share one."""
    takes_turns = config.consensus.traits.exchanges is Exchanged.EVIDENCE and config.effective_packet.budget is not None
    return len(config.robots) if takes_turns else 1


def _delay(links: Sequence[LinkConfig], config: ResolvedRun, waiting: float) -> int:
    """Largest delay of a packet in ticks, with ``waiting`` seconds in queues."""
    delays = np.array([link.latency + link.jitter for link in links])
    return math.ceil((float(delays.max(initial=0.0)) + waiting) / config.network.publish_period)
