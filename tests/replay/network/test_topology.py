"""Topologies by name and by position."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.config.network import NetworkConfig
from octoreplay.replay.network.topology import Topology
from reference import graph as reference
from support.long_suite import examples

NAMES = tuple(f"robot_{number}" for number in range(64))
NOWHERE = (math.nan,) * 3


def _pairs(matrix):
    np.testing.assert_array_equal(matrix, matrix.T)
    return tuple((int(i), int(j)) for i, j in np.argwhere(matrix) if i <= j)  # a robot's link to itself would show


def _links(num_robots, topology, present=None, positions=None, **network):
    made = Topology(NetworkConfig(topology=topology, **network), NAMES[:num_robots])
    positions = np.full((num_robots, 3), np.nan) if positions is None else np.array(positions, float)
    return _pairs(made.links(np.array([True] * num_robots if present is None else present), positions))


# --- by hand ---------------------------------------------------------------------------------------------------------


def test_fixed_topologies():
    assert _links(4, "complete") == ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
    assert _links(4, "ring") == ((0, 1), (0, 3), (1, 2), (2, 3))
    assert _links(4, "line") == ((0, 1), (1, 2), (2, 3))
    assert _links(4, "star") == ((0, 1), (0, 2), (0, 3))
    assert _links(4, "edges", edges=tuple((NAMES[a], NAMES[b], None) for a, b in ((3, 1), (0, 2), (2, 0)))) == (
        (0, 2),
        (1, 3),
    )


def test_grids_are_nearly_square_with_a_short_last_row():
    assert _links(2, "grid") == ((0, 1),)
    assert _links(3, "grid") == ((0, 1), (0, 2))
    assert _links(4, "grid") == ((0, 1), (0, 2), (1, 3), (2, 3))
    # a b c
    # d e
    assert _links(5, "grid") == ((0, 1), (0, 3), (1, 2), (1, 4), (3, 4))
    assert _links(9, "grid")[:4] == ((0, 1), (0, 3), (1, 2), (1, 4))
    # Ten robots: four columns, so the third row has two.
    ten = _links(10, "grid")
    assert (3, 7) in ten
    assert (4, 8) in ten
    assert (8, 9) in ten
    assert (3, 4) not in ten


@pytest.mark.parametrize("topology", ["complete", "ring", "line", "star", "grid", "random", "nearest", "range"])
def test_one_robot_has_no_link_and_two_have_one(topology):
    assert _links(1, topology, prob_link=1.0, positions=[(0, 0, 0)]) == ()
    assert _links(2, topology, prob_link=1.0, positions=[(0, 0, 0), (1, 0, 0)]) == ((0, 1),)


def test_fixed_topologies_are_induced_on_the_present_robots():
    assert _links(5, "ring", [True, True, False, True, True]) == ((0, 1), (0, 4), (3, 4))
    assert _links(4, "line", [True, False, True, True]) == ((2, 3),)
    assert _links(4, "star", [False, True, True, True]) == ()
    assert _links(4, "grid", [True, True, True, False]) == ((0, 1), (0, 2))


def test_random_links_follow_the_seed_and_are_constant():
    made = Topology(NetworkConfig(topology="random", prob_link=0.4, network_seed=3), NAMES[:12])
    everybody, nowhere = np.ones(12, bool), np.full((12, 3), np.nan)
    first = made.links(everybody, nowhere)
    np.testing.assert_array_equal(made.links(everybody, nowhere), first)
    fewer = np.arange(12) != 5
    np.testing.assert_array_equal(made.links(fewer, nowhere), first & fewer & fewer[:, None])
    assert 10 < len(_pairs(first)) < 45
    assert _pairs(first) != _links(12, "random", prob_link=0.4, network_seed=4)
    assert _links(5, "random", prob_link=0.0) == ()
    assert len(_links(5, "random", prob_link=1.0)) == 10


def test_nearest_links_need_one_end_only():
    on_a_line = [(x, 0, 0) for x in (0, 1, 3, 7)]
    assert _links(4, "nearest", num_nearest=1, positions=on_a_line) == ((0, 1), (1, 2), (2, 3))
    assert _links(4, "nearest", num_nearest=2, positions=on_a_line) == ((0, 1), (0, 2), (1, 2), (1, 3), (2, 3))
    assert len(_links(4, "nearest", num_nearest=9, positions=on_a_line)) == 6


def test_ties_of_the_nearest_go_to_the_lower_index():
    around = [(0, 0, 0), (0, 0, 1), (0, 1, 0), (0, 0, -1), (50, 0, 0)]
    assert (0, 1) in _links(5, "nearest", num_nearest=1, positions=around)
    # The three around all want robot 0, which wants only robot 1; all four are 50 or more from robot 4.
    assert _links(5, "nearest", num_nearest=1, positions=around) == ((0, 1), (0, 2), (0, 3), (0, 4))
    same_place = [(1, 1, 1)] * 4
    assert _links(4, "nearest", num_nearest=1, positions=same_place) == ((0, 1), (0, 2), (0, 3))
    # Many, since sorting a few keeps equals in order anyway.
    crowd = np.random.default_rng(1).integers(0, 3, (64, 3)).astype(float)
    expected = reference.topology_links(NetworkConfig(topology="nearest", num_nearest=5), NAMES, [crowd.tolist()])
    assert _links(64, "nearest", num_nearest=5, positions=crowd) == expected


def test_robots_without_a_pose_or_not_present_are_not_among_the_nearest():
    positions = [(0, 0, 0), (1, 0, 0), NOWHERE, (9, 0, 0)]
    assert _links(4, "nearest", num_nearest=2, positions=positions) == ((0, 1), (0, 3), (1, 3))
    assert _links(4, "nearest", [True, False, True, True], positions, num_nearest=1) == ((0, 3),)
    assert _links(4, "nearest", num_nearest=2) == ()


def test_range_links_start_below_the_range_and_end_beyond_the_hysteresis():
    made = Topology(NetworkConfig(topology="range", radio_range=10.0, range_hysteresis=2.0), NAMES[:2])

    def linked(distance, present=(True, True)):
        positions = np.array([(1.0, 2.0, 3.0), (1.0, 2.0, 3.0 + distance)])
        return _pairs(made.links(np.array(present), positions)) == ((0, 1),)

    walk = (11.0, 10.0, 9.99, 10.0, 12.0, 12.01, 11.0, 9.0, 11.0)
    assert [linked(d) for d in walk] == [False, False, True, True, True, False, False, True, True]
    assert not linked(math.nan)
    assert not linked(11.0)  # who was lost comes back below the range only
    assert linked(9.0)
    assert not linked(9.0, present=(True, False))
    assert not linked(11.0)


def test_without_hysteresis_a_link_lasts_up_to_the_range():
    made = Topology(NetworkConfig(topology="range", radio_range=10.0, range_hysteresis=0.0), NAMES[:2])
    everybody = np.ones(2, bool)
    seen = [_pairs(made.links(everybody, np.array([(0.0, 0, 0), (x, 0, 0)]))) for x in (10.0, 9.0, 10.0, 10.1)]
    assert seen == [(), ((0, 1),), ((0, 1),), ()]


# --- properties ------------------------------------------------------------------------------------------------------

_POINT = st.none() | st.tuples(*[st.integers(0, 6).map(float)] * 3)


@examples(100)
@given(st.data())
def test_every_topology_equals_the_reference_in_every_tick(data):
    num_robots = data.draw(st.integers(1, 7))
    topology = data.draw(
        st.sampled_from(["complete", "ring", "line", "star", "grid", "random", "nearest", "nearest", "range", "range"])
    )
    network = NetworkConfig(
        topology=topology,
        num_nearest=data.draw(st.integers(1, 4)),
        radio_range=data.draw(st.sampled_from([3.0, 5.0])),
        range_hysteresis=data.draw(st.sampled_from([0.0, 1.0, 3.0])),
        prob_link=data.draw(st.sampled_from([0.0, 0.3, 0.7, 1.0])),
        network_seed=data.draw(st.integers(0, 2**31)),
    )
    made = Topology(network, NAMES[:num_robots])
    history = []
    for _ in range(data.draw(st.integers(1, 6))):
        positions = data.draw(st.lists(_POINT, min_size=num_robots, max_size=num_robots))
        present = data.draw(st.lists(st.sampled_from([True, True, False]), min_size=num_robots, max_size=num_robots))
        history.append([p if is_present else None for p, is_present in zip(positions, present, strict=True)])
        expected = [
            (i, j)
            for i, j in reference.topology_links(network, NAMES[:num_robots], history)
            if present[i] and present[j]
        ]
        array = np.array([NOWHERE if p is None else p for p in positions], float)
        assert list(_pairs(made.links(np.array(present), array))) == expected
