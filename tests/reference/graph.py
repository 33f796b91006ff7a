"""The communication graph of a tick: links, weights, the step-size bound and the rate of convergence."""

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
    """The directed links (sender, receiver) among the robots that are active, the weights A (N, N) that receivers, the
    rows, give to senders, with zeros on the diagonal, and the consensus step size."""

    directed: tuple[Link, ...]
    weights: Float64Array
    epsilon: float

    @property
    def links(self) -> tuple[Link, ...]:
        """The pairs {i, j}, i < j, with a link in either direction."""
        return tuple(sorted({(min(link), max(link)) for link in self.directed}))

    def neighbours(self, robot: int) -> list[int]:
        """Whom the robot hears, in the team's order."""
        return sorted(sender for sender, receiver in self.directed if receiver == robot)

    def receivers(self, robot: int) -> list[int]:
        """Who hears the robot, in the team's order."""
        return sorted(receiver for sender, receiver in self.directed if sender == robot)

    def degree(self, robot: int) -> int:
        """The number of robots that the robot hears."""
        return len(self.neighbours(robot))


def team_graph(
    network: NetworkConfig,
    consensus: ConsensusConfig,
    robot_ids: Sequence[str],
    active: Sequence[bool],
    elapsed_s: float = 0.0,
    history: Sequence[Sequence[Sequence[float] | None]] = (),
) -> TeamGraph:
    """The graph that the topology induces on the active robots at a time of the schedule, weighted anew.

    ``history`` holds, tick by tick up to this one, each robot's position or None where it is not there.

    Raises ConfigError when the step size is not below the bound of this graph (only the rules with a step size have
    one), or when given weights have a row sum above 1.
    """
    directed = directed_links(network, robot_ids, active, elapsed_s, history)
    weights = link_weights(network, directed, robot_ids)
    epsilon = step_size(consensus, network, weights)
    if consensus.rule in ("gradient", "bayes", "natural"):
        check_step_size(epsilon, weights)
    return TeamGraph(directed, weights, epsilon)


def directed_links(
    network: NetworkConfig,
    robot_ids: Sequence[str],
    active: Sequence[bool],
    elapsed_s: float = 0.0,
    history: Sequence[Sequence[Sequence[float] | None]] = (),
) -> tuple[Link, ...]:
    """Every (sender, receiver), sorted: the topology's, less one-way pairs, then as the schedule says."""
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
    """Whether an entry keeps what a says from b."""
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
    """The robots nearest to one, the lower index first among equals."""
    here = positions[robot]
    if here is None:
        return []
    others = [
        (math.dist(here, there), other) for other, there in enumerate(positions) if other != robot and there is not None
    ]
    return [other for _, other in sorted(others)[:most]]


def _in_range(pair: Link, history: Sequence[Sequence[Sequence[float] | None]], network: NetworkConfig) -> bool:
    """Going back from now: whether the two came near before they were last too far apart, or not both there."""
    for positions in reversed(history):
        here, there = positions[pair[0]], positions[pair[1]]
        if here is None or there is None or math.dist(here, there) > network.radio_range + network.range_hysteresis:
            return False
        if math.dist(here, there) < network.radio_range:
            return True
    return False


def link_weights(network: NetworkConfig, directed: Sequence[Link], robot_ids: Sequence[str]) -> Float64Array:
    """A (N, N), with degree_i the number of robots that i hears: Metropolis 1 / (1 + max(degree_i, degree_j)),
    1 / degree_i, 1 / (1 + the largest degree), or the edge list's (both directions)."""
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
    """L = diag(row sums of A off the diagonal) - A."""
    return np.diag(weights.sum(axis=1)) - weights


def step_size(consensus: ConsensusConfig, network: NetworkConfig, weights: Float64Array) -> float:
    """epsilon as configured; by default 0.5 with Metropolis and max-degree weights, else min(0.5, 0.9 x the bound)."""
    if consensus.epsilon is not None:
        return consensus.epsilon
    if network.weights in ("metropolis", "max-degree"):
        return 0.5
    return min(0.5, 0.9 * step_size_bound(weights))


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


def simulated_bound(weights: Float64Array, num_steps: int = 1 << 17) -> float:
    """The epsilon below which consensus converges, by running it: bisection between 0.4 and 10 on what happens to the
    differences L h in so many steps."""
    matrix = laplacian(weights)
    low, high = 0.4, 10.0
    for _ in range(20):
        epsilon = (low + high) / 2.0
        power = np.eye(len(weights)) - 2.0 * epsilon * matrix
        log_scale = 0.0
        for _ in range(num_steps.bit_length() - 1):
            power = power @ power
            scale = max(1e-300, float(np.abs(power).max()))  # kept apart, so that nothing overflows
            power, log_scale = power / scale, 2.0 * log_scale + math.log(scale)
        shrinks = log_scale + math.log(max(1e-300, float(np.abs(matrix @ power).max()))) < 0.0
        low, high = (epsilon, high) if shrinks else (low, epsilon)
    return low


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
