"""The communication graph of a tick: who hears whom, how much it counts, and how large a step is stable.

L = diag(row sums of A off the diagonal) - A. One consensus step without evidence is h <- (I - 2 epsilon L) h, so it
contracts exactly when |1 - 2 epsilon mu| < 1 for every non-zero eigenvalue mu of L. Links are undirected and every
choice of weights makes A similar to a symmetric matrix, so the eigenvalues are real up to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import numpy.typing as npt

from octoreplay.config import ConsensusConfig, NetworkConfig
from octoreplay.errors import ConfigError
from octoreplay.records import Float64Array

if TYPE_CHECKING:
    import networkx as nx

Link: TypeAlias = tuple[int, int]

_ROUNDING = 1e-9  # eigenvalues below this are zero; sums and bounds are compared with this much room


@dataclass(frozen=True, eq=False)
class CommunicationGraph:
    """The links among a team's active robots and the weights A of their maps.

    ``active`` holds the indices of the active robots, ascending. ``links`` holds each undirected link once, as (i, j)
    with i < j, sorted. ``weights`` is A, (N, N) float64, read-only, with a zero diagonal: A_ii is what a row sum lacks
    to 1. Dormant robots count in N and have no links. ``network`` is what the graph was made from.
    """

    robot_ids: tuple[str, ...]
    active: tuple[int, ...]
    links: tuple[Link, ...]
    weights: Float64Array
    network: NetworkConfig

    def neighbours(self, robot_index: int) -> tuple[int, ...]:
        """Indices of the robots that a robot has a link with, ascending."""
        return self._adjacency[robot_index]

    def degree(self, robot_index: int) -> int:
        """The number of a robot's links."""
        return len(self._adjacency[robot_index])

    @cached_property
    def laplacian(self) -> Float64Array:
        """L = diag(row sums of A) - A, (N, N) float64, read-only."""
        matrix: Float64Array = np.diag(self.weights.sum(axis=1)) - self.weights
        matrix.setflags(write=False)
        return matrix

    @cached_property
    def lambda_max(self) -> float:
        """The largest |eigenvalue| of L; 0 without links."""
        return float(np.abs(self._non_zero_eigenvalues).max(initial=0.0))

    @cached_property
    def epsilon_bound(self) -> float:
        """The step size below which consensus converges; infinite without links.

        |1 - 2 epsilon mu| reaches 1 at epsilon = Re(mu) / |mu|^2, which is 1 / mu for real mu.
        """
        values = self._non_zero_eigenvalues
        return float((values.real / np.abs(values) ** 2).min(initial=math.inf))

    def lambda_2(self, epsilon: float) -> float:
        """The second largest |eigenvalue| of I - 2 epsilon L: the largest |1 - 2 epsilon mu| over non-zero mu.

        The factor by which the disagreement shrinks in a tick; on a graph in several parts, that of the slowest part.
        0 without links.
        """
        return float(np.abs(1.0 - 2.0 * epsilon * self._non_zero_eigenvalues).max(initial=0.0))

    @cached_property
    def _adjacency(self) -> tuple[tuple[int, ...], ...]:
        """Each robot's neighbours."""
        neighbours: list[list[int]] = [[] for _ in self.robot_ids]
        for i, j in self.links:
            neighbours[i].append(j)
            neighbours[j].append(i)
        return tuple(tuple(sorted(row)) for row in neighbours)

    @cached_property
    def _non_zero_eigenvalues(self) -> npt.NDArray[np.complex128]:
        """The eigenvalues of L except one zero for each connected part, complex where rounding made them so."""
        values = np.linalg.eigvals(self.laplacian).astype(np.complex128)
        return values[np.abs(values) > _ROUNDING]


def build_graph(network: NetworkConfig, robot_ids: Sequence[str], active: Sequence[bool]) -> CommunicationGraph:
    """The graph that the topology induces on the active robots, with the weights of that graph.

    A link stands when both its ends are active: a ring with a dormant robot is a line, and a star without its centre,
    the first robot, has no links. An edge that is listed twice is one link, the later weight counts. ``active`` has one
    entry per robot.

    Raises ConfigError where the given weights of a robot sum to more than 1.
    """
    indices = tuple(index for index, (_, is_active) in enumerate(zip(robot_ids, active, strict=True)) if is_active)
    induced = _topology(network, robot_ids).subgraph(indices)
    links = tuple(sorted((min(i, j), max(i, j)) for i, j in induced.edges))
    weights = _link_weights(network, induced, len(robot_ids))
    _check_row_sums(weights, robot_ids)
    weights.setflags(write=False)
    return CommunicationGraph(tuple(robot_ids), indices, links, weights, network)


def step_size(graph: CommunicationGraph, consensus: ConsensusConfig) -> float:
    """The consensus step size epsilon on a graph, as configured or by default.

    The default is 0.5 with Metropolis weights, which is safe on every graph (all eigenvalues of L are below 2), else
    min(0.5, 0.9 / lambda_max). Rule 'local' exchanges nothing, so no bound holds for it.

    Raises ConfigError where epsilon is not below the graph's bound.
    """
    epsilon = consensus.epsilon if consensus.epsilon is not None else _default_step_size(graph)
    if consensus.rule != "local" and not epsilon < graph.epsilon_bound * (1.0 - _ROUNDING):
        raise ConfigError(
            f"epsilon: {epsilon} is not below {graph.epsilon_bound:.6g}, the bound of this graph (topology"
            f" '{graph.network.topology}', {len(graph.active)} of {len(graph.robot_ids)} robots active, weights"
            f" '{graph.network.weights}'); use {0.9 * graph.epsilon_bound:.3g} or leave epsilon out"
        )
    return epsilon


def settle_ticks_max(graph: CommunicationGraph, consensus: ConsensusConfig, epsilon: float) -> int:
    """The most settling ticks on a graph: ``settle_max``, or ``settle`` + 12 / -log10 lambda_2 rounded up; 0 without
    settling.

    So many ticks after gamma's ramp shrink the disagreement by 1e12.
    """
    if consensus.settle == 0:
        return 0
    if consensus.settle_max is not None:
        return consensus.settle_max
    rate = min(max(graph.lambda_2(epsilon), 1e-12), 1.0 - 1e-9)  # one tick at least, and a finite number of them
    return consensus.settle + math.ceil(12.0 / -math.log10(rate))


def check_team_graph(network: NetworkConfig, consensus: ConsensusConfig, robot_ids: Sequence[str]) -> None:
    """Check the graph of the whole team before a run.

    Parts of the team are checked when they occur: with weights other than 'given' the bound of a part can be lower.

    Raises ConfigError where a robot's weights sum to more than 1 or epsilon is not below the bound.
    """
    step_size(build_graph(network, robot_ids, [True] * len(robot_ids)), consensus)


def _topology(network: NetworkConfig, robot_ids: Sequence[str]) -> nx.Graph:
    """The topology over all robots, its nodes their indices; edges of a list carry their ``weight``."""
    import networkx as nx

    num_robots = len(robot_ids)
    if network.topology == "edges":
        index_of = {robot_id: index for index, robot_id in enumerate(robot_ids)}
        graph = nx.empty_graph(num_robots)
        graph.add_weighted_edges_from((index_of[a], index_of[b], weight) for a, b, weight in network.edges)
    elif network.topology == "star":
        graph = nx.star_graph(num_robots - 1)  # counts the leaves
    else:
        make = {"complete": nx.complete_graph, "ring": nx.cycle_graph, "line": nx.path_graph}[network.topology]
        graph = make(num_robots)
    graph.remove_edges_from(list(nx.selfloop_edges(graph)))  # networkx closes a ring of one robot on itself
    return graph


def _link_weights(network: NetworkConfig, graph: nx.Graph, num_robots: int) -> Float64Array:
    """A (N, N): Metropolis 1 / (1 + max(degree_i, degree_j)), 1 / degree_i, or the list's in both directions."""
    weights = np.zeros((num_robots, num_robots))
    degree = dict(graph.degree)
    for i, j, given in graph.edges(data="weight"):
        if network.weights == "metropolis":
            weights[i, j] = weights[j, i] = 1.0 / (1.0 + max(degree[i], degree[j]))
        elif network.weights == "degree":
            weights[i, j], weights[j, i] = 1.0 / degree[i], 1.0 / degree[j]
        else:
            weights[i, j] = weights[j, i] = given
    return weights


def _check_row_sums(weights: Float64Array, robot_ids: Sequence[str]) -> None:
    """Refuse rows that leave nothing for A_ii; NaN is refused too."""
    for robot_id, total in zip(robot_ids, weights.sum(axis=1), strict=True):
        if not total <= 1.0 + _ROUNDING:
            raise ConfigError(f"edges: the weights of robot '{robot_id}' sum to {total:.6g}; lower them to at most 1")


def _default_step_size(graph: CommunicationGraph) -> float:
    """Epsilon where none is configured."""
    if graph.network.weights == "metropolis" or graph.lambda_max == 0.0:
        return 0.5
    return min(0.5, 0.9 / graph.lambda_max)
