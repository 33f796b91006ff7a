"""The communication graph of a tick: who hears whom, how much it counts, and how large a step is stable.

L = diag(row sums of A off the diagonal) - A. One consensus step without evidence is h <- (I - 2 epsilon L) h, so it
contracts exactly when |1 - 2 epsilon mu| < 1 for every non-zero eigenvalue mu of L. A link may carry one way only, so
the eigenvalues can be complex. Row sums are at most 1, so by Gershgorin every mu lies in the disc |mu - 1| <= 1: any
epsilon below 0.5 is stable on any graph.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from octoreplay.config.consensus import ConsensusConfig
from octoreplay.config.network import NetworkConfig
from octoreplay.errors import ConfigError
from octoreplay.records import BoolArray, Float64Array, read_only
from octoreplay.replay.network.schedule import Availability, Schedule
from octoreplay.replay.network.topology import POSITION_TOPOLOGIES, Topology

Link: TypeAlias = tuple[int, int]

_ROUNDING = 1e-9  # eigenvalues below this are zero; sums and bounds are compared with this much room


@dataclass(frozen=True, eq=False)
class CommunicationGraph:
    """The links among a team's active robots and the weights A of their maps.

    ``active`` holds the indices of the active robots, ascending. ``links`` holds the directed links as (sender,
    receiver), sorted. ``weights`` is A, (N, N) float64, read-only: A_ij is what receiver i gives to sender j's map,
    zero where i does not hear j and on the diagonal; A_ii is what a row sum lacks to 1. Other robots count in N and
    have no links. ``network`` is what the graph was made from.
    """

    robot_ids: tuple[str, ...]
    active: tuple[int, ...]
    links: tuple[Link, ...]
    weights: Float64Array
    network: NetworkConfig

    @cached_property
    def pairs(self) -> tuple[Link, ...]:
        """The pairs (i, j), i < j, of robots that are linked in either direction, each once, sorted."""
        return tuple(sorted({(min(link), max(link)) for link in self.links}))

    def senders(self, robot_index: int) -> tuple[int, ...]:
        """Indices of the robots that a robot hears, ascending."""
        return self._senders[robot_index]

    def receivers(self, robot_index: int) -> tuple[int, ...]:
        """Indices of the robots that hear a robot, ascending."""
        return self._receivers[robot_index]

    def degree(self, robot_index: int) -> int:
        """The number of robots that a robot hears."""
        return len(self._senders[robot_index])

    @cached_property
    def is_symmetric(self) -> bool:
        """True when every link carries both ways with the same weight, so that mixing keeps the sum over the robots."""
        both_ways = {(receiver, sender) for sender, receiver in self.links} == set(self.links)
        return both_ways and np.array_equal(self.weights, self.weights.T)

    @cached_property
    def laplacian(self) -> Float64Array:
        """L = diag(row sums of A) - A, (N, N) float64, read-only."""
        matrix: Float64Array = np.diag(self.weights.sum(axis=1)) - self.weights
        return read_only(matrix)

    @cached_property
    def lambda_max(self) -> float:
        """The largest |eigenvalue| of L; 0 without links."""
        return float(np.abs(self._non_zero_eigenvalues).max(initial=0.0))

    @cached_property
    def epsilon_bound(self) -> float:
        """The step size below which consensus converges; infinite without links.

        |1 - 2 epsilon mu| reaches 1 at epsilon = Re(mu) / |mu|^2, which is 1 / mu for real mu and never below 0.5,
        since |mu - 1| <= 1; where it comes out lower, that is rounding.
        """
        values = self._non_zero_eigenvalues
        return max(0.5, float((values.real / np.abs(values) ** 2).min(initial=math.inf)))

    def lambda_2(self, epsilon: float) -> float:
        """The second largest |eigenvalue| of I - 2 epsilon L: the largest |1 - 2 epsilon mu| over non-zero mu.

        The factor by which the disagreement shrinks in a tick; on a graph in several parts, that of the slowest part.
        0 without links.
        """
        return float(np.abs(1.0 - 2.0 * epsilon * self._non_zero_eigenvalues).max(initial=0.0))

    @cached_property
    def _senders(self) -> tuple[tuple[int, ...], ...]:
        """Whom each robot hears."""
        heard: list[list[int]] = [[] for _ in self.robot_ids]
        for sender, receiver in self.links:
            heard[receiver].append(sender)
        return tuple(tuple(row) for row in heard)  # ascending, as the links are

    @cached_property
    def _receivers(self) -> tuple[tuple[int, ...], ...]:
        """Who hears each robot."""
        hearing: list[list[int]] = [[] for _ in self.robot_ids]
        for sender, receiver in self.links:
            hearing[sender].append(receiver)
        return tuple(tuple(row) for row in hearing)

    @cached_property
    def _non_zero_eigenvalues(self) -> npt.NDArray[np.complex128]:
        """The eigenvalues of L except its zeros: one for each group of robots that hears nobody outside it."""
        values = np.linalg.eigvals(self.laplacian).astype(np.complex128)
        return values[np.abs(values) > _ROUNDING]


class TeamNetwork:
    """Who can hear whom, from tick to tick.

    The topology is induced on the robots that are active and on; pairs that are one-way lose the other direction; then
    the schedule has the last word: its links_up carry both ways, its links_down neither, silent robots send to nobody.

    Raises ConfigError where the schedule contradicts itself, or brings up a link that has no weight.
    """

    def __init__(self, network: NetworkConfig, consensus: ConsensusConfig, robot_ids: Sequence[str]) -> None:
        self._network = network
        self._consensus = consensus
        self._robot_ids = tuple(robot_ids)
        self.schedule = Schedule(network.schedule, robot_ids)
        self._topology = Topology(network, robot_ids)
        self._blocked = _one_way_block(network, robot_ids)
        self._graph: CommunicationGraph | None = None
        if network.weights == "given":
            _check_given_weights(network)

    def at(self, elapsed_s: float, active: Sequence[bool] | BoolArray, positions: Float64Array) -> CommunicationGraph:
        """The graph at a time since the run's start; the same object as last time when nothing has changed.

        ``active`` (N,) are the robots that take part, those that the schedule has off included; ``positions`` (N, 3) in
        metres in the team's frame, NaN for robots without a pose. Call it in the order of time, once a tick: topology
        'range' remembers its links.

        Raises ConfigError where a robot's weights sum to more than 1, or epsilon is not below the graph's bound.
        """
        available = self.schedule.at(elapsed_s)
        present = np.asarray(active, dtype=bool) & ~available.robots_off
        hears = self._hears(present, positions, available)
        indices = tuple(np.flatnonzero(present).tolist())
        links = _links(hears)
        if self._graph is None or (self._graph.active, self._graph.links) != (indices, links):
            try:
                graph = build_graph(self._network, self._robot_ids, present, hears)
                step_size(graph, self._consensus)
            except ConfigError as error:
                if available.is_undisturbed:
                    raise
                raise ConfigError(f"schedule: at {elapsed_s:g} s: {error}") from error
            self._graph = graph
        return self._graph

    def _hears(self, present: BoolArray, positions: Float64Array, available: Availability) -> BoolArray:
        """Who hears whom, (N, N): row i are the robots that i hears."""
        hears = self._topology.links(present, positions) & ~self._blocked
        hears = (hears | available.links_up) & ~available.links_down
        hears &= present[:, None] & (present & ~available.robots_silent)
        return hears


def build_graph(
    network: NetworkConfig, robot_ids: Sequence[str], active: Sequence[bool] | BoolArray, hears: BoolArray
) -> CommunicationGraph:
    """The graph in which robot i hears the robots of row i of ``hears`` (N, N), with the weights of that graph.

    ``active`` has one entry per robot. Nobody hears itself.

    Raises ConfigError where the given weights of a robot sum to more than 1.
    """
    indices = tuple(index for index, (_, is_active) in enumerate(zip(robot_ids, active, strict=True)) if is_active)
    weights = _weights(network, robot_ids, hears)
    _check_row_sums(weights, robot_ids)
    return CommunicationGraph(tuple(robot_ids), indices, _links(hears), read_only(weights), network)


def step_size(graph: CommunicationGraph, consensus: ConsensusConfig) -> float:
    """The consensus step size epsilon on a graph, as configured or by default.

    The default is 0.5 with Metropolis and max-degree weights: a robot that hears d others gives them d / (1 + d) < 1 in
    all, so I - L is row-stochastic with a positive diagonal, and by Gershgorin its eigenvalues other than 1 are inside
    the unit circle. Else it is min(0.5, 0.9 x the bound). Rules without a step size have no bound.

    Raises ConfigError where a configured epsilon is not below the graph's bound.
    """
    if consensus.epsilon is None:
        always_stable = graph.network.weights in ("metropolis", "max-degree")
        return 0.5 if always_stable else min(0.5, 0.9 * graph.epsilon_bound)
    # No bound is below 0.5, so smaller steps need no eigenvalues.
    has_bound = consensus.traits.has_step_size and consensus.epsilon >= 0.5 * (1.0 - _ROUNDING)
    if has_bound and not consensus.epsilon < graph.epsilon_bound * (1.0 - _ROUNDING):
        raise ConfigError(
            f"epsilon: {consensus.epsilon} is not below {graph.epsilon_bound:.6g}, the bound of this graph (topology"
            f" '{graph.network.topology}', {len(graph.active)} of {len(graph.robot_ids)} robots active, weights"
            f" '{graph.network.weights}'); use {0.9 * graph.epsilon_bound:.3g} or leave epsilon out"
        )
    return consensus.epsilon


def check_team_graph(network: NetworkConfig, consensus: ConsensusConfig, robot_ids: Sequence[str]) -> None:
    """Check the schedule, and the graph of the whole team whenever the schedule changes it, before a run.

    Parts of the team are checked when they occur, since the bound of a part can be lower, and so are the graphs of
    topologies that depend on positions.

    Raises ConfigError as TeamNetwork does.
    """
    team = TeamNetwork(network, consensus, robot_ids)
    if network.topology in POSITION_TOPOLOGIES:
        return
    for elapsed_s in sorted({0.0, *team.schedule.change_times}):
        team.at(elapsed_s, [True] * len(robot_ids), np.full((len(robot_ids), 3), np.nan))


def _links(hears: BoolArray) -> tuple[Link, ...]:
    """The links (sender, receiver), sorted, of who hears whom."""
    senders, receivers = np.nonzero(hears.T)
    return tuple(zip(senders.tolist(), receivers.tolist(), strict=True))


def _one_way_block(network: NetworkConfig, robot_ids: Sequence[str]) -> BoolArray:
    """What one-way pairs take away, (N, N): True at [i, j] where i cannot hear j."""
    index_of = {robot_id: index for index, robot_id in enumerate(robot_ids)}
    blocked = np.zeros((len(robot_ids), len(robot_ids)), dtype=bool)
    for sender, receiver in network.one_way:
        blocked[index_of[sender], index_of[receiver]] = True
    return blocked


def _weights(network: NetworkConfig, robot_ids: Sequence[str], hears: BoolArray) -> Float64Array:
    """A (N, N) of a graph; a robot's degree is the number of robots that it hears.

    Metropolis: 1 / (1 + max(degree_i, degree_j)). Max-degree: 1 / (1 + the largest degree of the graph), the
    maximum-degree weights of Xiao, Boyd and Kim, Distributed average consensus with least-mean-square deviation, J.
    Parallel Distrib. Comput. 67, 2007. Degree: 1 / degree_i. Given: the list's, the same in both directions; of an edge
    that is listed twice the later weight counts.
    """
    degrees = hears.sum(axis=1)
    weights = np.zeros(hears.shape)
    if network.weights == "given":
        weight_of = {frozenset((a, b)): weight for a, b, weight in network.edges}
        for i, j in np.argwhere(hears):
            weights[i, j] = weight_of[frozenset((robot_ids[i], robot_ids[j]))]
        return weights
    if network.weights == "metropolis":
        shares = 1.0 / (1.0 + np.maximum(degrees[:, None], degrees))
    elif network.weights == "max-degree":
        shares = np.full(hears.shape, 1.0 / (1.0 + degrees.max(initial=0)))
    else:
        shares = np.repeat(1.0 / np.maximum(degrees, 1)[:, None], len(degrees), axis=1)
    weights[hears] = shares[hears]
    return weights


def _check_given_weights(network: NetworkConfig) -> None:
    """Refuse links that the schedule brings up and the edge list has no weight for."""
    listed = {frozenset((a, b)) for a, b, _ in network.edges}
    for entry in network.schedule:
        for a, b in entry.links_up:
            if frozenset((a, b)) not in listed:
                raise ConfigError(
                    f"schedule: links_up '{a}' - '{b}' has no weight; add it to edges with one (weights 'given')"
                )


def _check_row_sums(weights: Float64Array, robot_ids: Sequence[str]) -> None:
    """Refuse rows that leave nothing for A_ii; NaN is refused too."""
    for robot_id, total in zip(robot_ids, weights.sum(axis=1), strict=True):
        if not total <= 1.0 + _ROUNDING:
            raise ConfigError(f"edges: the weights of robot '{robot_id}' sum to {total:.6g}; lower them to at most 1")
