"""Damaged logs and logs with false messages give a map, or are refused with a sentence; nothing else is raised."""

from __future__ import annotations

import random
from functools import cache

import numpy as np
import pytest

from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.replay.run import replay_team
from support.hostile_logs import (
    FIXTURES,
    LOGS,
    MCAP_LOGS,
    MESSAGE_MUTATIONS,
    MapOutcome,
    bytes_of,
    map_of_log,
    rows_of,
    value_of,
    write_hostile_log,
)
from support.log_factory import write_rows
from support.long_suite import long, one_in

CASES = [pytest.param(range(2), id="few"), pytest.param(range(2, 30), id="many", marks=pytest.mark.long)]


@cache
def map_of_fixture(name: str) -> MapOutcome:
    """Outcome of a committed log."""
    return map_of_log(FIXTURES / name, is_run=False)


@pytest.mark.parametrize("cases", CASES)
@pytest.mark.parametrize("name", one_in(4, LOGS))
def test_a_damaged_log_gives_a_map_or_a_sentence(tmp_path, name, cases):
    good = map_of_fixture(name)
    assert good.refusal is None
    assert good.num_frames >= 4
    num_maps = 0
    for case in cases:
        path, what = write_hostile_log(name, tmp_path, random.Random(f"maps of {name} {case}"))
        try:
            outcome = map_of_log(path, is_run=case % 10 == 0)
        except Exception as error:
            raise AssertionError(f"case {case}: {what}") from error
        num_maps += outcome.num_frames > 0
    # Most damage leaves something of a log; a file compressed as a whole is one block of zstd.
    assert num_maps >= len(cases) // 6 or name.endswith("file_zstd")


@pytest.mark.parametrize("mutation", dict.fromkeys(MESSAGE_MUTATIONS))
def test_every_change_of_messages_changes_some_log(mutation):
    changed = 0
    for name in MCAP_LOGS:
        rows = list(rows_of(name))
        mutation(rows, random.Random(f"{mutation.__name__} {name}"))
        changed += rows != list(rows_of(name))
    assert changed > len(MCAP_LOGS) / 4


@long
def test_rewriting_a_log_changes_nothing(tmp_path):
    for name in MCAP_LOGS:
        path = write_rows(tmp_path / "again.mcap", rows_of(name))
        assert map_of_log(path, is_run=False) == map_of_fixture(name)


def test_one_broken_pose_does_not_end_a_run(tmp_path):
    """A finite pose a million kilometres away costs the frames beside it, and the run goes on."""
    rows = list(rows_of("pair/husky_1.mcap"))
    poses = [index for index, row in enumerate(rows) if row.schema_name == "nav_msgs/msg/Odometry"]
    middle = poses[len(poses) // 2]
    broken = value_of(rows[middle])
    broken.pose.pose.position.x = 1e9
    rows[middle] = rows[middle]._replace(data=bytes_of(rows[middle], broken))
    path = write_rows(tmp_path / "husky_1.mcap", rows)
    good = replay_team(RunConfig((RobotConfig("a", (FIXTURES / "pair/husky_1.mcap",)),)), None).frame_counts["a"]
    counts = replay_team(RunConfig((RobotConfig("a", (path,)),)), None).frame_counts["a"]
    assert counts.no_pose > 0
    assert counts.used + counts.no_pose == good.used
    assert counts.used > good.used / 2


def test_numpy_warnings_are_errors():
    with pytest.raises(RuntimeWarning):
        np.float64(1e308) * np.array([1e308])
