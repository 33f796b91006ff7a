"""Checks of step sizes, weights and one-way pairs of all graphs of a team."""

from __future__ import annotations

import math

import numpy as np
import pytest

from octoreplay.config.consensus import ConsensusConfig
from octoreplay.config.network import NetworkConfig, ScheduleEntry
from octoreplay.errors import ConfigError
from octoreplay.replay.network.graph import TeamNetwork, check_team_graph, step_size
from support.team_graphs import NAMES, built, edges_of, nowhere, pairs_of, team_of


def test_a_step_size_at_the_bound_is_refused_with_the_bound_and_the_remedy():
    ring = built(5, "ring", weights="degree", active=[True, True, True, True, False])  # a line: eigenvalues up to 2
    assert step_size(ring, ConsensusConfig(epsilon=0.499)) == 0.499
    with pytest.raises(ConfigError) as caught:
        step_size(ring, ConsensusConfig(epsilon=0.5))
    assert str(caught.value) == (
        "epsilon: 0.5 is not below 0.5, the bound of this graph (topology 'ring', 4 of 5 robots active, weights"
        " 'degree'); use 0.45 or leave epsilon out"
    )


@pytest.mark.parametrize("rule", ["local", "ratio", "flood", "merge", "latest"])
def test_rules_without_a_step_size_have_no_bound(rule):
    assert step_size(built(3), ConsensusConfig(epsilon=50.0, rule=rule)) == 50.0


@pytest.mark.parametrize("rule", ["gradient", "natural", "bayes"])
def test_the_whole_team_is_checked_before_a_run(rule):
    check_team_graph(NetworkConfig(), ConsensusConfig(epsilon=0.99, rule=rule), NAMES)
    with pytest.raises(ConfigError, match="7 of 7 robots active"):
        check_team_graph(NetworkConfig(), ConsensusConfig(epsilon=1.0, rule=rule), NAMES)


def test_the_rule_that_weighs_certainty_has_the_bound_of_a_weighted_mean():
    """On a star the weights at the centre sum to 6/7, the largest eigenvalue is 1, and bayes takes epsilon up to 1."""
    star = built(7, "star")
    weighted = ConsensusConfig(epsilon=0.58, rule="weighted")
    assert step_size(star, weighted) == 0.58
    assert star.mean_bound == pytest.approx(7 / 12)
    with pytest.raises(ConfigError, match=r"epsilon: 0\.59 is not below 0\.583333, the bound of this graph"):
        step_size(star, ConsensusConfig(epsilon=0.59, rule="weighted"))
    assert step_size(star, ConsensusConfig(epsilon=0.99, rule="bayes")) == 0.99
    assert step_size(built(7, weights="degree"), ConsensusConfig(rule="weighted")) == pytest.approx(0.45)
    assert built(1).mean_bound == math.inf


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
    always = NetworkConfig(topology="star", weights="degree", schedule=(ScheduleEntry(0.0, links_up=pairs_of((1, 2))),))
    check_team_graph(always, ConsensusConfig(epsilon=0.6), NAMES[:3])


def test_graphs_by_position_are_checked_during_the_run():
    network = NetworkConfig(topology="range", radio_range=5.0, weights="degree")
    consensus = ConsensusConfig(epsilon=0.6)
    check_team_graph(network, consensus, NAMES[:3])
    team = TeamNetwork(network, consensus, NAMES[:3])
    apart = np.array([(0.0, 0, 0), (1, 0, 0), (2, 0, 0)])
    assert len(team.at(0.0, [True] * 3, apart).pairs) == 3
    with pytest.raises(ConfigError, match=r"^epsilon: 0\.6 is not below 0\.5, the bound .*'range', 3 of 3 robots"):
        team.at(1.0, [True] * 3, apart * [[1], [1], [50]])
    twice = ScheduleEntry(0.0, robots_off=NAMES[:1], robots_silent=NAMES[:1])
    with pytest.raises(ConfigError, match="is in two entries"):
        check_team_graph(NetworkConfig(topology="range", schedule=(twice,)), consensus, NAMES[:3])


def test_a_part_of_the_team_may_have_a_lower_bound():
    network, consensus = NetworkConfig(weights="degree"), ConsensusConfig(epsilon=0.6)
    check_team_graph(network, consensus, NAMES[:3])
    with pytest.raises(ConfigError, match=r"below 0\.5, the bound .* 2 of 3 robots active"):
        TeamNetwork(network, consensus, NAMES[:3]).at(0.0, [True, False, True], nowhere(3))


@pytest.mark.parametrize("rule", ["gradient", "local"])
def test_row_sums_above_one_are_refused(rule):
    full = NetworkConfig(topology="edges", weights="given", edges=edges_of((0, 1), (1, 2), weights=[0.6, 0.4]))
    check_team_graph(full, ConsensusConfig(), NAMES[:3])
    above = NetworkConfig(topology="edges", weights="given", edges=edges_of((0, 1), (1, 2), weights=[0.7, 0.5]))
    with pytest.raises(ConfigError, match=r"edges: the weights of robot 'husky_2' sum to 1\.2; lower them to at most"):
        check_team_graph(above, ConsensusConfig(rule=rule), NAMES[:3])
    TeamNetwork(above, ConsensusConfig(rule=rule), NAMES[:3]).at(0.0, [True, True, False], nowhere(3))


def test_row_sums_above_one_in_a_schedule_are_refused_with_the_time():
    network = NetworkConfig(
        topology="edges", weights="given", edges=edges_of((0, 1), (1, 2), weights=[0.7, 0.5]),
        one_way=pairs_of((1, 0)), schedule=(ScheduleEntry(4.0, links_up=pairs_of((0, 1))),),
    )  # fmt: skip
    with pytest.raises(ConfigError, match=r"^schedule: at 4 s: edges: the weights of robot 'husky_2' sum to 1\.2"):
        check_team_graph(network, ConsensusConfig(), NAMES[:3])


def test_a_scheduled_link_needs_a_weight_if_weights_are_given():
    schedule = (ScheduleEntry(4.0, links_up=pairs_of((0, 2))),)
    edges = edges_of((0, 1), (1, 2), weights=[0.5, 0.5])
    with pytest.raises(ConfigError, match=r"^schedule: links_up 'husky_1' - 'husky_3' has no weight; add it to edges"):
        team_of(3, "edges", edges=edges, weights="given", schedule=schedule)


@pytest.mark.parametrize("weight", [math.nan, math.inf])
def test_weights_that_are_not_finite_are_refused(weight):
    with pytest.raises(ConfigError, match="husky_1"):
        built(2, "edges", edges=edges_of((0, 1), weights=[weight]), weights="given")


def test_invalid_one_way_pairs_are_refused():
    with pytest.raises(ConfigError, match=r"^one_way: 'husky_1' cannot have a link to itself"):
        NetworkConfig(one_way=pairs_of((0, 0)))
    with pytest.raises(ConfigError, match=r"^one_way: husky_2 -> husky_1 and husky_1 -> husky_2 are both listed; keep"):
        NetworkConfig(one_way=pairs_of((1, 0), (0, 1)))
