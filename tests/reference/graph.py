"""The communication graph of a tick: links, weights, the step-size bound and the rate of convergence."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from octoreplay.config import ConsensusConfig, NetworkConfig
from octoreplay.errors import ConfigError
from octoreplay.records import Float64Array

Link = tuple[int, int]

_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class TeamGraph:
    """The undirected links {i, j} with i < j among the robots that are active, the weights A (N, N) with zeros on the
    diagonal, and the consensus step size."""

    links: tuple[Link, ...]
    weights: Float64Array
    epsilon: float

    def neighbours(self, robot: int) -> list[int]:
        """The other ends of the robot's links, in the team's order."""
        return sorted(a + b - robot for a, b in self.links if robot in (a, b))

    def degree(self, robot: int) -> int:
        """The number of the robot's links."""
        return len(self.neighbours(robot))


def team_graph(
    network: NetworkConfig, consensus: ConsensusConfig, robot_ids: Sequence[str], active: Sequence[bool]
) -> TeamGraph:
    """The graph that the topology induces on the active robots, weighted anew.

    Raises ConfigError when the step size is not below the bound of this graph (rule 'local' exchanges nothing and has
    none), or when given weights have a row sum above 1.
    """
    links = tuple(link for link in topology_links(network, robot_ids) if active[link[0]] and active[link[1]])
    weights = link_weights(network, links, robot_ids)
    epsilon = step_size(consensus, network, weights)
    if consensus.rule != "local":
        check_step_size(epsilon, weights)
    return TeamGraph(links, weights, epsilon)


def topology_links(network: NetworkConfig, robot_ids: Sequence[str]) -> tuple[Link, ...]:
    """Every link {i, j}, i < j, of the topology with all robots in it; the star's centre is the first robot."""
    n = len(robot_ids)
    if network.topology == "complete":
        pairs = list(itertools.combinations(range(n), 2))
    elif network.topology == "line":
        pairs = [(i, i + 1) for i in range(n - 1)]
    elif network.topology == "ring":
        pairs = [(i, (i + 1) % n) for i in range(n)]
    elif network.topology == "star":
        pairs = [(0, i) for i in range(1, n)]
    else:
        index = {robot_id: i for i, robot_id in enumerate(robot_ids)}
        pairs = [(index[a], index[b]) for a, b, _ in network.edges]
    return tuple(sorted({(min(a, b), max(a, b)) for a, b in pairs if a != b}))


def link_weights(network: NetworkConfig, links: Sequence[Link], robot_ids: Sequence[str]) -> Float64Array:
    """A (N, N): Metropolis 1 / (1 + max(degree_i, degree_j)), 1 / degree_i, or the edge list's (both directions)."""
    n = len(robot_ids)
    degree = [sum(i in link for link in links) for i in range(n)]
    given = {frozenset((a, b)): weight for a, b, weight in network.edges}
    weights = np.zeros((n, n))
    for a, b in links:
        for i, j in ((a, b), (b, a)):
            if network.weights == "metropolis":
                weights[i, j] = 1.0 / (1.0 + max(degree[i], degree[j]))
            elif network.weights == "degree":
                weights[i, j] = 1.0 / degree[i]
            else:
                weights[i, j] = given[frozenset((robot_ids[i], robot_ids[j]))]
    for i in range(n):
        if weights[i].sum() > 1.0 + _ROUNDING:
            raise ConfigError(f"edges: the weights of '{robot_ids[i]}' sum to {weights[i].sum():g}, more than 1")
    return weights


def laplacian(weights: Float64Array) -> Float64Array:
    """L = diag(row sums of A off the diagonal) - A."""
    return np.diag(weights.sum(axis=1)) - weights


def step_size(consensus: ConsensusConfig, network: NetworkConfig, weights: Float64Array) -> float:
    """epsilon as configured; by default 0.5 with Metropolis weights, else min(0.5, 0.9 / lambda_max) of this graph."""
    if consensus.epsilon is not None:
        return consensus.epsilon
    largest = float(np.abs(np.linalg.eigvals(laplacian(weights))).max())
    if network.weights == "metropolis" or largest < _ROUNDING:
        return 0.5
    return min(0.5, 0.9 / largest)


def step_size_bound(weights: Float64Array) -> float:
    """The epsilon below which consensus converges; infinite without links.

    Symmetric A: 1 / lambda_max(L). Else the least Re(mu) / |mu|^2 over the non-zero eigenvalues of L, which is where
    |1 - 2 epsilon mu| reaches 1.
    """
    if np.array_equal(weights, weights.T):
        values = np.linalg.eigvalsh(laplacian(weights)).astype(complex)
    else:
        values = np.linalg.eigvals(laplacian(weights)).astype(complex)
    return min((float(mu.real / abs(mu) ** 2) for mu in values if abs(mu) > _ROUNDING), default=math.inf)


def check_step_size(epsilon: float, weights: Float64Array) -> None:
    """Raise ConfigError when epsilon is not below the bound."""
    bound = step_size_bound(weights)
    if not epsilon < bound * (1.0 - _ROUNDING):
        raise ConfigError(f"epsilon: {epsilon:g} is not below the bound {bound:g} of this graph")


def second_eigenvalue(graph: TeamGraph) -> float:
    """lambda_2: the second largest |eigenvalue| of I - 2 epsilon L, that is the largest |1 - 2 epsilon mu| over the
    non-zero eigenvalues mu of L; 0 without any.

    On a graph in several parts (a robot without links is one) this is the rate of the part that agrees slowest.
    """
    values = np.linalg.eigvals(laplacian(graph.weights))
    return max((float(abs(1.0 - 2.0 * graph.epsilon * mu)) for mu in values if abs(mu) > _ROUNDING), default=0.0)


def default_settle_max(num_ramp_ticks: int, lambda_2: float) -> int:
    """Most settling ticks: ramp + 12 / -log10 lambda_2, rounded up; lambda_2 is held in [1e-12, 1 - 1e-9]."""
    return num_ramp_ticks + math.ceil(12.0 / -math.log10(min(max(lambda_2, 1e-12), 1.0 - 1e-9)))
