"""Publishing, restarts and determinism of whole runs."""

from __future__ import annotations

import dataclasses
import itertools
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from octoreplay.config.network import ScheduleEntry
from octoreplay.config.rules import RULES
from octoreplay.config.team_file import load_team_file
from octoreplay.errors import InputError
from octoreplay.replay import session as session_module
from octoreplay.replay.exchange.packet_codec import PacketCodec
from octoreplay.replay.exchange.public_map import PublicMap
from octoreplay.replay.run import replay_team
from octoreplay.replay.session import Session
from octoreplay.result import open_result
from reference.comparison import compare_map
from reference.scenarios import START_NS
from reference.twin import Twin
from support.faulty_team import (
    FLOOD_TOLERANCE,
    PACKETS,
    PERIOD_NS,
    configured,
    dense,
    oracle_errors,
    recording,
    scenario,
    session_of,
    team_sums,
)
from support.fixture_paths import PAIR_TEAM
from support.sessions import FrameList, sent_packets


@pytest.mark.parametrize("rule", ["flood", "bayes"])
def test_stored_maps_after_a_restart_equal_the_metrics(rule, tmp_path):
    """The first stored map of a restart epoch is a whole map, because a delta removes no bricks."""
    schedule = (ScheduleEntry(2.0, 3.0, robots_off=("husky_1",), forget=True),)
    config = load_team_file(PAIR_TEAM)
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, schedule=schedule))
    config = config.with_parameters({"rule": rule, "state_every": 1.0, "loss": 1.0, "settle": 0})
    replay_team(config, tmp_path / "result.mcap")
    with open_result(tmp_path / "result.mcap") as result:
        assert len(result.metrics) > 3
        for metrics in result.metrics:
            for robot in metrics.robots:
                stored = result.map(robot.robot_id, tick=metrics.tick).leaves()
                volume = (stored.sizes**3).sum()
                assert volume == pytest.approx(robot.observed_volume, abs=1e-6)
                assert robot.active == (metrics.tick > 0 and (robot.robot_id, metrics.tick) != ("husky_1", 2))


@pytest.mark.parametrize(
    ("mode", "parameters"),
    [("sync", {"topology": "complete"}), ("on-arrival", {"topology": "line"}), ("sync", {"merge_weight": 0.7}),
     ("on-arrival", {"topology": "line", "merge_weight": 0.45}), ("sync", {"merge_maps": 1, "merge_weight": 0.9}),
     ("on-arrival", {"merge_maps": 2})],
    ids=str,
)  # fmt: skip
def test_merge_equals_its_twin(mode, parameters):
    config = configured(rule="merge", mode=mode, settle=0, **parameters)
    twin = Twin(config, recording(), with_metrics=False)
    saturated = 0
    for expected, tick in itertools.zip_longest(twin.ticks(), session_of(config).ticks()):
        for robot, octree in enumerate(tick.maps):
            difference = compare_map(recording().keys, expected, robot, octree.leaves(), config.map.resolution)
            assert (difference.missing, difference.spurious, difference.overlapping) == (0, 0, 0)
            assert difference.max_abs < 5e-5
        saturated = int((np.abs(expected.maps) == 5.0).any(axis=2).sum())
    # Evidence that is received repeatedly saturates.
    assert saturated > 500


RANDOM_RADIO = {"loss": 0.3, "latency": 1.1, "jitter": 0.9, "corruption": 0.1, "settle": 3, "settle_max": 5}


@pytest.mark.parametrize(
    ("rule", "packets"),
    [("flood", "delta"), ("flood", "key frames, broadcast"), ("bayes", "delta"), ("ratio", "full")],
)
def test_the_same_seed_gives_the_same_run_in_any_number_of_threads(rule, packets):
    def run(seed, num_threads):
        config = configured(rule=rule, topology="ring", network_seed=seed, **RANDOM_RADIO, **PACKETS[packets])
        return ((t.metrics, sent_packets(t)) for t in session_of(config, num_threads).ticks())

    one = list(run(0, 1))
    assert list(run(0, 2)) == one
    # Ends at the first tick with a difference.
    assert any(other[0] != first[0] for other, first in zip(run(1, 1), one, strict=False))
    assert sum(link.num_lost for metrics, _ in one for link in metrics.links) > 5


@pytest.mark.parametrize(("radio", "keeps"), [({}, False), ({"latency": 1.5}, True)], ids=["at once", "late"])
def test_versions_are_kept_only_for_receivers_that_need_them(monkeypatch, radio, keeps):
    """Receivers share the sender's state here; those that decode packets keep what they hold."""
    monkeypatch.setattr(PacketCodec, "always_decodes", False)
    saved = []
    right = PublicMap._save
    monkeypatch.setattr(
        PublicMap, "_save", lambda self, codes: (saved.append(len(self._snapshots)), right(self, codes))
    )
    for tick in session_of(configured(rule="bayes", topology="ring", settle=0, **radio)).ticks():
        del tick
    assert len(saved) > 10
    assert any(saved) == keeps


@pytest.mark.parametrize("rule", ["natural", "flood", "ratio"])
def test_robots_publish_when_they_are_due(rule):
    robots = {"robot_0": {"publish_period": 3.0, "publish_phase": 1.0}, "robot_1": {"publish_period": 2.0}}
    session = session_of(configured(rule=rule, robots=robots, settle=3, settle_max=6))
    for tick in session.ticks():
        due = {0: tick.number % 3 == 1, 1: tick.number % 2 == 0, 2: True, 3: True}
        for index in range(4):
            is_due = due[index] and index in tick.graph.active
            assert (tick.published[index] is not None) == is_due
            sent = {link.num_sent for link in tick.metrics.links if link.sender == f"robot_{index}"}
            assert sent <= ({0, int(is_due)} if rule == "flood" else {int(is_due)})
    assert tick.number > 6


@pytest.mark.parametrize("rule", ["natural", "bayes", "flood", "ratio"])
def test_a_silent_robot_receives_and_sends_nothing(rule):
    schedule = (ScheduleEntry(3.0, 9.0, robots_silent=("robot_1",)),)
    session = session_of(configured(rule=rule, schedule=schedule, settle=0))
    during = None
    for tick in session.ticks():
        is_silent = 3 <= tick.number < 9
        links = tick.metrics.links
        sent = sum(link.num_sent for link in links if link.sender == "robot_1")
        heard = sum(link.num_delivered for link in links if link.receiver == "robot_1")
        if is_silent:
            assert sent == 0
            assert all(1 not in tick.graph.senders(other) for other in range(4))
        if tick.number >= 1:
            assert heard == len(tick.graph.senders(1)) > 0
            assert is_silent or sent > 0
        if tick.number == 8:
            during = team_sums(tick)
    others = dense(session.team.robots[0].evidence.octree) != 0
    assert np.abs(during[1] - during[0]).max() > 1.0
    assert (during[1] != 0)[others].mean() > 0.5
    if rule == "flood":
        assert oracle_errors(tick).max() < FLOOD_TOLERANCE


def test_frames_beyond_the_largest_number_of_ticks_end_the_run(monkeypatch):
    monkeypatch.setattr(session_module, "MAX_TICKS", 50)
    config = configured(settle=0)
    frames = [frame for frame in scenario().frames if frame.robot_id == config.robots[0].robot_id]
    ages_later = dataclasses.replace(frames[-1], stamp_ns=START_NS + 60 * PERIOD_NS)
    sources = [FrameList((*frames, ages_later)), *(FrameList(()) for _ in config.robots[1:])]
    with pytest.raises(InputError, match=r"span more than 50 ticks of 1 s; check the stamps, or give clock"):
        list(Session(config, sources, ThreadPoolExecutor(1)).ticks())


@pytest.mark.parametrize(("rule", "mode"), [(rule.name, mode) for rule in RULES.values() for mode in rule.modes])
def test_leaves_and_sizes_are_those_of_the_whole_map(rule, mode):
    schedule = (ScheduleEntry(4.0, 7.0, robots_off=("robot_1",), forget=True),)
    config = configured(rule=rule, mode=mode, topology="ring", schedule=schedule, packets="full", settle_max=6)
    session = session_of(config)
    for _ in session.ticks():
        for robot in session.team.robots:
            assert robot.size == robot.map.streams().size
