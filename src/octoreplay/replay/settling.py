"""How long a team may take to settle: more ticks where packets are lost or late."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from octoreplay.config import LinkConfig, RunConfig
from octoreplay.replay.graph import STEP_SIZE_RULES, CommunicationGraph, settle_ticks_max, step_size

QUIET_PROB = 1e-3
"""A link may be silent by chance for as long as settling has to be quiet with this probability."""


BUDGET_TICKS = 100
"""Ticks that a change may wait for the budget while a team settles."""


def num_quiet_ticks(graph: CommunicationGraph, config: RunConfig) -> int:
    """Ticks without any change after which a team has settled: 1 unless packets are lost or late.

    So many that a link on which every packet was lost in all of them is one in a thousand.
    """
    links = [link for link in _link_configs(graph, config).values() if link.mean_loss < 1.0]
    num_losses = max((_num_losses(link.repeated_loss) for link in links), default=1)
    return num_losses * _slowest(config) + _delay(links, config)


def num_settle_ticks(graph: CommunicationGraph, config: RunConfig) -> int:
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
    ramp = consensus.settle
    slower = _slowest(config) * (1 + _delay(list(links.values()), config))
    if config.packet.budget is not None:
        slower *= BUDGET_TICKS
    return ramp + (most - ramp) * slower + num_quiet_ticks(graph, config) - 1


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


def _delay(links: list[LinkConfig], config: RunConfig) -> int:
    """The most ticks that a packet comes late by its link's delay."""
    delays = np.array([link.latency + link.jitter for link in links])
    return math.ceil(float(delays.max(initial=0.0)) / config.network.publish_period)
