"""Packet sizes and tolerated faults of benchmarks/packets.py, on a few seconds of three robots."""

from __future__ import annotations

import dataclasses
import functools

import pytest

from octoreplay.config.network import ScheduleEntry
from octoreplay.config.team_file import load_team_file
from octoreplay.replay.run import replay_team
from octoreplay.result import open_result
from support.fixture_paths import TRIO_TEAM
from support.long_suite import long

pytestmark = long


@functools.lru_cache(maxsize=16)
def _replayed(**parameters):
    return replay_team(load_team_file(TRIO_TEAM).with_parameters(parameters), None)


def _worst(summary):
    return min(min(robot.agreement, robot.agreement_occupied) for robot in summary.last.robots)


@pytest.mark.parametrize(("rule", "octree", "packet"), [("bayes", 6.0, 25.0), ("gradient", 6.0, 12.0)])
def test_exact_whole_maps_are_much_smaller_than_the_grid(rule, octree, packet):
    summary = _replayed(rule=rule)
    assert summary.mean_grid_bytes > octree * summary.mean_octree_bytes
    assert summary.mean_grid_bytes > packet * summary.mean_packet_bytes


@pytest.mark.parametrize(("rule", "times"), [("bayes", 50.0), ("flood", 100.0)])
def test_small_packets_keep_the_agreement(rule, times):
    """The factor is lower than the 200 of one-minute logs, because most cells of a short log are new."""
    exact, small = _replayed(rule=rule), _replayed(rule=rule, packets="delta", content="int8")
    assert small.mean_grid_bytes > times * small.mean_packet_bytes
    assert abs(_worst(small) - _worst(exact)) <= 0.002


def test_ratio_tolerates_losses_and_delays_on_a_ring():
    peak = _replayed(rule="ratio", topology="ring").peak_total_distance_all
    summary = _replayed(rule="ratio", topology="ring", loss=0.3, latency=0.2, jitter=0.1)
    assert summary.last.total_distance_all < 1e-6 * peak
    assert _worst(summary) >= 0.999


def test_flood_tolerates_a_loss_of_99_percent():
    assert _worst(_replayed(rule="flood", loss=0.99)) >= 0.999


@pytest.mark.parametrize("rule", ["bayes", "ratio"])
def test_a_merged_team_agrees_within_ten_ticks(rule, tmp_path):
    """The partition ends with the logs, so that new scans do not hide its remains."""
    config = load_team_file(TRIO_TEAM).with_parameters({"rule": rule, "settle_max": 10})
    robot_ids = [robot.robot_id for robot in config.robots]
    whole = replay_team(config, None)
    merge = whole.num_ticks - whole.num_settling_ticks - 1
    apart = (ScheduleEntry(1.0, float(merge), groups=((robot_ids[0],), tuple(robot_ids[1:]))),)
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, schedule=apart))
    replay_team(config, tmp_path / "result.mcap")
    with open_result(tmp_path / "result.mcap") as result:
        distances = [tick.total_distance_all for tick in result.metrics]
    peak = max(distances[:merge])
    assert peak > 1000.0
    assert min(distances[merge : merge + 10]) < 0.01 * peak
