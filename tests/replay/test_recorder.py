"""Maps stored in a result."""

from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.team_file import load_team_file, parse_team
from octoreplay.errors import ConfigError
from octoreplay.replay.run import replay_team
from octoreplay.result import open_result
from support.fixture_paths import PAIR_TEAM


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
