"""Rule ratio on small teams whose links and robots fail."""

from __future__ import annotations

import numpy as np
import pytest

from octoreplay.config.network import ScheduleEntry
from support.faulty_team import (
    ONE_WAY_RING,
    RATIO_TOLERANCE,
    assert_all_have_the_oracle,
    configured,
    dense,
    finished_run,
    known_cells,
    oracle_errors,
    session_of,
)
from support.long_suite import long, one_in


def test_ratio_without_faults_mixes_linearly_and_then_adds_the_new_evidence():
    """On a complete graph its shares are the default weights: h <- (I - L) h + s now - s before."""
    num_joined = []
    maps, evidence, known = 0.0, 0.0, False
    for tick in session_of(configured(rule="ratio", settle=0)).ticks():
        before, evidence = evidence, np.array([dense(octree) for octree in tick.evidence])
        weights = tick.graph.weights
        maps = np.broadcast_to(maps, evidence.shape)
        maps = maps + np.einsum("ij,jmc->imc", weights - np.diag(weights.sum(axis=1)), maps) + evidence - before
        known = np.broadcast_to(known, maps.shape[:2])
        known = known | ((weights > 0) @ known) | np.array([known_cells(octree) for octree in tick.evidence])
        for octree, expected, cells in zip(tick.maps, maps, known, strict=True):
            np.testing.assert_allclose(dense(octree), expected, rtol=0, atol=RATIO_TOLERANCE)
            np.testing.assert_array_equal(known_cells(octree), cells)
        num_joined.append(len(tick.graph.active))
    assert num_joined[1] == 3
    assert num_joined[-1] == 4
    assert np.abs(maps).max() > 2.0


GROUPS = (("robot_0", "robot_1"), ("robot_2", "robot_3"))
RATIO_FAULTS = {
    "partition, loss and latency": {
        "topology": "ring", "schedule": (ScheduleEntry(4.0, 9.0, groups=GROUPS),), "loss": 0.2, "latency": 0.6,
        "network_seed": 1,
    },
    "loss and latency": {"topology": "ring", "loss": 0.3, "latency": 0.6, "network_seed": 1},
    "bursts and jitter": {"topology": "line", "burst_start": 0.2, "latency": 0.5, "jitter": 0.5, "network_seed": 2},
    "rate": {"topology": "ring", "rate": 8000.0},
    "broadcast": {"topology": "ring", "cast": "broadcast", "loss": 0.3, "network_seed": 1},
    "one-way ring": {"topology": "ring", "one_way": ONE_WAY_RING},
    "silence": {"topology": "ring", "schedule": (ScheduleEntry(4.0, 9.0, robots_silent=("robot_1",)),)},
    "partition": {"topology": "ring", "schedule": (ScheduleEntry(4.0, 9.0, groups=GROUPS),)},
    "links that come and go": {
        "topology": "ring", "loss": 0.2, "schedule": (
            ScheduleEntry(3.0, 6.0, links_down=(("robot_0", "robot_1"),)),
            ScheduleEntry(5.0, 9.0, links_up=(("robot_0", "robot_2"),)),
            ScheduleEntry(7.0, 10.0, links_down=(("robot_0", "robot_1"), ("robot_2", "robot_3"))),),
    },
    "a robot was off": {"topology": "ring", "schedule": (ScheduleEntry(4.0, 9.0, robots_off=("robot_1",)),)},
    "newcomer": {"topology": "ring", "schedule": (ScheduleEntry(0.0, 9.0, robots_off=("robot_3",)),)},
    "different periods": {"topology": "ring", "robots": {"robot_1": {"publish_period": 3.0, "publish_phase": 1.0}}},
}  # fmt: skip


@long
@pytest.mark.parametrize("name", one_in(6, RATIO_FAULTS))
def test_ratio_ends_with_the_oracle_despite_faults(name):
    _, tick = finished_run(rule="ratio", **RATIO_FAULTS[name])
    assert tick.graph.active == (0, 1, 2, 3)
    assert_all_have_the_oracle(tick, RATIO_TOLERANCE)


@long
def test_on_one_way_links_bayes_drifts_and_ratio_does_not():
    deviations = {
        rule: oracle_errors(finished_run(rule=rule, topology="ring", one_way=ONE_WAY_RING)[1])
        for rule in ("ratio", "bayes")
    }
    assert (deviations["bayes"] > 10 * deviations["ratio"].max()).all()
    assert (deviations["bayes"] > 0.5).all()
