from __future__ import annotations

import itertools
import math
import subprocess
import sys

import networkx as nx
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from octoreplay.config.consensus import ConsensusConfig
from octoreplay.config.network import NetworkConfig, ScheduleEntry
from octoreplay.errors import ConfigError
from octoreplay.replay.network.graph import TeamNetwork, build_graph, check_team_graph, step_size
from octoreplay.replay.settling import settle_ticks_max
from reference import graph as reference

NAMES = ("husky_1", "husky_2", "husky_3", "husky_4", "husky_5", "husky_6", "husky_7")


def _nowhere(num_robots):
    return np.full((num_robots, 3), np.nan)


def _team(num_robots, topology="complete", consensus=None, **network):
    config = NetworkConfig(topology=topology, **network)
    return TeamNetwork(config, consensus or ConsensusConfig(), NAMES[:num_robots])


def _build(num_robots, topology="complete", active=None, elapsed_s=0.0, **network):
    active = [True] * num_robots if active is None else active
    return _team(num_robots, topology, **network).at(elapsed_s, active, _nowhere(num_robots))


def _directed(num_robots, *links, weights="metropolis"):
    """The graph of directed links (sender, receiver)."""
    hears = np.zeros((num_robots, num_robots), bool)
    for sender, receiver in links:
        hears[receiver, sender] = True
    return build_graph(NetworkConfig(weights=weights), NAMES[:num_robots], [True] * num_robots, hears)


def _edges(*pairs, weights=None):
    weights = weights or [None] * len(pairs)
    return tuple((NAMES[i], NAMES[j], weight) for (i, j), weight in zip(pairs, weights, strict=True))


def _name(*pairs):
    return tuple((NAMES[i], NAMES[j]) for i, j in pairs)


# --- links, by hand --------------------------------------------------------------------------------------------------


def test_an_undirected_link_is_two_directed_ones():
    graph = _build(4, "line")
    assert graph.links == ((0, 1), (1, 0), (1, 2), (2, 1), (2, 3), (3, 2))
    assert graph.pairs == ((0, 1), (1, 2), (2, 3))
    assert graph.senders(1) == graph.receivers(1) == (0, 2)
    assert graph.is_symmetric


@pytest.mark.parametrize("topology", ["complete", "ring", "line", "star", "grid"])
def test_one_robot_has_no_link_and_two_have_one(topology):
    alone, pair = _build(1, topology), _build(2, topology)
    assert (alone.links, alone.pairs, alone.senders(0), alone.receivers(0)) == ((), (), (), ())
    assert alone.weights.tolist() == [[0.0]]
    assert pair.pairs == ((0, 1),)
    assert pair.weights.tolist() == [[0.0, 0.5], [0.5, 0.0]]


def test_links_stand_among_active_robots_only():
    ring = _build(5, "ring", active=[True, True, False, True, True])
    assert ring.active == (0, 1, 3, 4)
    assert ring.pairs == ((0, 1), (0, 4), (3, 4))
    assert ring.senders(0) == (1, 4)
    assert [ring.degree(i) for i in range(5)] == [2, 1, 0, 1, 2]
    assert ring.weights[2].tolist() == ring.weights[:, 2].tolist() == [0.0] * 5
    assert _build(4, "line", active=[True, False, True, True]).pairs == ((2, 3),)
    assert _build(4, "star", active=[False, True, True, True]).pairs == ()
    assert _build(4, "star", active=[True, False, True, True]).pairs == ((0, 2), (0, 3))
    nobody = _build(3, active=[False] * 3)
    assert (nobody.active, nobody.links, nobody.lambda_max, nobody.epsilon_bound) == ((), (), 0.0, math.inf)
    assert nobody.is_symmetric


def test_a_one_way_pair_carries_from_the_first_to_the_second():
    graph = _build(3, "line", one_way=_name((1, 0)))
    assert graph.links == ((1, 0), (1, 2), (2, 1))
    assert graph.pairs == ((0, 1), (1, 2))
    assert (graph.senders(0), graph.receivers(0), graph.degree(0)) == ((1,), (), 1)
    assert (graph.senders(1), graph.receivers(1), graph.degree(1)) == ((2,), (0, 2), 1)
    assert not graph.is_symmetric
    # A one-way pair without a link is none.
    assert _build(3, "line", one_way=_name((0, 2))).pairs == ((0, 1), (1, 2))


def test_the_schedule_takes_links_down_and_brings_them_up():
    schedule = (
        ScheduleEntry(10.0, 20.0, links_down=_name((1, 0)), links_up=_name((3, 0))),
        ScheduleEntry(20.0, 30.0, groups=((NAMES[0], NAMES[1]), (NAMES[2],))),
    )
    team = _team(4, "line", schedule=schedule)
    seen = [team.at(t, [True] * 4, _nowhere(4)).pairs for t in (0.0, 9.9, 10.0, 19.9, 20.0, 30.0)]
    line = ((0, 1), (1, 2), (2, 3))
    assert seen == [line, line, ((0, 3), (1, 2), (2, 3)), ((0, 3), (1, 2), (2, 3)), ((0, 1), (2, 3)), line]
    dormant = _team(4, "line", schedule=schedule).at(10.0, [True, True, True, False], _nowhere(4))
    assert dormant.pairs == ((1, 2),)


def test_the_schedule_has_the_last_word_about_one_way_pairs():
    schedule = (ScheduleEntry(10.0, 20.0, links_up=_name((0, 1))),)
    team = _team(2, one_way=_name((0, 1)), schedule=schedule)
    seen = [team.at(t, [True] * 2, _nowhere(2)).links for t in (0.0, 10.0, 20.0)]
    assert seen == [((0, 1),), ((0, 1), (1, 0)), ((0, 1),)]


def test_robots_that_are_off_take_no_part_and_silent_ones_hear():
    schedule = (
        ScheduleEntry(5.0, 6.0, robots_off=NAMES[1:2], links_up=_name((1, 3)), forget=True),
        ScheduleEntry(6.0, 7.0, robots_silent=NAMES[1:2]),
    )
    team = _team(4, "ring", schedule=schedule)
    off = team.at(5.0, [True] * 4, _nowhere(4))
    assert (off.active, off.pairs) == ((0, 2, 3), ((0, 3), (2, 3)))
    silent = team.at(6.0, [True] * 4, _nowhere(4))
    assert silent.active == (0, 1, 2, 3)
    assert (silent.senders(1), silent.receivers(1)) == ((0, 2), ())
    assert (silent.senders(0), silent.receivers(0)) == ((3,), (1, 3))
    assert silent.weights[:, 1].tolist() == [0.0] * 4


def test_robots_that_are_off_are_nobodys_nearest():
    schedule = (ScheduleEntry(5.0, 6.0, robots_off=NAMES[1:2]),)
    team = _team(3, "nearest", num_nearest=1, schedule=schedule)
    positions = np.array([(0.0, 0, 0), (1, 0, 0), (2, 0, 0)])
    assert team.at(0.0, [True] * 3, positions).pairs == ((0, 1), (1, 2))
    assert team.at(5.0, [True] * 3, positions).pairs == ((0, 2),)


def test_the_same_graph_comes_back_until_something_changes():
    team = _team(3, "range", radio_range=10.0, schedule=(ScheduleEntry(3.0, 4.0, links_down=_name((0, 1))),))
    near = np.array([(0.0, 0, 0), (1, 0, 0), (2, 0, 0)])
    first = team.at(0.0, [True] * 3, near)
    assert team.at(1.0, [True] * 3, near + 0.5) is first
    assert team.at(2.0, np.array([True] * 3), near * 2) is first
    cut = team.at(3.0, [True] * 3, near)
    assert cut is not first
    assert team.at(3.5, [True] * 3, near) is cut
    far = team.at(4.0, [True] * 3, near * [[1], [1], [20]])
    assert far.pairs == ((0, 1),)
    # The same links, but somebody without any went to sleep.
    assert team.at(5.0, [True, True, False], near).active == (0, 1)


def test_every_robot_needs_an_activity():
    with pytest.raises(ValueError, match="shapes"):
        _build(3, active=[True, True])
    with pytest.raises(ValueError, match="shorter"):
        build_graph(NetworkConfig(), NAMES[:3], [True, True], np.zeros((3, 3), bool))


# --- weights and steps, by hand --------------------------------------------------------------------------------------


def test_an_edge_that_is_listed_twice_is_one_link_and_the_later_weight_counts():
    edges = _edges((0, 1), (1, 2), (1, 0), weights=[0.9, 0.25, 0.5])
    graph = _build(3, "edges", edges=edges, weights="given")
    assert graph.pairs == ((0, 1), (1, 2))
    assert graph.weights.tolist() == [[0.0, 0.5, 0.0], [0.5, 0.0, 0.25], [0.0, 0.25, 0.0]]
    assert graph.degree(1) == 2


def test_a_link_of_weight_zero_is_a_link():
    graph = _build(2, "edges", edges=_edges((0, 1), weights=[0.0]), weights="given")
    assert graph.links == ((0, 1), (1, 0))
    assert graph.senders(1) == (0,)
    assert graph.lambda_max == 0.0
    assert step_size(graph, ConsensusConfig()) == 0.5


def test_metropolis_weights_follow_the_degrees_of_the_tick():
    star = _build(4, "star")
    assert star.weights.tolist() == [[0.0, 0.25, 0.25, 0.25], [0.25, 0, 0, 0], [0.25, 0, 0, 0], [0.25, 0, 0, 0]]
    fewer = _build(4, "star", active=[True, True, True, False])
    assert fewer.weights[0].tolist() == [0.0, 1 / 3, 1 / 3, 0.0]


def test_max_degree_weights_are_all_the_same():
    graph = _build(4, "line", weights="max-degree")
    assert graph.weights.tolist() == [[0, 1 / 3, 0, 0], [1 / 3, 0, 1 / 3, 0], [0, 1 / 3, 0, 1 / 3], [0, 0, 1 / 3, 0]]
    assert graph.is_symmetric
    assert _build(2, weights="max-degree").weights[0, 1] == 0.5
    assert _build(1, weights="max-degree").weights.tolist() == [[0.0]]


def test_degree_weights_are_not_symmetric():
    star = _build(3, "star", weights="degree")
    assert star.weights.tolist() == [[0.0, 0.5, 0.5], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    assert not star.is_symmetric
    assert _build(3, weights="degree").is_symmetric
    assert star.laplacian.tolist() == [[1.0, -0.5, -0.5], [-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]]
    # eigenvalues 0, 1 and 2
    assert star.lambda_max == pytest.approx(2.0)
    assert star.epsilon_bound == pytest.approx(0.5)
    assert star.lambda_2(0.25) == pytest.approx(0.5)


def test_degrees_of_one_way_links_are_those_of_the_receivers():
    links = ((0, 1), (2, 1), (3, 1), (1, 0))
    # Robot 1 hears three, robot 0 one.
    metropolis = _directed(4, *links)
    assert metropolis.weights.tolist() == [[0, 0.25, 0, 0], [0.25, 0, 0.25, 0.25], [0] * 4, [0] * 4]
    assert not metropolis.is_symmetric
    degree = _directed(4, *links, weights="degree")
    assert degree.weights.tolist() == [[0, 1, 0, 0], [1 / 3, 0, 1 / 3, 1 / 3], [0] * 4, [0] * 4]
    largest = _directed(4, *links, weights="max-degree")
    assert largest.weights.tolist() == metropolis.weights.tolist()


def test_given_weights_hold_in_the_direction_that_is_left():
    edges = _edges((0, 1), (1, 2), weights=[0.9, 0.4])
    # Both ways robot 1 would give 1.3.
    graph = _build(3, "edges", edges=edges, weights="given", one_way=_name((1, 0)))
    assert graph.weights.tolist() == [[0, 0.9, 0], [0, 0, 0.4], [0, 0.4, 0]]


def test_eigenvalues_of_a_ring_of_four():
    ring = _build(4, "ring")  # A = 1/3 on links: 0, 2/3, 2/3, 4/3
    assert ring.lambda_max == pytest.approx(4 / 3)
    assert ring.epsilon_bound == pytest.approx(0.75)
    assert ring.lambda_2(0.5) == pytest.approx(1 / 3)
    assert ring.lambda_2(0.1) == pytest.approx(1 - 0.2 * 2 / 3)


def test_complex_eigenvalues_of_a_ring_that_carries_one_way():
    # mu = (1 - exp(2 pi i k / 3)) w: Re(mu) = 1.5 w, |mu|^2 = 3 w^2, so the bound is 0.5 / w.
    ring = _directed(3, (0, 1), (1, 2), (2, 0), weights="degree")
    assert ring.lambda_max == pytest.approx(math.sqrt(3.0))
    assert ring.epsilon_bound == pytest.approx(0.5)
    # 0.9 / lambda_max would be 0.52: every robot would take over the map of the next one for ever.
    assert step_size(ring, ConsensusConfig()) == pytest.approx(0.45)
    assert _directed(3, (0, 1), (1, 2), (2, 0)).epsilon_bound == pytest.approx(1.0)


def test_a_robot_that_hears_somebody_and_that_nobody_hears():
    graph = _directed(2, (0, 1))
    assert graph.weights.tolist() == [[0, 0], [0.5, 0]]
    assert graph.epsilon_bound == pytest.approx(2.0)
    assert graph.lambda_2(0.5) == pytest.approx(0.5)
    assert step_size(graph, ConsensusConfig(epsilon=1.9)) == 1.9
    full = _directed(2, (0, 1), weights="degree")
    assert step_size(full, ConsensusConfig()) == 0.5
    assert settle_ticks_max(full, ConsensusConfig(), 0.5) == 21  # it takes over the other's map at once
    # Two who hear nobody and one between them: a zero eigenvalue each.
    between = _directed(3, (0, 1), (2, 1))
    assert between.epsilon_bound == pytest.approx(1.5)


def test_repeated_eigenvalues_of_a_line_that_carries_one_way():
    line = _directed(7, *((i, i + 1) for i in range(6)), weights="degree")  # all six are 1, with one eigenvector
    assert line.epsilon_bound == pytest.approx(1.0)
    assert line.lambda_2(0.25) == pytest.approx(0.5)


def test_one_step_on_a_complete_graph_with_defaults_is_the_exact_mean():
    for weights in ("metropolis", "max-degree"):
        graph = _build(6, weights=weights)
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


@pytest.mark.parametrize("rule", ["local", "ratio", "flood", "merge"])
def test_rules_without_a_step_size_have_no_bound(rule):
    assert step_size(_build(3), ConsensusConfig(epsilon=50.0, rule=rule)) == 50.0


@pytest.mark.parametrize("rule", ["gradient", "natural", "bayes"])
def test_the_whole_team_is_checked_before_a_run(rule):
    check_team_graph(NetworkConfig(), ConsensusConfig(epsilon=0.99, rule=rule), NAMES)
    with pytest.raises(ConfigError, match="7 of 7 robots active"):
        check_team_graph(NetworkConfig(), ConsensusConfig(epsilon=1.0, rule=rule), NAMES)


def test_every_state_of_the_schedule_is_checked_before_a_run():
    # Two robots that hear only each other have the bound 0.5, three of a complete graph 0.667.
    cut = ScheduleEntry(30.0, 40.0, groups=(NAMES[:1], NAMES[1:3]))
    network = NetworkConfig(weights="degree", schedule=(ScheduleEntry(10.0, 20.0, robots_silent=NAMES[:1]), cut))
    check_team_graph(network, ConsensusConfig(epsilon=0.49), NAMES[:3])
    with pytest.raises(ConfigError) as caught:
        check_team_graph(network, ConsensusConfig(epsilon=0.6), NAMES[:3])
    assert str(caught.value).startswith("schedule: at 10 s: epsilon: 0.6 is not below 0.5, the bound of this graph")
    with pytest.raises(ConfigError, match=r"^schedule: at 30 s: epsilon: 0\.6 is not below 0\.5"):
        check_team_graph(NetworkConfig(weights="degree", schedule=(cut,)), ConsensusConfig(epsilon=0.6), NAMES[:3])
    # What the schedule never lets happen is no reason to refuse.
    always = NetworkConfig(topology="star", weights="degree", schedule=(ScheduleEntry(0.0, links_up=_name((1, 2))),))
    check_team_graph(always, ConsensusConfig(epsilon=0.6), NAMES[:3])


def test_graphs_by_position_are_checked_when_they_occur():
    network = NetworkConfig(topology="range", radio_range=5.0, weights="degree")
    consensus = ConsensusConfig(epsilon=0.6)
    check_team_graph(network, consensus, NAMES[:3])
    team = TeamNetwork(network, consensus, NAMES[:3])
    apart = np.array([(0.0, 0, 0), (1, 0, 0), (2, 0, 0)])
    assert len(team.at(0.0, [True] * 3, apart).pairs) == 3
    with pytest.raises(ConfigError, match=r"^epsilon: 0\.6 is not below 0\.5, the bound .*'range', 3 of 3 robots"):
        team.at(1.0, [True] * 3, apart * [[1], [1], [50]])
    twice = ScheduleEntry(0.0, robots_off=NAMES[:1], robots_silent=NAMES[:1])
    with pytest.raises(ConfigError, match="is in it twice"):
        check_team_graph(NetworkConfig(topology="range", schedule=(twice,)), consensus, NAMES[:3])


def test_a_part_of_the_team_can_have_a_lower_bound():
    network, consensus = NetworkConfig(weights="degree"), ConsensusConfig(epsilon=0.6)
    check_team_graph(network, consensus, NAMES[:3])
    with pytest.raises(ConfigError, match=r"below 0\.5, the bound .* 2 of 3 robots active"):
        TeamNetwork(network, consensus, NAMES[:3]).at(0.0, [True, False, True], _nowhere(3))


@pytest.mark.parametrize("rule", ["gradient", "local"])
def test_row_sums_above_one_are_refused(rule):
    full = NetworkConfig(topology="edges", weights="given", edges=_edges((0, 1), (1, 2), weights=[0.6, 0.4]))
    check_team_graph(full, ConsensusConfig(), NAMES[:3])
    above = NetworkConfig(topology="edges", weights="given", edges=_edges((0, 1), (1, 2), weights=[0.7, 0.5]))
    with pytest.raises(ConfigError, match=r"edges: the weights of robot 'husky_2' sum to 1\.2; lower them to at most"):
        check_team_graph(above, ConsensusConfig(rule=rule), NAMES[:3])
    TeamNetwork(above, ConsensusConfig(rule=rule), NAMES[:3]).at(0.0, [True, True, False], _nowhere(3))


def test_row_sums_that_a_schedule_brings_above_one_are_refused_with_the_time():
    network = NetworkConfig(
        topology="edges", weights="given", edges=_edges((0, 1), (1, 2), weights=[0.7, 0.5]),
        one_way=_name((1, 0)), schedule=(ScheduleEntry(4.0, links_up=_name((0, 1))),),
    )  # fmt: skip
    with pytest.raises(ConfigError, match=r"^schedule: at 4 s: edges: the weights of robot 'husky_2' sum to 1\.2"):
        check_team_graph(network, ConsensusConfig(), NAMES[:3])


def test_a_link_that_the_schedule_brings_up_needs_a_weight_where_weights_are_given():
    schedule = (ScheduleEntry(4.0, links_up=_name((0, 2))),)
    edges = _edges((0, 1), (1, 2), weights=[0.5, 0.5])
    with pytest.raises(ConfigError, match=r"^schedule: links_up 'husky_1' - 'husky_3' has no weight; add it to edges"):
        _team(3, "edges", edges=edges, weights="given", schedule=schedule)


@pytest.mark.parametrize("weight", [math.nan, math.inf])
def test_weights_that_are_no_numbers_are_refused(weight):
    with pytest.raises(ConfigError, match="husky_1"):
        _build(2, "edges", edges=_edges((0, 1), weights=[weight]), weights="given")


def test_one_way_pairs_that_make_no_sense_are_refused():
    with pytest.raises(ConfigError, match=r"^one_way: 'husky_1' cannot have a link to itself"):
        NetworkConfig(one_way=_name((0, 0)))
    with pytest.raises(ConfigError, match=r"^one_way: husky_2 -> husky_1 and husky_1 -> husky_2 are both listed; keep"):
        NetworkConfig(one_way=_name((1, 0), (0, 1)))


# --- properties ------------------------------------------------------------------------------------------------------


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
            elapsed_s, active, _nowhere(len(active))
        )
    except ConfigError:
        assume(False)


@given(
    _ticks(),
    st.none() | st.floats(0.05, 1.2),
    st.sampled_from(["gradient", "bayes", "local", "flood"]),
    st.integers(1, 30),
)
def test_every_graph_is_that_of_the_reference(tick, epsilon, rule, settle):
    network, robot_ids, active, elapsed_s = tick
    consensus = ConsensusConfig(epsilon=epsilon, rule=rule, settle=settle)
    try:
        team = TeamNetwork(network, consensus, robot_ids)
    except ConfigError as error:
        assume("twice" not in str(error))  # a link down that the groups cut, too
        raise
    try:
        expected = reference.team_graph(network, consensus, robot_ids, active, elapsed_s)
    except ConfigError:
        with pytest.raises(ConfigError):
            team.at(elapsed_s, active, _nowhere(len(active)))
        return
    graph = team.at(elapsed_s, active, _nowhere(len(active)))
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
    most = reference.default_settle_max(settle, lambda_2)
    assert settle_ticks_max(graph, consensus, expected.epsilon) == most


@given(_networks(), st.sampled_from(["gradient", "local"]), st.none() | st.floats(0.05, 1.2))
def test_the_check_before_a_run_is_the_reference_on_the_whole_team_at_all_times(shape, rule, epsilon):
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
        assume("twice" not in str(error))
        raise


@given(_ticks())
def test_row_sums_are_at_most_one_and_weights_stand_on_links_only(tick):
    graph = _graph(tick)
    assert (graph.weights >= 0).all()
    assert (graph.weights.sum(axis=1) <= 1 + 1e-9).all()
    receivers_and_senders = {(int(i), int(j)) for i, j in np.argwhere(graph.weights)}
    assert receivers_and_senders == {(receiver, sender) for sender, receiver in graph.links}


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


@given(
    st.integers(2, 7).flatmap(
        lambda n: st.tuples(
            st.just(n), st.lists(st.sampled_from(list(itertools.permutations(range(n), 2))), min_size=1)
        )
    ),
    st.sampled_from(["metropolis", "degree", "max-degree"]),
)
def test_no_bound_of_a_directed_graph_is_below_one_half_and_a_simulation_finds_it(links, weights):
    graph = _directed(links[0], *links[1], weights=weights)
    assert graph.epsilon_bound >= 0.5
    assert graph.epsilon_bound == pytest.approx(reference.simulated_bound(graph.weights), rel=2e-3)
    assert graph.lambda_2(step_size(graph, ConsensusConfig())) < 1.0


@given(_ticks())
def test_the_default_step_size_is_stable_on_every_graph(tick):
    graph = _graph(tick)
    assert graph.lambda_2(step_size(graph, ConsensusConfig())) < 1.0


@given(_ticks())
def test_a_partition_leaves_the_parts_of_the_graph_that_lie_within_groups(tick):
    network, robot_ids, active, _ = tick
    whole = NetworkConfig(topology="random", prob_link=0.7, network_seed=network.network_seed)
    cuts = (robot_ids[::2], robot_ids[1::2]) if len(robot_ids) > 1 else ()
    schedule = (ScheduleEntry(1.0, groups=cuts),) if cuts else ()
    split = NetworkConfig(topology="random", prob_link=0.7, network_seed=network.network_seed, schedule=schedule)
    before = nx.Graph(TeamNetwork(whole, ConsensusConfig(), robot_ids).at(9.0, active, _nowhere(len(active))).pairs)
    after = nx.Graph(TeamNetwork(split, ConsensusConfig(), robot_ids).at(9.0, active, _nowhere(len(active))).pairs)
    groups = [before.subgraph(i for i in range(len(robot_ids)) if i % 2 == side) for side in (0, 1)]
    expected = [part for group in groups for part in nx.connected_components(group) if len(part) > 1]
    assert sorted(map(sorted, nx.connected_components(after))) == sorted(map(sorted, expected))


def test_importing_the_module_leaves_networkx_out():
    code = "import sys, octoreplay.replay.network.graph; print('networkx' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
