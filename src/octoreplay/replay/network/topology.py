"""Links of a topology, before one-way pairs and the schedule: a fixed pattern, or a function of the positions."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import combinations, pairwise

import numpy as np

from octoreplay.config.network import POSITION_TOPOLOGIES, NetworkConfig
from octoreplay.records import BoolArray, Float64Array


class Topology:
    """Undirected links among a team's robots in each tick.

    A fixed topology is built over the whole team and restricted to the robots that are present: a ring without one
    robot is a line, and a star without its centre, the first robot, has no links. 'nearest' and 'range' are computed
    among the robots that are present and have a position; 'range' keeps its links from call to call for the hysteresis.
    """

    def __init__(self, network: NetworkConfig, robot_ids: Sequence[str]) -> None:
        self._network = network
        self._fixed: BoolArray | None = None
        if network.topology not in POSITION_TOPOLOGIES:
            self._fixed = _adjacency(_fixed_links(network, robot_ids), len(robot_ids))
        self._in_range = np.zeros((len(robot_ids), len(robot_ids)), dtype=bool)

    def links(self, present: BoolArray, positions: Float64Array) -> BoolArray:
        """Links of a tick, (N, N) bool, symmetric, False on the diagonal.

        ``present`` (N,) bool are the robots that take part. ``positions`` (N, 3) float64 are in metres in the team's
        frame, NaN for a robot without a pose; only 'nearest' and 'range' use them.
        """
        if self._fixed is not None:
            return self._fixed & present & present[:, None]
        # NaN positions give NaN distances, for which no comparison holds: these robots have no links.
        distances = _distances(np.where(present[:, None], positions, np.nan))
        if self._network.topology == "nearest":
            return _nearest_links(distances, self._network.num_nearest)
        self._in_range = self._range_links(distances)
        return self._in_range

    def _range_links(self, distances: Float64Array) -> BoolArray:
        """Links appear below radio_range and last up to radio_range + range_hysteresis."""
        network = self._network
        stands = self._in_range & (distances <= network.radio_range + network.range_hysteresis)
        links: BoolArray = stands | (distances < network.radio_range)
        np.fill_diagonal(links, False)
        return links


def _fixed_links(network: NetworkConfig, robot_ids: Sequence[str]) -> list[tuple[int, int]]:
    """Links of a fixed topology over all robots, as pairs of robot indices; a ring of one robot links it to itself."""
    num_robots, pairs = len(robot_ids), list(combinations(range(len(robot_ids)), 2))
    if network.topology == "edges":
        index_of = {robot_id: index for index, robot_id in enumerate(robot_ids)}
        return [(index_of[a], index_of[b]) for a, b, _ in network.edges]
    if network.topology == "random":
        # Only this topology needs networkx, which takes a tenth of a second to import.
        import networkx as nx

        return list(nx.gnp_random_graph(num_robots, network.prob_link, seed=network.network_seed).edges)
    if network.topology == "grid":
        num_columns = math.isqrt(num_robots - 1) + 1  # the square root, rounded up
        return [(i, j) for i, j in pairs if j - i == num_columns or (j - i == 1 and j % num_columns > 0)]
    if network.topology == "ring":
        return [(i, (i + 1) % num_robots) for i in range(num_robots)]
    if network.topology == "line":
        return list(pairwise(range(num_robots)))
    if network.topology == "star":
        return [(0, i) for i in range(1, num_robots)]
    return pairs  # complete


def _adjacency(links: Iterable[tuple[int, int]], num_robots: int) -> BoolArray:
    """Symmetric matrix (N, N) bool of undirected links."""
    matrix = np.zeros((num_robots, num_robots), dtype=bool)
    for i, j in links:
        matrix[i, j] = matrix[j, i] = True
    np.fill_diagonal(matrix, False)
    return matrix


def _distances(positions: Float64Array) -> Float64Array:
    """Distances (N, N) between positions (N, 3); NaN where a position is NaN."""
    distances: Float64Array = np.sqrt(((positions[:, None] - positions) ** 2).sum(axis=2))
    return distances


def _nearest_links(distances: Float64Array, num_nearest: int) -> BoolArray:
    """Links from each robot to its nearest robots, ties by index; a link exists if either end selects it."""
    others = np.where(np.isnan(distances), np.inf, distances)
    np.fill_diagonal(others, np.inf)
    order = np.argsort(others, axis=1, kind="stable")[:, :num_nearest]
    wanted = np.zeros(others.shape, dtype=bool)
    np.put_along_axis(wanted, order, True, axis=1)
    wanted &= np.isfinite(others)
    symmetric: BoolArray = wanted | wanted.T
    return symmetric
