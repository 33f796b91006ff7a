"""Communication graphs: links, weights and eigenvalues by hand."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest

from octoreplay.config.consensus import ConsensusConfig
from octoreplay.config.network import NetworkConfig, ScheduleEntry
from octoreplay.replay.network.graph import TeamNetwork, build_graph, step_size, step_weights_of
from octoreplay.replay.settling import settle_ticks_max
from support.team_graphs import NAMES, built, directed, edges_of, nowhere, pairs_of, team_of


def test_an_undirected_link_is_two_directed_ones():
    graph = built(4, "line")
    assert graph.links == ((0, 1), (1, 0), (1, 2), (2, 1), (2, 3), (3, 2))
    assert graph.pairs == ((0, 1), (1, 2), (2, 3))
    assert graph.senders(1) == graph.receivers(1) == (0, 2)
    assert graph.is_symmetric


@pytest.mark.parametrize("topology", ["complete", "ring", "line", "star", "grid"])
def test_one_robot_has_no_link_and_two_have_one(topology):
    alone, pair = built(1, topology), built(2, topology)
    assert (alone.links, alone.pairs, alone.senders(0), alone.receivers(0)) == ((), (), (), ())
    assert alone.weights.tolist() == [[0.0]]
    assert pair.pairs == ((0, 1),)
    assert pair.weights.tolist() == [[0.0, 0.5], [0.5, 0.0]]


def test_links_join_active_robots_only():
    ring = built(5, "ring", active=[True, True, False, True, True])
    assert ring.active == (0, 1, 3, 4)
    assert ring.pairs == ((0, 1), (0, 4), (3, 4))
    assert ring.senders(0) == (1, 4)
    assert [ring.degree(i) for i in range(5)] == [2, 1, 0, 1, 2]
    assert ring.weights[2].tolist() == ring.weights[:, 2].tolist() == [0.0] * 5
    assert built(4, "line", active=[True, False, True, True]).pairs == ((2, 3),)
    assert built(4, "star", active=[False, True, True, True]).pairs == ()
    assert built(4, "star", active=[True, False, True, True]).pairs == ((0, 2), (0, 3))
    nobody = built(3, active=[False] * 3)
    assert (nobody.active, nobody.links, nobody.lambda_max, nobody.epsilon_bound) == ((), (), 0.0, math.inf)
    assert nobody.is_symmetric


def test_a_one_way_pair_links_the_first_to_the_second():
    graph = built(3, "line", one_way=pairs_of((1, 0)))
    assert graph.links == ((1, 0), (1, 2), (2, 1))
    assert graph.pairs == ((0, 1), (1, 2))
    assert (graph.senders(0), graph.receivers(0), graph.degree(0)) == ((1,), (), 1)
    assert (graph.senders(1), graph.receivers(1), graph.degree(1)) == ((2,), (0, 2), 1)
    assert not graph.is_symmetric
    # A one-way pair without a link is none.
    assert built(3, "line", one_way=pairs_of((0, 2))).pairs == ((0, 1), (1, 2))


def test_a_schedule_sets_links_down_and_up():
    schedule = (
        ScheduleEntry(10.0, 20.0, links_down=pairs_of((1, 0)), links_up=pairs_of((3, 0))),
        ScheduleEntry(20.0, 30.0, groups=((NAMES[0], NAMES[1]), (NAMES[2],))),
    )
    team = team_of(4, "line", schedule=schedule)
    seen = [team.at(t, [True] * 4, nowhere(4)).pairs for t in (0.0, 9.9, 10.0, 19.9, 20.0, 30.0)]
    line = ((0, 1), (1, 2), (2, 3))
    assert seen == [line, line, ((0, 3), (1, 2), (2, 3)), ((0, 3), (1, 2), (2, 3)), ((0, 1), (2, 3)), line]
    dormant = team_of(4, "line", schedule=schedule).at(10.0, [True, True, True, False], nowhere(4))
    assert dormant.pairs == ((1, 2),)


def test_the_schedule_overrides_one_way_pairs():
    schedule = (ScheduleEntry(10.0, 20.0, links_up=pairs_of((0, 1))),)
    team = team_of(2, one_way=pairs_of((0, 1)), schedule=schedule)
    seen = [team.at(t, [True] * 2, nowhere(2)).links for t in (0.0, 10.0, 20.0)]
    assert seen == [((0, 1),), ((0, 1), (1, 0)), ((0, 1),)]


def test_robots_that_are_off_have_no_links_and_silent_ones_only_receive():
    schedule = (
        ScheduleEntry(5.0, 6.0, robots_off=NAMES[1:2], links_up=pairs_of((1, 3)), forget=True),
        ScheduleEntry(6.0, 7.0, robots_silent=NAMES[1:2]),
    )
    team = team_of(4, "ring", schedule=schedule)
    off = team.at(5.0, [True] * 4, nowhere(4))
    assert (off.active, off.pairs) == ((0, 2, 3), ((0, 3), (2, 3)))
    silent = team.at(6.0, [True] * 4, nowhere(4))
    assert silent.active == (0, 1, 2, 3)
    assert (silent.senders(1), silent.receivers(1)) == ((0, 2), ())
    assert (silent.senders(0), silent.receivers(0)) == ((3,), (1, 3))
    assert silent.weights[:, 1].tolist() == [0.0] * 4


def test_robots_that_are_off_are_not_among_the_nearest():
    schedule = (ScheduleEntry(5.0, 6.0, robots_off=NAMES[1:2]),)
    team = team_of(3, "nearest", num_nearest=1, schedule=schedule)
    positions = np.array([(0.0, 0, 0), (1, 0, 0), (2, 0, 0)])
    assert team.at(0.0, [True] * 3, positions).pairs == ((0, 1), (1, 2))
    assert team.at(5.0, [True] * 3, positions).pairs == ((0, 2),)


def test_the_graph_object_is_reused_until_something_changes():
    team = team_of(3, "range", radio_range=10.0, schedule=(ScheduleEntry(3.0, 4.0, links_down=pairs_of((0, 1))),))
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
        built(3, active=[True, True])
    with pytest.raises(ValueError, match="shorter"):
        build_graph(NetworkConfig(), NAMES[:3], [True, True], np.zeros((3, 3), bool))


def test_the_later_weight_of_a_repeated_edge_counts():
    edges = edges_of((0, 1), (1, 2), (1, 0), weights=[0.9, 0.25, 0.5])
    graph = built(3, "edges", edges=edges, weights="given")
    assert graph.pairs == ((0, 1), (1, 2))
    assert graph.weights.tolist() == [[0.0, 0.5, 0.0], [0.5, 0.0, 0.25], [0.0, 0.25, 0.0]]
    assert graph.degree(1) == 2


def test_a_link_of_weight_zero_is_a_link():
    graph = built(2, "edges", edges=edges_of((0, 1), weights=[0.0]), weights="given")
    assert graph.links == ((0, 1), (1, 0))
    assert graph.senders(1) == (0,)
    assert graph.lambda_max == 0.0
    assert step_size(graph, ConsensusConfig()) == 0.5


def test_metropolis_weights_follow_the_degrees_of_the_tick():
    star = built(4, "star")
    assert star.weights.tolist() == [[0.0, 0.25, 0.25, 0.25], [0.25, 0, 0, 0], [0.25, 0, 0, 0], [0.25, 0, 0, 0]]
    fewer = built(4, "star", active=[True, True, True, False])
    assert fewer.weights[0].tolist() == [0.0, 1 / 3, 1 / 3, 0.0]


def test_max_degree_weights_are_all_the_same():
    graph = built(4, "line", weights="max-degree")
    assert graph.weights.tolist() == [[0, 1 / 3, 0, 0], [1 / 3, 0, 1 / 3, 0], [0, 1 / 3, 0, 1 / 3], [0, 0, 1 / 3, 0]]
    assert graph.is_symmetric
    assert built(2, weights="max-degree").weights[0, 1] == 0.5
    assert built(1, weights="max-degree").weights.tolist() == [[0.0]]


def test_degree_weights_are_not_symmetric():
    star = built(3, "star", weights="degree")
    assert star.weights.tolist() == [[0.0, 0.5, 0.5], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    assert not star.is_symmetric
    assert built(3, weights="degree").is_symmetric
    assert star.laplacian.tolist() == [[1.0, -0.5, -0.5], [-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]]
    # eigenvalues 0, 1 and 2
    assert star.lambda_max == pytest.approx(2.0)
    assert star.epsilon_bound == pytest.approx(0.5)
    assert star.lambda_2(0.25) == pytest.approx(0.5)


def test_degrees_of_one_way_links_are_those_of_the_receivers():
    links = ((0, 1), (2, 1), (3, 1), (1, 0))
    # Robot 1 hears three, robot 0 one.
    metropolis = directed(4, *links)
    assert metropolis.weights.tolist() == [[0, 0.25, 0, 0], [0.25, 0, 0.25, 0.25], [0] * 4, [0] * 4]
    assert not metropolis.is_symmetric
    degree = directed(4, *links, weights="degree")
    assert degree.weights.tolist() == [[0, 1, 0, 0], [1 / 3, 0, 1 / 3, 1 / 3], [0] * 4, [0] * 4]
    largest = directed(4, *links, weights="max-degree")
    assert largest.weights.tolist() == metropolis.weights.tolist()


def test_given_weights_apply_to_the_remaining_direction():
    edges = edges_of((0, 1), (1, 2), weights=[0.9, 0.4])
    # Both ways robot 1 would give 1.3.
    graph = built(3, "edges", edges=edges, weights="given", one_way=pairs_of((1, 0)))
    assert graph.weights.tolist() == [[0, 0.9, 0], [0, 0, 0.4], [0, 0.4, 0]]


def test_eigenvalues_of_a_ring_of_four():
    ring = built(4, "ring")  # A = 1/3 on links: 0, 2/3, 2/3, 4/3
    assert ring.lambda_max == pytest.approx(4 / 3)
    assert ring.epsilon_bound == pytest.approx(0.75)
    assert ring.lambda_2(0.5) == pytest.approx(1 / 3)
    assert ring.lambda_2(0.1) == pytest.approx(1 - 0.2 * 2 / 3)


def test_complex_eigenvalues_of_a_one_way_ring():
    # mu = (1 - exp(2 pi i k / 3)) w: Re(mu) = 1.5 w, |mu|^2 = 3 w^2, so the bound is 0.5 / w.
    ring = directed(3, (0, 1), (1, 2), (2, 0), weights="degree")
    assert ring.lambda_max == pytest.approx(math.sqrt(3.0))
    assert ring.epsilon_bound == pytest.approx(0.5)
    # 0.9 / lambda_max would be 0.52: every robot would take over the map of the next one for ever.
    assert step_size(ring, ConsensusConfig()) == pytest.approx(0.45)
    assert directed(3, (0, 1), (1, 2), (2, 0)).epsilon_bound == pytest.approx(1.0)


def test_a_robot_without_outgoing_links():
    graph = directed(2, (0, 1))
    assert graph.weights.tolist() == [[0, 0], [0.5, 0]]
    assert graph.epsilon_bound == pytest.approx(2.0)
    assert graph.lambda_2(0.5) == pytest.approx(0.5)
    assert step_size(graph, ConsensusConfig(epsilon=1.9)) == 1.9
    full = directed(2, (0, 1), weights="degree")
    assert step_size(full, ConsensusConfig()) == 0.5
    assert settle_ticks_max(full, ConsensusConfig(), 0.5) == 21  # it takes over the other's map at once
    # Two who hear nobody and one between them: a zero eigenvalue each.
    between = directed(3, (0, 1), (2, 1))
    assert between.epsilon_bound == pytest.approx(1.5)


def test_repeated_eigenvalues_of_a_one_way_line():
    line = directed(7, *((i, i + 1) for i in range(6)), weights="degree")  # all six are 1, with one eigenvector
    assert line.epsilon_bound == pytest.approx(1.0)
    assert line.lambda_2(0.25) == pytest.approx(0.5)


def test_one_step_on_a_complete_graph_with_defaults_is_the_exact_mean():
    for weights in ("metropolis", "max-degree"):
        graph = built(6, weights=weights)
        epsilon = step_size(graph, ConsensusConfig())
        assert epsilon == 0.5
        np.testing.assert_allclose(np.eye(6) - 2 * epsilon * graph.laplacian, np.full((6, 6), 1 / 6), atol=1e-15)
        assert settle_ticks_max(graph, ConsensusConfig(), epsilon) == 21


def test_default_step_size_of_other_weights():
    assert step_size(built(3, "star", weights="degree"), ConsensusConfig()) == pytest.approx(0.45)
    light = built(2, "edges", edges=edges_of((0, 1), weights=[0.1]), weights="given")
    assert step_size(light, ConsensusConfig()) == 0.5
    assert step_size(built(1, weights="degree"), ConsensusConfig()) == 0.5


def test_settle_ticks_max():
    graph = built(4, "ring")
    # lambda_2 = 1/3: 12 / log10(3) = 25.15
    assert settle_ticks_max(graph, ConsensusConfig(settle=7), 0.5) == 7 + 26
    assert settle_ticks_max(graph, ConsensusConfig(settle=7, settle_max=3), 0.5) == 3
    assert settle_ticks_max(graph, ConsensusConfig(settle=0), 0.5) == 0
    assert settle_ticks_max(graph, ConsensusConfig(settle=0, settle_max=3), 0.5) == 0
    assert settle_ticks_max(built(1), ConsensusConfig(), 0.5) == 21


def test_arrays_are_read_only():
    graph = built(3)
    for array in (graph.weights, graph.laplacian):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 1] = 2.0


def test_importing_the_module_does_not_import_networkx():
    code = "import sys, octoreplay.replay.network.graph; print('networkx' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_robots_reach_others_over_robots_in_between_and_in_the_direction_of_the_links():
    a, b, c, d, e, _ = NAMES[:6]
    edges = ((a, b, None), (b, c, None), (d, e, None))
    network = NetworkConfig(topology="edges", edges=edges, one_way=((a, b), (c, b)))
    graph = TeamNetwork(network, ConsensusConfig(), NAMES[:6]).at(0.0, [True] * 6, nowhere(6))
    # Robot b receives from a and c, which receive nothing.
    assert graph.num_reaching.tolist() == [1, 3, 1, 2, 2, 1]
    both_ways = TeamNetwork(NetworkConfig(topology="edges", edges=edges), ConsensusConfig(), NAMES[:6])
    assert both_ways.at(0.0, [True] * 6, nowhere(6)).num_reaching.tolist() == [3, 3, 3, 2, 2, 1]
    part = TeamNetwork(network, ConsensusConfig(), NAMES[:6]).at(
        0.0, [True, False, True, True, True, False], nowhere(6)
    )
    assert part.num_reaching.tolist() == [1, 1, 1, 2, 2, 1]


def test_a_constant_weight_of_received_maps_replaces_those_of_the_graph():
    graph = built(3, "line")
    np.testing.assert_allclose(step_weights_of(graph, ConsensusConfig(rule="merge")), graph.weights)
    constant = step_weights_of(graph, ConsensusConfig(rule="merge", merge_weight=0.25))
    assert constant.tolist() == [[0.0, 0.25, 0.0], [0.25, 0.0, 0.25], [0.0, 0.25, 0.0]]
    np.testing.assert_allclose(step_weights_of(graph, ConsensusConfig(merge_weight=0.25)), graph.weights)
