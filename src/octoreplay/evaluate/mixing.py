"""Convergence rate of mixing on a fixed graph with Metropolis weights, in theory.

One synchronous step of mixing is h <- (I - 2 epsilon L) h (docs/algorithm.md). On a connected graph the distance from
the mean shrinks in the long run by lambda_2 = max |1 - 2 epsilon mu| a step, over the eigenvalues mu > 0 of L, and Phi,
which is quadratic, by lambda_2^2 (Xiao and Boyd, Fast linear iterations for distributed averaging, 2004).
"""

from __future__ import annotations

import functools

import numpy as np

from octoreplay.config.consensus import ConsensusConfig
from octoreplay.config.network import NetworkConfig
from octoreplay.replay.network.graph import CommunicationGraph, TeamNetwork


def epsilon_bound(topology: str, num_robots: int) -> float:
    """Step size below which mixing converges on a ``complete``, ``ring``, ``line`` or ``star`` graph."""
    return _graph(topology, num_robots).epsilon_bound


def contraction(topology: str, num_robots: int, epsilon: float) -> float:
    """Factor by which Phi shrinks in a step, in the long run."""
    return _graph(topology, num_robots).lambda_2(epsilon) ** 2


@functools.cache
def _graph(topology: str, num_robots: int) -> CommunicationGraph:
    """Graph of a whole team."""
    names = [f"robot_{index}" for index in range(num_robots)]
    network = TeamNetwork(NetworkConfig(topology=topology, weights="metropolis"), ConsensusConfig(), names)
    return network.at(0.0, [True] * num_robots, np.full((num_robots, 3), np.nan))
