from __future__ import annotations

import itertools
import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from octoreplay.config import ConsensusConfig, NetworkConfig
from octoreplay.errors import ConfigError
from octoreplay.replay.graph import build_graph, check_team_graph, settle_ticks_max, step_size
from reference import graph as reference

NAMES = ("husky_1", "husky_2", "husky_3", "husky_4", "husky_5", "husky_6", "husky_7")


def _build(num_robots, topology="complete", active=None, **network):
    active = [True] * num_robots if active is None else active
    return build_graph(NetworkConfig(topology=topology, **network), NAMES[:num_robots], active)


def _edges(*pairs, weights=None):
    weights = weights or [None] * len(pairs)
    return tuple((NAMES[i], NAMES[j], weight) for (i, j), weight in zip(pairs, weights, strict=True))


# --- by hand ---------------------------------------------------------------------------------------------------------


def test_topologies():
    assert _build(4, "complete").links == ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
    assert _build(4, "ring").links == ((0, 1), (0, 3), (1, 2), (2, 3))
    assert _build(4, "line").links == ((0, 1), (1, 2), (2, 3))
    assert _build(4, "star").links == ((0, 1), (0, 2), (0, 3))
    assert _build(4, "edges", edges=_edges((3, 1), (0, 2))).links == ((0, 2), (1, 3))


@pytest.mark.parametrize("topology", ["complete", "ring", "line", "star"])
def test_one_robot_has_no_link_and_two_have_one(topology):
    alone, pair = _build(1, topology), _build(2, topology)
    assert alone.links == ()
    assert alone.weights.tolist() == [[0.0]]
    assert alone.neighbours(0) == ()
    assert pair.links == ((0, 1),)
    assert pair.weights.tolist() == [[0.0, 0.5], [0.5, 0.0]]


def test_an_edge_that_is_listed_twice_is_one_link_and_the_later_weight_counts():
    edges = _edges((0, 1), (1, 2), (1, 0), weights=[0.9, 0.25, 0.5])
    graph = _build(3, "edges", edges=edges, weights="given")
    assert graph.links == ((0, 1), (1, 2))
    assert graph.weights.tolist() == [[0.0, 0.5, 0.0], [0.5, 0.0, 0.25], [0.0, 0.25, 0.0]]
    assert graph.degree(1) == 2


def test_a_link_of_weight_zero_is_a_link():
    graph = _build(2, "edges", edges=_edges((0, 1), weights=[0.0]), weights="given")
    assert graph.links == ((0, 1),)
    assert graph.neighbours(1) == (0,)
    assert graph.lambda_max == 0.0
    assert step_size(graph, ConsensusConfig()) == 0.5


def test_links_stand_among_active_robots_only():
    ring = _build(5, "ring", active=[True, True, False, True, True])
    assert ring.active == (0, 1, 3, 4)
    assert ring.links == ((0, 1), (0, 4), (3, 4))
    assert ring.neighbours(0) == (1, 4)
    assert [ring.degree(i) for i in range(5)] == [2, 1, 0, 1, 2]
    assert ring.weights[2].tolist() == ring.weights[:, 2].tolist() == [0.0] * 5
    assert _build(4, "line", active=[True, False, True, True]).links == ((2, 3),)
    assert _build(4, "star", active=[False, True, True, True]).links == ()
    assert _build(4, "star", active=[True, False, True, True]).links == ((0, 2), (0, 3))
    nobody = _build(3, active=[False] * 3)
    assert (nobody.active, nobody.links, nobody.lambda_max, nobody.epsilon_bound) == ((), (), 0.0, math.inf)


def test_metropolis_weights_follow_the_degrees_of_the_tick():
    star = _build(4, "star")
    assert star.weights.tolist() == [[0.0, 0.25, 0.25, 0.25], [0.25, 0, 0, 0], [0.25, 0, 0, 0], [0.25, 0, 0, 0]]
    fewer = _build(4, "star", active=[True, True, True, False])
    assert fewer.weights[0].tolist() == [0.0, 1 / 3, 1 / 3, 0.0]


def test_degree_weights_are_not_symmetric():
    star = _build(3, "star", weights="degree")
    assert star.weights.tolist() == [[0.0, 0.5, 0.5], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    assert star.laplacian.tolist() == [[1.0, -0.5, -0.5], [-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]]
    # eigenvalues 0, 1 and 2
    assert star.lambda_max == pytest.approx(2.0)
    assert star.epsilon_bound == pytest.approx(0.5)
    assert star.lambda_2(0.25) == pytest.approx(0.5)


def test_eigenvalues_of_a_ring_of_four():
    ring = _build(4, "ring")  # A = 1/3 on links: 0, 2/3, 2/3, 4/3
    assert ring.lambda_max == pytest.approx(4 / 3)
    assert ring.epsilon_bound == pytest.approx(0.75)
    assert ring.lambda_2(0.5) == pytest.approx(1 / 3)
    assert ring.lambda_2(0.1) == pytest.approx(1 - 0.2 * 2 / 3)


def test_one_step_on_a_complete_graph_with_defaults_is_the_exact_mean():
    graph = _build(6)
    epsilon = step_size(graph, ConsensusConfig())
    assert epsilon == 0.5
    np.testing.assert_allclose(np.eye(6) - 2 * epsilon * graph.laplacian, np.full((6, 6), 1 / 6), atol=1e-15)
    assert settle_ticks_max(graph, ConsensusConfig(), epsilon) == 21


def test_default_step_size_of_other_weights():
    assert step_size(_build(3, "star", weights="degree"), ConsensusConfig()) == pytest.approx(0.45)
    light = _build(2, "edges", edges=_edges((0, 1), weights=[0.1]), weights="given")
    assert step_size(light, ConsensusConfig()) == 0.5
    assert step_size(_build(1, weights="degree"), ConsensusConfig()) == 0.5


def test_settle_ticks_max():
    graph = _build(4, "ring")
    # lambda_2 = 1/3: 12 / log10(3) = 25.15
    assert settle_ticks_max(graph, ConsensusConfig(settle=7), 0.5) == 7 + 26
    assert settle_ticks_max(graph, ConsensusConfig(settle=7, settle_max=3), 0.5) == 3
    assert settle_ticks_max(graph, ConsensusConfig(settle=0), 0.5) == 0
    assert settle_ticks_max(graph, ConsensusConfig(settle=0, settle_max=3), 0.5) == 0
    assert settle_ticks_max(_build(1), ConsensusConfig(), 0.5) == 21


def test_arrays_cannot_be_written():
    graph = _build(3)
    for array in (graph.weights, graph.laplacian):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 1] = 2.0


def test_every_robot_needs_an_activity():
    with pytest.raises(ValueError, match="shorter"):
        _build(3, active=[True, True])


# --- errors ----------------------------------------------------------------------------------------------------------


def test_a_step_size_at_the_bound_is_refused_with_the_bound_and_the_remedy():
    ring = _build(5, "ring", weights="degree", active=[True, True, True, True, False])  # a line: eigenvalues up to 2
    assert step_size(ring, ConsensusConfig(epsilon=0.499)) == 0.499
    with pytest.raises(ConfigError) as caught:
        step_size(ring, ConsensusConfig(epsilon=0.5))
    assert str(caught.value) == (
        "epsilon: 0.5 is not below 0.5, the bound of this graph (topology 'ring', 4 of 5 robots active, weights"
        " 'degree'); use 0.45 or leave epsilon out"
    )


def test_the_rule_local_has_no_bound():
    assert step_size(_build(3), ConsensusConfig(epsilon=50.0, rule="local")) == 50.0


def test_the_whole_team_is_checked_before_a_run():
    check_team_graph(NetworkConfig(), ConsensusConfig(epsilon=0.99), NAMES)
    with pytest.raises(ConfigError, match="7 of 7 robots active"):
        check_team_graph(NetworkConfig(), ConsensusConfig(epsilon=1.0), NAMES)


def test_a_part_of_the_team_can_have_a_lower_bound():
    network, consensus = NetworkConfig(weights="degree"), ConsensusConfig(epsilon=0.6)
    check_team_graph(network, consensus, NAMES[:3])
    with pytest.raises(ConfigError, match=r"below 0\.5, the bound .* 2 of 3 robots active"):
        step_size(build_graph(network, NAMES[:3], [True, False, True]), consensus)


@pytest.mark.parametrize("rule", ["gradient", "local"])
def test_row_sums_above_one_are_refused(rule):
    full = NetworkConfig(topology="edges", weights="given", edges=_edges((0, 1), (1, 2), weights=[0.6, 0.4]))
    check_team_graph(full, ConsensusConfig(), NAMES[:3])
    above = NetworkConfig(topology="edges", weights="given", edges=_edges((0, 1), (1, 2), weights=[0.7, 0.5]))
    with pytest.raises(ConfigError, match=r"edges: the weights of robot 'husky_2' sum to 1\.2; lower them to at most"):
        check_team_graph(above, ConsensusConfig(rule=rule), NAMES[:3])
    build_graph(above, NAMES[:3], [True, True, False])


@pytest.mark.parametrize("weight", [math.nan, math.inf])
def test_weights_that_are_no_numbers_are_refused(weight):
    with pytest.raises(ConfigError, match="husky_1"):
        _build(2, "edges", edges=_edges((0, 1), weights=[weight]), weights="given")


# --- properties ------------------------------------------------------------------------------------------------------


@st.composite
def _networks(draw):
    """A team's size and a network of any topology and weights; given weights may sum to more than 1."""
    num_robots = draw(st.integers(1, 7))
    topologies = ["complete", "ring", "line", "star"] + (["edges"] if num_robots > 1 else [])
    topology = draw(st.sampled_from(topologies))
    if topology != "edges":
        weights = draw(st.sampled_from(["metropolis", "degree"]))
        return num_robots, NetworkConfig(topology=topology, weights=weights)
    weights = draw(st.sampled_from(["metropolis", "degree", "given"]))
    value = st.floats(0.02, 1.1 / (num_robots - 1)) if weights == "given" else st.none()
    pair = st.sampled_from(list(itertools.permutations(NAMES[:num_robots], 2)))  # either order, repeats included
    edges = draw(st.lists(st.tuples(pair, value).map(lambda edge: (*edge[0], edge[1])), min_size=1, max_size=12))
    return num_robots, NetworkConfig(topology=topology, weights=weights, edges=tuple(edges))


@st.composite
def _ticks(draw):
    """A network with an activity of each robot; most robots are active."""
    num_robots, network = draw(_networks())
    return network, NAMES[:num_robots], draw(
        st.lists(st.sampled_from([True, True, False]), min_size=num_robots, max_size=num_robots)
    )  # fmt: skip


@given(
    _ticks(),
    st.none() | st.floats(0.05, 1.2),
    st.sampled_from(["gradient", "local"]),
    st.integers(1, 30),
)
def test_every_graph_is_that_of_the_reference(tick, epsilon, rule, settle):
    network, robot_ids, active = tick
    consensus = ConsensusConfig(epsilon=epsilon, rule=rule, settle=settle)
    try:
        expected = reference.team_graph(network, consensus, robot_ids, active)
    except ConfigError:
        with pytest.raises(ConfigError):
            step_size(build_graph(network, robot_ids, active), consensus)
        return
    graph = build_graph(network, robot_ids, active)
    assert graph.robot_ids == robot_ids
    assert graph.active == tuple(i for i, is_active in enumerate(active) if is_active)
    assert graph.links == expected.links
    np.testing.assert_array_equal(graph.weights, expected.weights)
    for robot in range(len(robot_ids)):
        assert graph.neighbours(robot) == tuple(expected.neighbours(robot))
        assert graph.degree(robot) == expected.degree(robot)
    np.testing.assert_array_equal(graph.laplacian, reference.laplacian(expected.weights))
    assert step_size(graph, consensus) == expected.epsilon
    assert graph.epsilon_bound == pytest.approx(reference.step_size_bound(expected.weights), rel=1e-9)
    lambda_2 = reference.second_eigenvalue(expected)
    assert graph.lambda_2(expected.epsilon) == pytest.approx(lambda_2, rel=1e-12, abs=1e-14)
    most = reference.default_settle_max(settle, lambda_2)
    assert settle_ticks_max(graph, consensus, expected.epsilon) == most


@given(_networks(), st.sampled_from(["gradient", "local"]), st.none() | st.floats(0.05, 1.2))
def test_the_check_before_a_run_is_the_reference_on_the_whole_team(shape, rule, epsilon):
    num_robots, network = shape
    robot_ids, consensus = NAMES[:num_robots], ConsensusConfig(epsilon=epsilon, rule=rule)
    try:
        reference.team_graph(network, consensus, robot_ids, [True] * num_robots)
    except ConfigError:
        with pytest.raises(ConfigError):
            check_team_graph(network, consensus, robot_ids)
    else:
        check_team_graph(network, consensus, robot_ids)


@given(_ticks())
def test_consensus_converges_below_the_bound_and_diverges_above(tick):
    network, robot_ids, active = tick
    try:
        graph = build_graph(network, robot_ids, active)
    except ConfigError:
        assume(False)
    assume(graph.links)
    num_robots = len(robot_ids)
    inside = np.eye(num_robots) - 2 * 0.95 * graph.epsilon_bound * graph.laplacian
    beyond = np.eye(num_robots) - 2 * 1.05 * graph.epsilon_bound * graph.laplacian
    assert np.abs(graph.laplacian @ np.linalg.matrix_power(inside, 16384)).max() < 1e-6
    assert np.abs(graph.laplacian @ np.linalg.matrix_power(beyond, 1024)).max() > 1e6
    assert graph.lambda_2(0.95 * graph.epsilon_bound) < 1.0 < graph.lambda_2(1.05 * graph.epsilon_bound)


@given(_ticks())
def test_the_default_step_size_is_stable_on_every_graph(tick):
    network, robot_ids, active = tick
    try:
        graph = build_graph(network, robot_ids, active)
    except ConfigError:
        assume(False)
    assert graph.lambda_2(step_size(graph, ConsensusConfig())) < 1.0


def test_importing_the_module_leaves_networkx_out():
    code = "import sys, octoreplay.replay.graph; print('networkx' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
