"""Communication graph of a tick: directed links, weights of the maps, and bound of the step size.

L = diag(row sums of A off the diagonal) - A. One consensus step without evidence is h <- (I - 2 epsilon L) h. It
contracts exactly when |1 - 2 epsilon mu| < 1 for every non-zero eigenvalue mu of L. The eigenvalues can be complex,
since links may be one-way. Row sums are at most 1, so by Gershgorin's theorem every mu lies in the disc
|mu - 1| <= 1, and any epsilon below 0.5 is stable on any graph.
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
from octoreplay.config.network import POSITION_TOPOLOGIES, NetworkConfig
from octoreplay.errors import ConfigError
from octoreplay.records import BoolArray, Float64Array, Int64Array, read_only
from octoreplay.replay.network.schedule import Availability, Schedule
from octoreplay.replay.network.topology import Topology

Link: TypeAlias = tuple[int, int]

_ROUNDING = 1e-9  # eigenvalues below this count as zero; tolerance of sums and bounds


@dataclass(frozen=True, eq=False)
class CommunicationGraph:
    """Links among a team's active robots and the weights A of their maps.

    ``active`` holds the indices of the active robots, ascending; other robots count in N and have no links. ``links``
    holds the directed links (sender, receiver), sorted. ``weights`` is A, (N, N) float64, read-only: A_ij is the
    weight of sender j's map at receiver i, zero without a link and on the diagonal. A_ii is 1 minus the row sum.
    ``network`` is the configuration of the graph.
    """

    robot_ids: tuple[str, ...]
    active: tuple[int, ...]
    links: tuple[Link, ...]
    weights: Float64Array
    network: NetworkConfig

    @cached_property
    def pairs(self) -> tuple[Link, ...]:
        """Pairs (i, j), i < j, of robots with a link in either direction, each once, sorted."""
        return tuple(sorted({(min(link), max(link)) for link in self.links}))

    def senders(self, robot_index: int) -> tuple[int, ...]:
        """Indices of the robots that send to a robot, ascending."""
        return self._senders[robot_index]

    def receivers(self, robot_index: int) -> tuple[int, ...]:
        """Indices of the robots that a robot sends to, ascending."""
        return self._receivers[robot_index]

    def degree(self, robot_index: int) -> int:
        """Number of robots that send to a robot."""
        return len(self._senders[robot_index])

    @cached_property
    def num_reaching(self) -> Int64Array:
        """Number (N,) of robots whose maps reach each robot, directly or over others; itself counts."""
        reaches = np.eye(len(self.robot_ids), dtype=bool)
        for link in self.links:
            reaches[link] = True
        for middle in range(len(self.robot_ids)):
            reaches |= reaches[:, middle, None] & reaches[middle]
        counts: Int64Array = reaches.sum(axis=0)
        return counts

    @cached_property
    def is_symmetric(self) -> bool:
        """True when every link is bidirectional with equal weights, so that mixing keeps the sum over the robots."""
        both_ways = {(receiver, sender) for sender, receiver in self.links} == set(self.links)
        return both_ways and np.array_equal(self.weights, self.weights.T)

    @cached_property
    def laplacian(self) -> Float64Array:
        """L = diag(row sums of A) - A, (N, N) float64, read-only."""
        matrix: Float64Array = np.diag(self.weights.sum(axis=1)) - self.weights
        return read_only(matrix)

    @cached_property
    def lambda_max(self) -> float:
        """Largest |eigenvalue| of L; 0 without links."""
        return float(np.abs(self._non_zero_eigenvalues).max(initial=0.0))

    @cached_property
    def epsilon_bound(self) -> float:
        """Step size below which consensus converges; infinite without links.

        |1 - 2 epsilon mu| reaches 1 at epsilon = Re(mu) / |mu|^2, which is 1 / mu for real mu. It is never below 0.5,
        since |mu - 1| <= 1; lower values are rounding errors.
        """
        values = self._non_zero_eigenvalues
        return max(0.5, float((values.real / np.abs(values) ** 2).min(initial=math.inf)))

    @cached_property
    def mean_bound(self) -> float:
        """Step size up to which h_i + 2 epsilon sum_j A_ij r_ij (h_j - h_i) is a weighted mean of maps for r_ij <= 1.

        The weight of h_i is at least 1 - 2 epsilon sum_j A_ij. The bound is at least 0.5, and infinite without links.
        """
        largest = float(self.weights.sum(axis=1).max(initial=0.0))
        return max(0.5, 0.5 / largest) if largest else math.inf

    def bound(self, consensus: ConsensusConfig) -> float:
        """Step size below which a rule with a step size converges."""
        return self.mean_bound if consensus.traits.weighs_certainty else self.epsilon_bound

    def lambda_2(self, epsilon: float) -> float:
        """Second largest |eigenvalue| of I - 2 epsilon L: the largest |1 - 2 epsilon mu| over non-zero mu.

        The disagreement shrinks by this factor in a tick; on a graph of several components, in the slowest one. 0
        without links.
        """
        return float(np.abs(1.0 - 2.0 * epsilon * self._non_zero_eigenvalues).max(initial=0.0))

    @cached_property
    def _senders(self) -> tuple[tuple[int, ...], ...]:
        """Senders of each robot."""
        heard: list[list[int]] = [[] for _ in self.robot_ids]
        for sender, receiver in self.links:
            heard[receiver].append(sender)
        return tuple(tuple(row) for row in heard)  # ascending, as the links are

    @cached_property
    def _receivers(self) -> tuple[tuple[int, ...], ...]:
        """Receivers of each robot."""
        hearing: list[list[int]] = [[] for _ in self.robot_ids]
        for sender, receiver in self.links:
            hearing[sender].append(receiver)
        return tuple(tuple(row) for row in hearing)

    @cached_property
    def _non_zero_eigenvalues(self) -> npt.NDArray[np.complex128]:
        """Non-zero eigenvalues of L; it has one zero for each group of robots without links from outside."""
        values = np.linalg.eigvals(self.laplacian).astype(np.complex128)
        return values[np.abs(values) > _ROUNDING]


class TeamNetwork:
    """Communication graphs of a team over time.

    The topology is restricted to the robots that are active and on. One-way pairs lose their other direction. Then the
    schedule applies: its links_up are bidirectional, its links_down are removed, silent robots do not send.
    ``radio_links`` are the links of the last graph together with those between robots in different frames, which mix no
    maps.

    Raises ConfigError where the schedule contradicts itself, or adds a link that has no weight.
    """

    def __init__(self, network: NetworkConfig, consensus: ConsensusConfig, robot_ids: Sequence[str]) -> None:
        self._network = network
        self._consensus = consensus
        self._robot_ids = tuple(robot_ids)
        self.schedule = Schedule(network.schedule, robot_ids)
        self._topology = Topology(network, robot_ids)
        self._blocked = _one_way_block(network, robot_ids)
        self._graph: CommunicationGraph | None = None
        self.radio_links: tuple[Link, ...] = ()
        if network.weights == "given":
            _check_given_weights(network)

    def at(
        self,
        elapsed_s: float,
        active: Sequence[bool] | BoolArray,
        positions: Float64Array,
        in_one_frame: BoolArray | None = None,
    ) -> CommunicationGraph:
        """Graph at a time since the run's start; the same object as before if nothing has changed.

        ``active`` (N,) bool are the robots that take part, including those that the schedule has off. ``positions``
        (N, 3) float64 are in metres in the team's frame, NaN for robots without a pose. ``in_one_frame`` (N, N) bool
        are the pairs of robots that may mix their maps (default: all). Call it in the order of time, once a tick:
        topology 'range' keeps its links for the hysteresis.

        Raises ConfigError where a robot's weights sum to more than 1, or epsilon is not below the graph's bound.
        """
        available = self.schedule.at(elapsed_s)
        present = np.asarray(active, dtype=bool) & ~available.robots_off
        hears = self._hears(present, positions, available)
        self.radio_links = _links(hears)
        if in_one_frame is not None:
            hears = hears & in_one_frame
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
        """Directed links (N, N) bool: row i holds the senders of robot i."""
        hears = self._topology.links(present, positions) & ~self._blocked
        hears = (hears | available.links_up) & ~available.links_down
        hears &= present[:, None] & (present & ~available.robots_silent)
        return hears


def build_graph(
    network: NetworkConfig, robot_ids: Sequence[str], active: Sequence[bool] | BoolArray, hears: BoolArray
) -> CommunicationGraph:
    """Graph with the directed links ``hears`` (N, N) bool, whose row i holds the senders of robot i.

    ``active`` (N,) bool has one entry per robot. The diagonal of ``hears`` is False.

    Raises ConfigError where the given weights of a robot sum to more than 1.
    """
    indices = tuple(index for index, (_, is_active) in enumerate(zip(robot_ids, active, strict=True)) if is_active)
    weights = _weights(network, robot_ids, hears)
    _check_row_sums(weights, robot_ids)
    return CommunicationGraph(tuple(robot_ids), indices, _links(hears), read_only(weights), network)


def step_size(graph: CommunicationGraph, consensus: ConsensusConfig) -> float:
    """Consensus step size epsilon on a graph, as configured or by default.

    The default with Metropolis and max-degree weights is 0.5: the weights of d senders sum to at most d / (1 + d) < 1,
    so I - L is row-stochastic with a positive diagonal, and by Gershgorin's theorem its eigenvalues other than 1 are
    inside the unit circle. With other weights the default is min(0.5, 0.9 x the bound). Rules without a step size have
    no bound.

    Raises ConfigError where a configured epsilon is not below the graph's bound.
    """
    if consensus.epsilon is None:
        always_stable = graph.network.weights in ("metropolis", "max-degree")
        return 0.5 if always_stable else min(0.5, 0.9 * graph.bound(consensus))
    # Bounds are at least 0.5, so smaller steps need no eigenvalues.
    has_bound = consensus.traits.has_step_size and consensus.epsilon >= 0.5 * (1.0 - _ROUNDING)
    if has_bound and not consensus.epsilon < graph.bound(consensus) * (1.0 - _ROUNDING):
        bound = graph.bound(consensus)
        raise ConfigError(
            f"epsilon: {consensus.epsilon} is not below {bound:.6g}, the bound of this graph (topology"
            f" '{graph.network.topology}', {len(graph.active)} of {len(graph.robot_ids)} robots active, weights"
            f" '{graph.network.weights}'); use {0.9 * bound:.3g} or leave epsilon out"
        )
    return consensus.epsilon


def step_weights_of(graph: CommunicationGraph, consensus: ConsensusConfig) -> Float64Array:
    """Weights (N, N) float64 of the maps in an iteration: 2 epsilon A_ij, or ``merge_weight`` on every link.

    Row i holds the weights at robot i. Raises ConfigError as ``step_size``.
    """
    if consensus.merge_weight is not None and not consensus.traits.mixes_differences:
        constant: Float64Array = np.where(graph.weights > 0.0, consensus.merge_weight, 0.0)
        return constant
    return 2.0 * step_size(graph, consensus) * graph.weights


def check_team_graph(network: NetworkConfig, consensus: ConsensusConfig, robot_ids: Sequence[str]) -> None:
    """Check the schedule, and the whole team's graph at each of its changes, before a run.

    Graphs of a part of the team, whose bound can be lower, and of topologies that depend on positions are checked when
    they occur.

    Raises ConfigError as TeamNetwork does.
    """
    team = TeamNetwork(network, consensus, robot_ids)
    if network.topology in POSITION_TOPOLOGIES:
        return
    for elapsed_s in sorted({0.0, *team.schedule.change_times}):
        team.at(elapsed_s, [True] * len(robot_ids), np.full((len(robot_ids), 3), np.nan))


def _links(hears: BoolArray) -> tuple[Link, ...]:
    """Links (sender, receiver), sorted, of a matrix whose row i holds the senders of robot i."""
    senders, receivers = np.nonzero(hears.T)
    return tuple(zip(senders.tolist(), receivers.tolist(), strict=True))


def _one_way_block(network: NetworkConfig, robot_ids: Sequence[str]) -> BoolArray:
    """Directions that one-way pairs remove, (N, N) bool: True at [i, j] for the direction from j to i."""
    index_of = {robot_id: index for index, robot_id in enumerate(robot_ids)}
    blocked = np.zeros((len(robot_ids), len(robot_ids)), dtype=bool)
    for sender, receiver in network.one_way:
        blocked[index_of[sender], index_of[receiver]] = True
    return blocked


def _weights(network: NetworkConfig, robot_ids: Sequence[str], hears: BoolArray) -> Float64Array:
    """A (N, N) float64 of a graph; a robot's degree is its number of senders.

    Metropolis: 1 / (1 + max(degree_i, degree_j)). Max-degree: 1 / (1 + the largest degree of the graph), the
    maximum-degree weights of Xiao, Boyd and Kim, Distributed average consensus with least-mean-square deviation, J.
    Parallel Distrib. Comput. 67, 2007. Degree: 1 / degree_i. Given: the weights of the edge list, the same in both
    directions; if an edge is listed twice, the later weight counts.
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
    """Raise ConfigError where the schedule adds a link that the edge list has no weight for."""
    listed = {frozenset((a, b)) for a, b, _ in network.edges}
    for entry in network.schedule:
        for a, b in entry.links_up:
            if frozenset((a, b)) not in listed:
                raise ConfigError(
                    f"schedule: links_up '{a}' - '{b}' has no weight; add it to edges with one (weights 'given')"
                )


def _check_row_sums(weights: Float64Array, robot_ids: Sequence[str]) -> None:
    """Raise ConfigError for a row sum above 1 or NaN."""
    for robot_id, total in zip(robot_ids, weights.sum(axis=1), strict=True):
        if not total <= 1.0 + _ROUNDING:
            raise ConfigError(f"edges: the weights of robot '{robot_id}' sum to {total:.6g}; lower them to at most 1")
