"""A run with bounds, and the same box cut out of a run without them, have the same cells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.team_file import load_team_file
from octoreplay.errors import ConfigError
from octoreplay.io.robots.discover import resolve
from octoreplay.replay.run import replay_team
from octoreplay.result import open_result
from octoreplay.stored_map import StoredMap
from support.fixture_paths import PAIR_TEAM

# A side on the centre of a cell of 0.3 m, others on its border and inside of it.
BOUNDS = (-21.5 * 0.3, -7.0, -1.2, 5.1, 9.14, 2.2)


def run(folder: Path, name: str, **parameters: object) -> Path:
    path = folder / name
    config = load_team_file(PAIR_TEAM).with_parameters({"state_every": 2.0, "evidence_every": 2.0, **parameters})
    replay_team(resolve(config), path)
    return path


def assert_equal(a: StoredMap, b: StoredMap) -> None:
    left, right = a.leaves(), b.leaves()
    assert len(left) or a.tick == 0
    for name in ("centers", "sizes", "log_odds"):
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name))


@pytest.mark.parametrize("rule", ["gradient", "bayes", "flood"])
@pytest.mark.parametrize("bounds", [BOUNDS, (0.45, 1.8)])
def test_a_cut_of_a_run_is_a_run_in_the_box(tmp_path: Path, rule: str, bounds: tuple[float, ...]) -> None:
    # The number of settling ticks depends on all cells.
    whole = run(tmp_path, "whole.mcap", rule=rule, settle=0)
    inside = run(tmp_path, "inside.mcap", rule=rule, settle=0, bounds=bounds)
    with open_result(whole) as first, open_result(inside) as second:
        for robot_id in (*first.robots, "central"):
            for tick in second.stored_ticks(robot_id)[::3]:
                assert_equal(first.map(robot_id, tick=tick, bounds=bounds), second.map(robot_id, tick=tick))
        for robot_id in first.robots:
            assert_equal(first.evidence(robot_id, bounds=bounds), second.evidence(robot_id))


def test_maps_in_a_box_are_cut_out_of_the_whole_maps(pair_result: Path) -> None:
    with open_result(pair_result) as result:
        for tick in result.stored_ticks("husky_2")[::4]:
            part = result.map("husky_2", tick=tick, bounds=BOUNDS)
            whole = result.map("husky_2", tick=tick)
            assert_equal(part, whole.cut(BOUNDS))
            assert (part.tick, part.num_robots, part.frame_id) == (whole.tick, whole.num_robots, whole.frame_id)
            assert tick == 0 or 0 < part.octree.num_cells < whole.octree.num_cells
        assert result.map("husky_1", bounds=(90, 90, 0, 95, 95, 5)).leaves().sizes.size == 0


@pytest.mark.parametrize(
    ("bounds", "sentence"),
    [((2, 1), "every minimum must be below its maximum"), ((0, 1, 2), "expects 2 or 6 numbers, got 3"),
     ((0.0, np.nan), "expects finite numbers"), ((0.5, 0.7), "no cell of the map has its centre in the box")],
)  # fmt: skip
def test_wrong_boxes_are_refused(pair_result: Path, bounds: tuple[float, ...], sentence: str) -> None:
    with open_result(pair_result) as result:
        with pytest.raises(ConfigError, match=f"bounds: {sentence}"):
            result.map("husky_1", bounds=bounds)
        with pytest.raises(ConfigError, match=f"bounds: {sentence}"):
            result.map("husky_1").cut(bounds)


@pytest.mark.parametrize("depth", [0, 20, -3])
def test_wrong_depths_are_refused(pair_result: Path, depth: int) -> None:
    with open_result(pair_result) as result, pytest.raises(ConfigError, match=r"max_depth: .* from 1 to 19"):
        result.map("husky_1").coarsened(depth)
