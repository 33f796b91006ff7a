"""Random communication graphs against the reference twin and the theory of consensus."""

from __future__ import annotations

import itertools

import networkx as nx
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from octoreplay.config.consensus import ConsensusConfig
from octoreplay.config.network import NetworkConfig, ScheduleEntry
from octoreplay.errors import ConfigError
from octoreplay.replay.network.graph import TeamNetwork, check_team_graph, step_size
from octoreplay.replay.settling import settle_ticks_max
from reference import graph as reference
from support.long_suite import examples
from support.team_graphs import NAMES, directed, nowhere


@st.composite
def _networks(draw):
    """A team's size and a network without positions; given weights may sum to more than 1."""
    num_robots = draw(st.integers(1, 7))
    names = NAMES[:num_robots]
    weights = draw(st.sampled_from(["metropolis", "degree", "max-degree", "given"]))
    topology = draw(st.sampled_from(["complete", "ring", "line", "star", "grid", "random", "edges"]))
    network = {"weights": weights, "topology": topology, "network_seed": draw(st.integers(0, 99))}
    if num_robots == 1:
        return num_robots, NetworkConfig(topology="ring")
    pair = st.sampled_from(list(itertools.permutations(names, 2)))  # either order, repeats included
    if topology == "edges" or weights == "given":
        value = st.floats(0.02, 1.1 / (num_robots - 1)) if weights == "given" else st.none()
        edges = draw(st.lists(st.tuples(pair, value).map(lambda edge: (*edge[0], edge[1])), min_size=1, max_size=12))
        network |= {"topology": "edges", "edges": tuple(edges)}
    one_way = draw(st.lists(pair, max_size=4, unique_by=frozenset))
    some = st.lists(st.sampled_from(names), max_size=2, unique=True).map(tuple)
    split, order = draw(st.integers(0, num_robots - 1)), draw(st.permutations(names))
    listed = [edge[:2] for edge in network.get("edges", ())]
    schedule = (
        ScheduleEntry(10.0, 20.0, robots_silent=draw(some), links_down=draw(st.lists(pair, max_size=1).map(tuple))),
        ScheduleEntry(15.0, 25.0, groups=(tuple(order[:split]), tuple(order[split:])) if split else ()),
        ScheduleEntry(30.0, links_up=(draw(st.sampled_from(listed) if weights == "given" else pair),)),
        ScheduleEntry(35.0, 40.0, robots_off=draw(some)),
    )
    said = tuple(
        entry for entry in schedule
        if entry.groups or entry.links_down or entry.links_up or entry.robots_off or entry.robots_silent
    )  # fmt: skip
    return num_robots, NetworkConfig(**network, one_way=tuple(one_way), schedule=said)


@st.composite
def _ticks(draw):
    """A network, the names, an activity of each robot (most are active), and a time."""
    num_robots, network = draw(_networks())
    active = draw(st.lists(st.sampled_from([True, True, False]), min_size=num_robots, max_size=num_robots))
    return network, NAMES[:num_robots], active, draw(st.sampled_from([0.0, 10.0, 17.0, 20.0, 24.9, 25.0, 30.0, 35.0]))


def _graph(tick, consensus=None):
    network, robot_ids, active, elapsed_s = tick
    try:
        return TeamNetwork(network, consensus or ConsensusConfig(), robot_ids).at(
            elapsed_s, active, nowhere(len(active))
        )
    except ConfigError:
        assume(False)


@examples(100)
@given(
    _ticks(),
    st.none() | st.floats(0.05, 1.2),
    st.sampled_from(["gradient", "bayes", "local", "flood", "weighted"]),
    st.integers(1, 30),
)
def test_every_graph_equals_the_reference(tick, epsilon, rule, settle):
    network, robot_ids, active, elapsed_s = tick
    consensus = ConsensusConfig(epsilon=epsilon, rule=rule, settle=settle)
    try:
        team = TeamNetwork(network, consensus, robot_ids)
    except ConfigError as error:
        assume("two entries" not in str(error))  # a link down that the groups cut, too
        raise
    try:
        expected = reference.team_graph(network, consensus, robot_ids, active, elapsed_s)
    except ConfigError:
        with pytest.raises(ConfigError):
            team.at(elapsed_s, active, nowhere(len(active)))
        return
    graph = team.at(elapsed_s, active, nowhere(len(active)))
    off = team.schedule.at(elapsed_s).robots_off
    assert graph.robot_ids == robot_ids
    assert graph.active == tuple(i for i, is_active in enumerate(active) if is_active and not off[i])
    assert graph.links == expected.directed
    assert graph.pairs == expected.links
    np.testing.assert_array_equal(graph.weights, expected.weights)
    for robot in range(len(robot_ids)):
        assert graph.senders(robot) == tuple(expected.neighbours(robot))
        assert graph.receivers(robot) == tuple(expected.receivers(robot))
        assert graph.degree(robot) == expected.degree(robot)
    both_ways = {(b, a) for a, b in expected.directed} == set(expected.directed)
    assert graph.is_symmetric == (both_ways and bool((expected.weights == expected.weights.T).all()))
    np.testing.assert_array_equal(graph.laplacian, reference.laplacian(expected.weights))
    assert step_size(graph, consensus) == pytest.approx(expected.epsilon, rel=1e-9)
    assert graph.epsilon_bound == pytest.approx(reference.step_size_bound(expected.weights), rel=1e-6)
    lambda_2 = reference.second_eigenvalue(expected)
    assert graph.lambda_2(expected.epsilon) == pytest.approx(lambda_2, rel=1e-12, abs=1e-14)
    rate = reference.second_eigenvalue(expected, 0.5) if rule == "weighted" else lambda_2
    most = reference.default_settle_max(settle, rate)
    assert settle_ticks_max(graph, consensus, expected.epsilon) == most


@examples(100)
@given(_networks(), st.sampled_from(["gradient", "local"]), st.none() | st.floats(0.05, 1.2))
def test_the_check_before_a_run_equals_the_reference_at_all_times(shape, rule, epsilon):
    num_robots, network = shape
    robot_ids, consensus = NAMES[:num_robots], ConsensusConfig(epsilon=epsilon, rule=rule)
    try:
        for elapsed_s in (0.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0):
            reference.team_graph(network, consensus, robot_ids, [True] * num_robots, elapsed_s)
    except ConfigError:
        with pytest.raises(ConfigError):
            check_team_graph(network, consensus, robot_ids)
        return
    try:
        check_team_graph(network, consensus, robot_ids)
    except ConfigError as error:
        assume("two entries" not in str(error))
        raise


@examples(100)
@given(_ticks())
def test_row_sums_are_at_most_one_and_only_links_have_weights(tick):
    graph = _graph(tick)
    assert (graph.weights >= 0).all()
    assert (graph.weights.sum(axis=1) <= 1 + 1e-9).all()
    receivers_and_senders = {(int(i), int(j)) for i, j in np.argwhere(graph.weights)}
    assert receivers_and_senders == {(receiver, sender) for sender, receiver in graph.links}


@examples(100)
@given(_ticks())
def test_consensus_converges_below_the_bound_and_diverges_above(tick):
    graph = _graph(tick)
    assume(graph.links)
    identity = np.eye(len(graph.robot_ids))
    inside = identity - 2 * 0.95 * graph.epsilon_bound * graph.laplacian
    beyond = identity - 2 * 1.05 * graph.epsilon_bound * graph.laplacian
    assert np.abs(graph.laplacian @ np.linalg.matrix_power(inside, 16384)).max() < 1e-6
    assert np.abs(graph.laplacian @ np.linalg.matrix_power(beyond, 4096)).max() > 1e6
    assert graph.lambda_2(0.95 * graph.epsilon_bound) < 1.0 < graph.lambda_2(1.05 * graph.epsilon_bound)


@examples(100)
@given(
    st.integers(2, 7).flatmap(
        lambda n: st.tuples(
            st.just(n), st.lists(st.sampled_from(list(itertools.permutations(range(n), 2))), min_size=1)
        )
    ),
    st.sampled_from(["metropolis", "degree", "max-degree"]),
)
def test_no_bound_of_a_directed_graph_is_below_one_half_and_a_simulation_finds_it(links, weights):
    graph = directed(links[0], *links[1], weights=weights)
    assert graph.epsilon_bound >= 0.5
    assert graph.epsilon_bound == pytest.approx(reference.simulated_bound(graph.weights), rel=2e-3)
    assert graph.lambda_2(step_size(graph, ConsensusConfig())) < 1.0


@examples(100)
@given(_ticks())
def test_the_default_step_size_is_stable_on_every_graph(tick):
    graph = _graph(tick)
    assert graph.lambda_2(step_size(graph, ConsensusConfig())) < 1.0


@examples(100)
@given(_ticks())
def test_a_partition_leaves_the_links_within_groups(tick):
    network, robot_ids, active, _ = tick
    whole = NetworkConfig(topology="random", prob_link=0.7, network_seed=network.network_seed)
    cuts = (robot_ids[::2], robot_ids[1::2]) if len(robot_ids) > 1 else ()
    schedule = (ScheduleEntry(1.0, groups=cuts),) if cuts else ()
    split = NetworkConfig(topology="random", prob_link=0.7, network_seed=network.network_seed, schedule=schedule)
    before = nx.Graph(TeamNetwork(whole, ConsensusConfig(), robot_ids).at(9.0, active, nowhere(len(active))).pairs)
    after = nx.Graph(TeamNetwork(split, ConsensusConfig(), robot_ids).at(9.0, active, nowhere(len(active))).pairs)
    groups = [before.subgraph(i for i in range(len(robot_ids)) if i % 2 == side) for side in (0, 1)]
    expected = [part for group in groups for part in nx.connected_components(group) if len(part) > 1]
    assert sorted(map(sorted, nx.connected_components(after))) == sorted(map(sorted, expected))
