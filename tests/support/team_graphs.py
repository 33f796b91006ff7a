"""Small communication graphs for tests."""

from __future__ import annotations

import numpy as np

from octoreplay.config.consensus import ConsensusConfig
from octoreplay.config.network import NetworkConfig
from octoreplay.replay.network.graph import TeamNetwork, build_graph

NAMES = ("husky_1", "husky_2", "husky_3", "husky_4", "husky_5", "husky_6", "husky_7")


def nowhere(num_robots):
    return np.full((num_robots, 3), np.nan)


def team_of(num_robots, topology="complete", consensus=None, **network):
    config = NetworkConfig(topology=topology, **network)
    return TeamNetwork(config, consensus or ConsensusConfig(), NAMES[:num_robots])


def built(num_robots, topology="complete", active=None, elapsed_s=0.0, **network):
    active = [True] * num_robots if active is None else active
    return team_of(num_robots, topology, **network).at(elapsed_s, active, nowhere(num_robots))


def directed(num_robots, *links, weights="metropolis"):
    """Return the graph of directed links (sender, receiver)."""
    hears = np.zeros((num_robots, num_robots), bool)
    for sender, receiver in links:
        hears[receiver, sender] = True
    return build_graph(NetworkConfig(weights=weights), NAMES[:num_robots], [True] * num_robots, hears)


def edges_of(*pairs, weights=None):
    weights = weights or [None] * len(pairs)
    return tuple((NAMES[i], NAMES[j], weight) for (i, j), weight in zip(pairs, weights, strict=True))


def pairs_of(*pairs):
    return tuple((NAMES[i], NAMES[j]) for i, j in pairs)
