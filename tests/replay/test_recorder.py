"""Maps stored in a result."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from octoreplay.config.network import ScheduleEntry
from octoreplay.config.team_file import load_team_file, parse_team
from octoreplay.errors import ConfigError
from octoreplay.io.messages.ros_types import typestore
from octoreplay.replay.run import replay_team
from octoreplay.result import open_result
from support.fixture_paths import PAIR_TEAM, TRIO_TEAM


def test_the_centralised_map_is_the_sum_of_the_robots_evidence(tmp_path: Path) -> None:
    config = load_team_file(PAIR_TEAM).with_parameters({"rule": "local", "state_every": 1.0, "prob_free": 0.7})
    replay_team(config, tmp_path / "result.mcap")
    with open_result(tmp_path / "result.mcap") as result:
        num_stored = 0
        for maps in result.history():
            central = maps["central"]
            points = central.leaves().centers
            deviations = [maps[robot_id].query(points).log_odds - central.prior for robot_id in result.robots]
            np.testing.assert_allclose(central.query(points).log_odds - central.prior, sum(deviations), atol=1e-5)
            assert {stored.tick for stored in maps.values()} == {central.tick}
            num_stored += 1
        assert num_stored == len(result.stored_ticks("central")) > 1
        assert result.map("central").num_robots == 1


def test_the_name_of_the_centralised_map_is_refused_as_a_robot_id(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="robot id 'central': is the name of the centralised map"):
        parse_team("robots: [{id: central, log: a.mcap}]", name="team.yaml", folder=tmp_path)


def _num_robots(path: Path, **parameters: object) -> dict[str, list[int]]:
    """Number of robots that each stored map is the mean of, by robot, with robots 2 and 3 apart from 2 s on."""
    groups = ScheduleEntry(2.0, groups=(("husky_1",), ("husky_2", "husky_3")))
    config = load_team_file(TRIO_TEAM).with_parameters(
        {"state_every": 1.0, "settle": 0, "resolution": 1.0, **parameters}
    )
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, schedule=(groups,)))
    replay_team(config, path)
    with open_result(path) as result:
        ids = (*result.robots, "central")
        assert [result.evidence(robot_id).num_robots for robot_id in result.robots] == [1, 1, 1]
        return {name: [result.map(name, tick=tick).num_robots for tick in result.stored_ticks(name)] for name in ids}


def test_a_map_is_the_mean_of_the_robots_of_its_component(tmp_path: Path) -> None:
    found = _num_robots(tmp_path / "bayes.mcap")
    # All are dormant in tick 0, and together in tick 1.
    assert found == {
        "husky_1": [1, 3, 1, 1, 1, 1], "husky_2": [1, 3, 2, 2, 2, 2], "husky_3": [1, 3, 2, 2, 2, 2],
        "central": [1, 1, 1, 1, 1, 1],
    }  # fmt: skip


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [({"rule": "flood"}, 3), ({"rule": "local"}, 1), ({"rule": "merge"}, 1),
     ({"rule": "weighted"}, 1), ({"rule": "latest"}, 1),
     ({"rule": "gradient", "evidence": "time-average"}, 1)],
    ids=str,
)  # fmt: skip
def test_maps_of_other_rules(tmp_path: Path, parameters: dict[str, object], expected: int) -> None:
    found = _num_robots(tmp_path / "out.mcap", **parameters)
    assert {number for name in ("husky_1", "husky_2", "husky_3") for number in found[name][1:]} == {expected}
    assert set(found["central"]) == {1}


def test_a_dormant_robot_keeps_the_number_of_its_map(tmp_path: Path) -> None:
    config = load_team_file(PAIR_TEAM).with_parameters({"settle": 0, "resolution": 1.0})
    off = (ScheduleEntry(2.0, robots_off=("husky_2",)),)
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, schedule=off))
    replay_team(config, tmp_path / "out.mcap")
    with open_result(tmp_path / "out.mcap") as result:
        assert [robot.active for robot in result.summary.last.robots] == [True, False]
        assert [result.map(robot_id).num_robots for robot_id in result.robots] == [1, 2]


def test_maps_are_stored_as_cubes_on_request_and_at_the_end(tmp_path: Path) -> None:
    config = load_team_file(PAIR_TEAM).with_parameters(
        {"settle": 0, "resolution": 1.0, "markers_every": 2.0, "view_every": 1e6}
    )
    replay_team(config, tmp_path / "out.mcap")
    with AnyReader([tmp_path / "out.mcap"], default_typestore=typestore()) as reader:
        seen: dict[str, list[Any]] = {}
        for connection, _, raw in reader.messages():
            if connection.topic in ("/husky_1/markers", "/husky_1/map"):
                seen.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    markers, (*_, cloud) = seen["/husky_1/markers"], seen["/husky_1/map"]
    assert len(markers) > len(seen["/husky_1/map"]) > 0
    assert all(message.markers[0].action == 3 for message in markers)
    # The last message of both has the map of the last tick.
    assert sum(len(marker.points) for marker in markers[-1].markers) == cloud.width > 0
    assert markers[-1].markers[0].header.stamp == cloud.header.stamp
