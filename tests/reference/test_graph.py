from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from octoreplay.config.consensus import ConsensusConfig
from octoreplay.config.network import NetworkConfig, ScheduleEntry
from octoreplay.errors import ConfigError
from reference import graph

FIVE = ("a", "b", "c", "d", "e")


def _team(
    topology="complete", robots=FIVE, active=None, epsilon=None, rule="gradient", elapsed_s=0.0, history=(), **network
):
    config = NetworkConfig(topology=topology, **network)
    active = active or [True] * len(robots)
    consensus = ConsensusConfig(epsilon=epsilon, rule=rule)
    return graph.team_graph(config, consensus, robots, active, elapsed_s, history)


def test_topologies_by_hand():
    assert len(_team("complete").links) == 10
    assert _team("line").links == ((0, 1), (1, 2), (2, 3), (3, 4))
    assert _team("ring").links == ((0, 1), (0, 4), (1, 2), (2, 3), (3, 4))
    assert _team("star").links == ((0, 1), (0, 2), (0, 3), (0, 4))
    assert _team("edges", edges=(("d", "a", None), ("a", "d", None), ("b", "c", None))).links == ((0, 3), (1, 2))


@pytest.mark.parametrize("topology", ["complete", "ring", "line", "star"])
def test_one_and_two_robots(topology):
    assert _team(topology, robots=("a",)).links == ()
    assert _team(topology, robots=("a", "b")).links == ((0, 1),)


def test_more_topologies_by_hand():
    # a b c
    # d e
    assert _team("grid").links == ((0, 1), (0, 3), (1, 2), (1, 4), (3, 4))
    assert _team("grid", robots=("a", "b")).links == ((0, 1),)
    assert _team("random", prob_link=0.0).links == ()
    assert len(_team("random", prob_link=1.0).links) == 10
    assert _team("random", network_seed=7).links == _team("random", network_seed=7).links
    here = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), None, (3.0, 0.0, 0.0), (-1.0, 0.0, 0.0)]
    # b and e are at the same distance from a; the lower index is chosen.
    assert _team("nearest", num_nearest=1, history=[here]).links == ((0, 1), (0, 4), (1, 3))


def test_link_by_range_persists_up_to_the_hysteresis():
    def linked(*distances):
        history = [[(0.0, 0.0, 0.0), None if d is None else (0.0, d, 0.0)] for d in distances]
        robots = ("a", "b")
        return _team("range", robots, radio_range=10.0, range_hysteresis=2.0, history=history).links == ((0, 1),)

    assert not linked(10.0)
    assert linked(9.9)
    assert linked(9.9, 12.0)
    assert not linked(9.9, 12.1)
    assert not linked(9.9, 12.1, 11.0)
    assert not linked(9.9, None, 11.0)
    assert linked(9.9, 12.1, 9.0)


def test_one_way_pairs_and_the_schedule():
    entries = (
        ScheduleEntry(10.0, 20.0, groups=(("a", "b"), ("c",))),
        ScheduleEntry(20.0, 30.0, links_up=(("a", "c"),), robots_silent=("b",)),
        ScheduleEntry(30.0, 40.0, robots_off=("b",)),
    )
    network = {"robots": ("a", "b", "c"), "one_way": (("a", "b"),), "schedule": entries}
    assert _team("line", elapsed_s=0.0, **network).directed == ((0, 1), (1, 2), (2, 1))
    assert _team("line", elapsed_s=10.0, **network).directed == ((0, 1),)
    silent = _team("line", elapsed_s=20.0, **network)
    assert silent.directed == ((0, 1), (0, 2), (2, 0), (2, 1))
    assert silent.links == ((0, 1), (0, 2), (1, 2))
    assert (silent.neighbours(1), silent.receivers(1), silent.degree(1)) == ([0, 2], [], 2)
    assert _team("line", elapsed_s=30.0, **network).directed == ()
    assert _team("line", elapsed_s=40.0, **network).directed == ((0, 1), (1, 2), (2, 1))


def test_dormant_robots_have_no_links():
    assert _team("ring", active=[True, True, False, True, True]).links == ((0, 1), (0, 4), (3, 4))
    assert _team("star", active=[False, True, True, True, True]).links == ()


def test_metropolis_weights_by_hand():
    third = 1.0 / 3.0
    line = _team("line", robots=("a", "b", "c"))
    np.testing.assert_allclose(line.weights, [[0, third, 0], [third, 0, third], [0, third, 0]])
    assert line.degree(1) == 2
    assert line.neighbours(1) == [0, 2]
    np.testing.assert_allclose(graph.laplacian(line.weights).sum(axis=1), 0.0, atol=1e-16)


def test_weights_are_those_of_the_active_robots():
    pair = _team("complete", active=[True, False, False, True, False])
    assert pair.weights[0, 3] == pair.weights[3, 0] == 0.5
    assert pair.weights.sum() == 1.0


def test_degree_weights_are_not_symmetric_on_a_star():
    star = _team("star", robots=("a", "b", "c"), weights="degree")
    assert star.weights.tolist() == [[0.0, 0.5, 0.5], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]


def test_max_degree_weights_by_hand():
    star = _team("star", robots=("a", "b", "c"), weights="max-degree")
    third = 1.0 / 3.0
    np.testing.assert_allclose(star.weights, [[0.0, third, third], [third, 0.0, 0.0], [third, 0.0, 0.0]])


def test_one_way_link_has_a_weight_at_the_receiver_only():
    team = _team("line", robots=("a", "b", "c"), one_way=(("a", "b"),), weights="degree")
    assert team.weights.tolist() == [[0.0, 0.0, 0.0], [0.5, 0.0, 0.5], [0.0, 1.0, 0.0]]


def test_given_weights_hold_in_both_directions_and_sum_to_one_at_most():
    team = _team("edges", robots=("a", "b", "c"), weights="given", edges=(("b", "a", 0.3), ("b", "c", 0.6)))
    assert team.weights.tolist() == [[0.0, 0.3, 0.0], [0.3, 0.0, 0.6], [0.0, 0.6, 0.0]]
    with pytest.raises(ConfigError, match=r"'b' sum to 1\.1"):
        _team("edges", robots=("a", "b", "c"), weights="given", edges=(("b", "a", 0.5), ("b", "c", 0.6)))


def test_metropolis_on_a_complete_graph_is_the_exact_mean_in_one_step():
    team = _team("complete")
    np.testing.assert_allclose(np.eye(5) - 2 * team.epsilon * graph.laplacian(team.weights), np.full((5, 5), 0.2))
    assert graph.second_eigenvalue(team) < 1e-12


def test_step_size_bound_by_hand():
    # Line of three, Metropolis: L has eigenvalues 0, 1/3, 1.
    assert graph.step_size_bound(_team("line", robots=("a", "b", "c")).weights) == pytest.approx(1.0)
    # Star of three, 1 / degree: eigenvalues 0, 1, 2, so |1 - 2 epsilon 2| < 1 means epsilon < 1/2.
    star = _team("star", robots=("a", "b", "c"), weights="degree")
    assert graph.step_size_bound(star.weights) == pytest.approx(0.5)
    assert graph.step_size_bound(np.zeros((3, 3))) == math.inf


def test_complex_eigenvalues_of_asymmetric_weights():
    # A directed ring of three: mu = 1 - exp(2 pi i / 3), |mu|^2 = 3, Re mu = 3/2.
    directed = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    assert graph.step_size_bound(directed) == pytest.approx(0.5)


def test_simulated_bound_by_hand():
    directed = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    assert graph.simulated_bound(directed) == pytest.approx(0.5, rel=1e-3)
    line = _team("line", robots=("a", "b", "c"))
    assert graph.simulated_bound(line.weights) == pytest.approx(1.0, rel=1e-3)
    # One link of weight 1/2: mu = 1/2.
    assert graph.simulated_bound(np.array([[0.0, 0.5], [0.0, 0.0]])) == pytest.approx(2.0, rel=1e-3)


@pytest.mark.parametrize("topology", ["complete", "ring", "line", "star", "grid"])
@pytest.mark.parametrize("weights", ["metropolis", "degree", "max-degree"])
def test_just_below_the_bound_converges_and_above_is_refused(topology, weights):
    bound = graph.step_size_bound(_team(topology, weights=weights).weights)
    team = _team(topology, weights=weights, epsilon=0.95 * bound)
    assert graph.second_eigenvalue(team) < 1.0
    with pytest.raises(ConfigError, match=r"epsilon: .* is not below the bound"):
        _team(topology, weights=weights, epsilon=1.05 * bound)
    with pytest.raises(ConfigError, match="bound"):
        _team(topology, weights=weights, epsilon=bound)
    diverging = dataclasses.replace(team, epsilon=1.05 * bound)
    assert graph.second_eigenvalue(diverging) > 1.0


@pytest.mark.parametrize("rule", ["local", "ratio", "flood", "merge"])
def test_rules_without_a_step_size_have_no_bound(rule):
    assert _team(epsilon=50.0, rule=rule).epsilon == 50.0


def test_default_step_size_stays_below_the_bound_with_degree_weights():
    assert _team("complete").epsilon == 0.5
    assert _team("complete", robots=("a", "b"), weights="max-degree").epsilon == 0.5
    # Six robots, 1 / degree: lambda_max = 6/5, 0.9 / 1.2 = 0.75.
    assert _team("complete", robots=tuple("abcdef"), weights="degree").epsilon == 0.5
    # Two robots of them: lambda_max = 2.
    assert _team("complete", robots=("a", "b"), weights="degree").epsilon == pytest.approx(0.45)


def test_second_eigenvalue_by_hand():
    # Line of three: I - L has eigenvalues 1, 2/3, 0.
    line = _team("line", robots=("a", "b", "c"))
    assert graph.second_eigenvalue(line) == pytest.approx(2.0 / 3.0)
    with_dormant = _team("line", robots=("a", "b", "c", "d"), active=[True, True, True, False])
    assert graph.second_eigenvalue(with_dormant) == pytest.approx(2.0 / 3.0)
    assert graph.second_eigenvalue(_team(robots=("a",))) == 0.0


def test_default_settle_max_by_hand():
    # 12 / -log10(2/3) = 68.1, rounded up.
    assert graph.default_settle_max(20, 2.0 / 3.0) == 89
    assert graph.default_settle_max(20, 0.1) == 32
    assert graph.default_settle_max(20, 0.0) == 21
