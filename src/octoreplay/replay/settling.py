"""How long a team may take to settle: more ticks where packets are lost or late."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from octoreplay.config.network import LinkConfig
from octoreplay.config.run import RunConfig
from octoreplay.replay.network.graph import STEP_SIZE_RULES, CommunicationGraph, settle_ticks_max, step_size

QUIET_PROB = 1e-3
"""A link may be silent by chance for as long as settling has to be quiet with this probability."""

BUDGET_TICKS = 100
"""Ticks that a change may wait for the budget while a team settles."""

FLOOD_TICKS = 10_000
"""Most ticks that settling waits for evidence that a budget holds back."""


def num_quiet_ticks(graph: CommunicationGraph, config: RunConfig, transmission: float = 0.0) -> int:
    """Ticks without any change after which a team has settled: 1 unless packets are lost or late.

    So many that a link on which every packet was lost in all of them is one in a thousand. ``transmission`` is the
    longest time that a packet keeps a link busy [s].
    """
    links = [link for link in _link_configs(graph, config).values() if link.mean_loss < 1.0]
    num_losses = max((_num_losses(link.repeated_loss) for link in links), default=1)
    slower = _repeats(config, links) * _sources_in_turn(config) * _slowest(config)
    # A packet that found a link busy waits for one transmission, and takes another.
    return num_losses * slower + _delay(links, config, 2.0 * transmission)


def num_settle_ticks(graph: CommunicationGraph, config: RunConfig, transmission: float = 0.0) -> int:
    """The most settling ticks: those of the graph with each weight times its link's share of packets that arrive."""
    consensus = config.consensus
    if consensus.rule not in STEP_SIZE_RULES:
        consensus = dataclasses.replace(consensus, epsilon=None)
    epsilon = step_size(graph, consensus)
    links = _link_configs(graph, config)
    weights = graph.weights.copy()
    for (sender, receiver), link in links.items():
        weights[receiver, sender] *= 1.0 - link.mean_loss
    most = settle_ticks_max(dataclasses.replace(graph, weights=weights), consensus, epsilon)
    if consensus.settle == 0 or consensus.settle_max is not None:
        return most
    ramp, has_budget = consensus.settle, config.packet.budget is not None
    all_links = list(links.values())
    slower = _repeats(config, all_links) * _slowest(config) * (1 + _delay(all_links, config, 2.0 * transmission))
    if has_budget and consensus.rule == "flood":
        # How long what waits takes is not known; it ends, since nothing new comes.
        return max(most, FLOOD_TICKS)
    slower *= BUDGET_TICKS if has_budget else 1
    return ramp + (most - ramp) * slower + num_quiet_ticks(graph, config, transmission) - 1


def _link_configs(graph: CommunicationGraph, config: RunConfig) -> dict[tuple[int, int], LinkConfig]:
    """What happens to packets on each directed link."""
    ids = graph.robot_ids
    return {(a, b): config.link_config(ids[a], ids[b]) for a, b in graph.links}


def _num_losses(loss: float) -> int:
    """Losses in a row, each so likely after the one before, that are as rare as QUIET_PROB."""
    return 1 if loss <= 0.0 else max(1, math.ceil(math.log(QUIET_PROB) / math.log(loss)))


def _slowest(config: RunConfig) -> int:
    """Ticks between two maps of the robot that publishes least often."""
    period = config.network.publish_period
    return max(round((robot.publish_period or period) / period) for robot in config.robots)


def _repeats(config: RunConfig, links: Sequence[LinkConfig]) -> int:
    """Packets to a robot until one makes up for a loss: the next, or the next whole map."""
    packet = config.packet
    waits = packet.packets == "delta" and not packet.acknowledge and any(link.mean_loss > 0.0 for link in links)
    return packet.key_frame_every if waits else 1


def _sources_in_turn(config: RunConfig) -> int:
    """Ticks in which every robot's evidence has its turn, where a budget leaves room for some only."""
    takes_turns = config.consensus.rule == "flood" and config.packet.budget is not None
    return len(config.robots) if takes_turns else 1


def _delay(links: Sequence[LinkConfig], config: RunConfig, waiting: float) -> int:
    """The most ticks that a packet comes late, with so many seconds of ``waiting``."""
    delays = np.array([link.latency + link.jitter for link in links])
    return math.ceil((float(delays.max(initial=0.0)) + waiting) / config.network.publish_period)
