"""Communication graph of a tick: links, weights, step-size bound and rate of convergence."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from octoreplay.config.consensus import ConsensusConfig
from octoreplay.config.network import NetworkConfig, ScheduleEntry
from octoreplay.errors import ConfigError
from octoreplay.records import Float64Array

Link = tuple[int, int]

_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class TeamGraph:
    """Directed links (sender, receiver) of the active robots, weights A (N, N), and consensus step size.

    Rows of A are receivers, columns senders; the diagonal is 0.
    """

    directed: tuple[Link, ...]
    weights: Float64Array
    epsilon: float

    @property
    def links(self) -> tuple[Link, ...]:
        """Pairs {i, j}, i < j, with a link in either direction."""
        return tuple(sorted({(min(link), max(link)) for link in self.directed}))

    def neighbours(self, robot: int) -> list[int]:
        """Return the senders of the robot's incoming links, in the team's order."""
        return sorted(sender for sender, receiver in self.directed if receiver == robot)

    def receivers(self, robot: int) -> list[int]:
        """Return the receivers of the robot's outgoing links, in the team's order."""
        return sorted(receiver for sender, receiver in self.directed if sender == robot)

    @property
    def least_weight(self) -> float:
        """Smallest weight of a link that is above 0; infinite without links."""
        return float(self.weights[self.weights > 0.0].min(initial=math.inf))

    def degree(self, robot: int) -> int:
        """Return the number of the robot's incoming links."""
        return len(self.neighbours(robot))


def team_graph(
    network: NetworkConfig,
    consensus: ConsensusConfig,
    robot_ids: Sequence[str],
    active: Sequence[bool],
    elapsed_s: float = 0.0,
    history: Sequence[Sequence[Sequence[float] | None]] = (),
) -> TeamGraph:
    """Return the graph of the topology on the active robots at a time of the schedule, with weights and step size.

    ``history`` has, for each tick up to this one, each robot's position, or None where it has none.

    Raises ConfigError where the step size is not below the bound of this graph (for rules with a step size), and where
    given weights have a row sum above 1.
    """
    directed = directed_links(network, robot_ids, active, elapsed_s, history)
    weights = link_weights(network, directed, robot_ids)
    epsilon = step_size(consensus, network, weights)
    if consensus.rule in ("gradient", "bayes", "natural", "weighted"):
        check_step_size(epsilon, _bound(consensus, weights))
    return TeamGraph(directed, weights, epsilon)


def directed_links(
    network: NetworkConfig,
    robot_ids: Sequence[str],
    active: Sequence[bool],
    elapsed_s: float = 0.0,
    history: Sequence[Sequence[Sequence[float] | None]] = (),
) -> tuple[Link, ...]:
    """Return all (sender, receiver), sorted: links of the topology, without blocked directions, after the schedule."""
    entries = [entry for entry in network.schedule if entry.start <= elapsed_s and not entry.end <= elapsed_s]
    topology = topology_links(network, robot_ids, history)
    links = []
    for sender, receiver in itertools.permutations(range(len(robot_ids)), 2):
        a, b = robot_ids[sender], robot_ids[receiver]
        carries = (min(sender, receiver), max(sender, receiver)) in topology and (b, a) not in network.one_way
        for entry in entries:
            if (a, b) in entry.links_up or (b, a) in entry.links_up:
                carries = True
        for entry in entries:
            if _cuts(entry, a, b):
                carries = False
        if carries and active[sender] and active[receiver]:
            links.append((sender, receiver))
    return tuple(sorted(links))


def _cuts(entry: ScheduleEntry, a: str, b: str) -> bool:
    """Return whether an entry of the schedule cuts the link from a to b."""
    in_groups = [group for group in entry.groups if a in group or b in group]
    return (
        a in entry.robots_off
        or b in entry.robots_off
        or a in entry.robots_silent
        or (a, b) in entry.links_down
        or (b, a) in entry.links_down
        or len(in_groups) == 2
    )


def topology_links(
    network: NetworkConfig, robot_ids: Sequence[str], history: Sequence[Sequence[Sequence[float] | None]] = ()
) -> tuple[Link, ...]:
    """Return all links {i, j}, i < j, of the topology over all robots; the star's centre is the first robot."""
    n = len(robot_ids)
    if network.topology == "complete":
        pairs = list(itertools.combinations(range(n), 2))
    elif network.topology == "line":
        pairs = [(i, i + 1) for i in range(n - 1)]
    elif network.topology == "ring":
        pairs = [(i, (i + 1) % n) for i in range(n)]
    elif network.topology == "star":
        pairs = [(0, i) for i in range(1, n)]
    elif network.topology == "grid":
        columns = math.ceil(math.sqrt(n))
        place = [divmod(i, columns) for i in range(n)]
        pairs = [
            (i, j)
            for i, j in itertools.combinations(range(n), 2)
            if abs(place[i][0] - place[j][0]) + abs(place[i][1] - place[j][1]) == 1
        ]
    elif network.topology == "random":
        chance = random.Random(network.network_seed)
        pairs = [pair for pair in itertools.combinations(range(n), 2) if chance.random() < network.prob_link]
    elif network.topology == "nearest":
        pairs = [(i, j) for i in range(n) for j in _nearest(i, history[-1], network.num_nearest)]
    elif network.topology == "range":
        pairs = [pair for pair in itertools.combinations(range(n), 2) if _in_range(pair, history, network)]
    else:
        index = {robot_id: i for i, robot_id in enumerate(robot_ids)}
        pairs = [(index[a], index[b]) for a, b, _ in network.edges]
    return tuple(sorted({(min(a, b), max(a, b)) for a, b in pairs if a != b}))


def _nearest(robot: int, positions: Sequence[Sequence[float] | None], most: int) -> list[int]:
    """Return the nearest robots; ties go to the lower index."""
    here = positions[robot]
    if here is None:
        return []
    others = [
        (math.dist(here, there), other) for other, there in enumerate(positions) if other != robot and there is not None
    ]
    return [other for _, other in sorted(others)[:most]]


def _in_range(pair: Link, history: Sequence[Sequence[Sequence[float] | None]], network: NetworkConfig) -> bool:
    """Return whether two robots are linked by range, with hysteresis over the history."""
    for positions in reversed(history):
        here, there = positions[pair[0]], positions[pair[1]]
        if here is None or there is None or math.dist(here, there) > network.radio_range + network.range_hysteresis:
            return False
        if math.dist(here, there) < network.radio_range:
            return True
    return False


def link_weights(network: NetworkConfig, directed: Sequence[Link], robot_ids: Sequence[str]) -> Float64Array:
    """Return A (N, N), where degree_i is the number of i's incoming links.

    Weights are Metropolis 1 / (1 + max(degree_i, degree_j)), 1 / degree_i, 1 / (1 + largest degree), or those of the
    edge list (both directions).
    """
    n = len(robot_ids)
    degree = [sum(receiver == i for _, receiver in directed) for i in range(n)]
    given = {frozenset((a, b)): weight for a, b, weight in network.edges}
    weights = np.zeros((n, n))
    for j, i in directed:
        if network.weights == "metropolis":
            weights[i, j] = 1.0 / (1.0 + max(degree[i], degree[j]))
        elif network.weights == "degree":
            weights[i, j] = 1.0 / degree[i]
        elif network.weights == "max-degree":
            weights[i, j] = 1.0 / (1.0 + max(degree))
        else:
            weights[i, j] = given[frozenset((robot_ids[i], robot_ids[j]))]
    for i in range(n):
        if weights[i].sum() > 1.0 + _ROUNDING:
            raise ConfigError(f"edges: the weights of '{robot_ids[i]}' sum to {weights[i].sum():g}, more than 1")
    return weights


def laplacian(weights: Float64Array) -> Float64Array:
    """Return L = diag(row sums of A off the diagonal) - A."""
    return np.diag(weights.sum(axis=1)) - weights


def step_size(consensus: ConsensusConfig, network: NetworkConfig, weights: Float64Array) -> float:
    """Return epsilon: configured, 0.5 with Metropolis and max-degree weights, else min(0.5, 0.9 x bound)."""
    if consensus.epsilon is not None:
        return consensus.epsilon
    if network.weights in ("metropolis", "max-degree"):
        return 0.5
    return min(0.5, 0.9 * _bound(consensus, weights))


def _bound(consensus: ConsensusConfig, weights: Float64Array) -> float:
    """Return the bound of the rule's step size."""
    return mean_bound(weights) if consensus.rule == "weighted" else step_size_bound(weights)


def mean_bound(weights: Float64Array) -> float:
    """Return the epsilon at which the largest sum of a robot's step weights 2 epsilon A_ij is 1."""
    return min((0.5 / total for total in weights.sum(axis=1) if total > 0.0), default=math.inf)


def step_size_bound(weights: Float64Array) -> float:
    """Return the epsilon below which consensus converges; infinite without links.

    It is 1 / lambda_max(L) for symmetric A, else the smallest Re(mu) / |mu|^2 over the non-zero eigenvalues mu of L, at
    which |1 - 2 epsilon mu| reaches 1.
    """
    if np.array_equal(weights, weights.T):
        values = np.linalg.eigvalsh(laplacian(weights)).astype(complex)
    else:
        values = np.linalg.eigvals(laplacian(weights)).astype(complex)
    return min((float(mu.real / abs(mu) ** 2) for mu in values if abs(mu) > _ROUNDING), default=math.inf)


def simulated_bound(weights: Float64Array, num_steps: int = 1 << 17) -> float:
    """Return the epsilon below which consensus converges, by simulation.

    Bisection between 0.4 and 10 on the growth of the differences L h in ``num_steps`` steps.
    """
    matrix = laplacian(weights)
    low, high = 0.4, 10.0
    for _ in range(20):
        epsilon = (low + high) / 2.0
        power = np.eye(len(weights)) - 2.0 * epsilon * matrix
        log_scale = 0.0
        for _ in range(num_steps.bit_length() - 1):
            power = power @ power
            scale = max(1e-300, float(np.abs(power).max()))  # the scale is separate, so that nothing overflows
            power, log_scale = power / scale, 2.0 * log_scale + math.log(scale)
        shrinks = log_scale + math.log(max(1e-300, float(np.abs(matrix @ power).max()))) < 0.0
        low, high = (epsilon, high) if shrinks else (low, epsilon)
    return low


def check_step_size(epsilon: float, bound: float) -> None:
    """Raise ConfigError where epsilon is not below the bound."""
    if not epsilon < bound * (1.0 - _ROUNDING):
        raise ConfigError(f"epsilon: {epsilon:g} is not below the bound {bound:g} of this graph")


def second_eigenvalue(graph: TeamGraph, share: float = 1.0) -> float:
    """Return lambda_2, the second largest |eigenvalue| of I - 2 epsilon L, with ``share`` of epsilon.

    It is the largest |1 - 2 epsilon mu| over the non-zero eigenvalues mu of L, 0 without any. In a graph of several
    components, it is the rate of the slowest one.
    """
    values = np.linalg.eigvals(laplacian(graph.weights))
    step = 2.0 * share * graph.epsilon
    return max((float(abs(1.0 - step * mu)) for mu in values if abs(mu) > _ROUNDING), default=0.0)


def default_settle_max(num_ramp_ticks: int, lambda_2: float) -> int:
    """Return the maximum number of settling ticks: ramp + ceil(12 / -log10 lambda_2), lambda_2 in [1e-12, 1 - 1e-9]."""
    return num_ramp_ticks + math.ceil(12.0 / -math.log10(min(max(lambda_2, 1e-12), 1.0 - 1e-9)))
