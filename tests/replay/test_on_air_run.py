"""Runs with align on-air from logs to stored results, with an alignment that is given."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.errors import InputError
from octoreplay.registration.pairs import PairAlignment
from octoreplay.registration.verify import CellCounts, Verification
from octoreplay.replay.alignment import stored_maps
from octoreplay.replay.joining import Joining
from octoreplay.replay.run import replay_team
from octoreplay.report.export import export_map
from octoreplay.report.plots import metrics_csv
from octoreplay.result import open_result
from octoreplay.transforms import inverse, numbers_of, pose_matrix, transform_of
from support.interrupted import resumed
from support.log_factory import robot_entries, write_mcap
from support.long_suite import long

T_A_B = pose_matrix((1.3, -0.7, 0.2), (0.0, 0.0, math.sin(0.4), math.cos(0.4)))


@pytest.fixture
def found(monkeypatch):
    """The pose between the maps of both robots is found at the first attempt."""
    nothing = CellCounts(0, 0, 0)

    def align(joining, robots, attempt, maps):
        score = Verification(nothing, nothing, 1.0, 321.0, 1.0)
        return PairAlignment(attempt.first, attempt.second, T_A_B, np.eye(6), score, "")

    monkeypatch.setattr(Joining, "_align", align)


def config(folder: Path, **parameters) -> RunConfig:
    robots = []
    for name in ("a", "b"):
        entries = robot_entries()
        for entry in entries:
            if entry.topic == "/odom":
                entry.value.header.frame_id = "odom"
        robots.append(RobotConfig(name, (write_mcap(folder / f"{name}.mcap", entries),)))
    values = {"align": "on-air", "rule": "bayes", "publish_period": 0.1, "align_every": 0.2, "state_every": 0.1}
    return RunConfig(tuple(robots)).with_parameters({**values, **parameters})


def test_a_result_holds_the_frames_before_and_after_a_join(found, tmp_path: Path) -> None:
    team = config(tmp_path)
    summary = replay_team(team, tmp_path / "air.mcap")
    (join,) = summary.joins
    assert (join.first, join.second, join.moved, join.frame_id, join.score) == ("a", "b", ("b",), "a/map", 321.0)
    assert summary.frame_origins["b"] == f"frame 'a/map' from {join.seconds:g} s on: b aligned with a, L 321"
    with open_result(tmp_path / "air.mcap") as result:
        assert dataclasses.replace(result.summary, wall_seconds=0) == dataclasses.replace(summary, wall_seconds=0)
        assert result.metrics[join.tick - 1].components == (("a",), ("b",))
        assert result.metrics[join.tick].components == (("a", "b"),)
        before, after = result.map("b", tick=join.tick - 1), result.map("b", tick=join.tick)
        assert (before.frame_id, before.num_robots) == ("b/map", 1)
        assert (after.frame_id, after.num_robots) == ("a/map", 2)
        assert result.map("central").frame_id == "a/map"
        np.testing.assert_allclose(transform_of(result.places["b"].T_frame_map), T_A_B, atol=1e-12)
        assert {stored["b"].frame_id for stored in result.history()} == {"b/map", "a/map"}
        _, T_map_own = stored_maps(result)
        np.testing.assert_allclose(T_map_own[1], inverse(T_A_B), atol=1e-12)
        assert metrics_csv(result.metrics).splitlines()[-1].count("a/map") == 2
    given = dataclasses.replace(
        team,
        robots=(
            dataclasses.replace(team.robots[0], T_team_map=numbers_of(np.eye(4))),
            dataclasses.replace(team.robots[1], T_team_map=numbers_of(T_A_B)),
        ),
    ).with_parameters({"align": "off"})
    expected = replay_team(given, tmp_path / "given.mcap")
    assert summary.frame_counts == expected.frame_counts
    with open_result(tmp_path / "air.mcap") as one, open_result(tmp_path / "given.mcap") as other:
        for robot_id in ("a", "b"):
            mine, theirs = (result.evidence(robot_id).leaves() for result in (one, other))
            np.testing.assert_array_equal(mine.centers, theirs.centers)
            np.testing.assert_array_equal(mine.log_odds, theirs.log_odds)


def test_maps_in_different_frames_are_not_exported_together(monkeypatch, tmp_path: Path) -> None:
    summary = replay_team(config(tmp_path), tmp_path / "air.mcap")
    assert summary.joins == ()
    assert any("in 2 frames at the end" in sentence and "(a; b)" in sentence for sentence in summary.warnings)
    for color in ("robot", "disagreement"):
        with pytest.raises(InputError, match="different frames \\(a in a/map, b in b/map\\)"):
            export_map(tmp_path / "air.mcap", tmp_path / "map.ply", color=color)
    assert sum(export_map(tmp_path / "air.mcap", tmp_path / "map.ply", robot="b").values()) > 0
    assert b"frame: b/map" in (tmp_path / "map.ply").read_bytes()


def test_equal_runs_give_equal_bytes(found, tmp_path: Path) -> None:
    team = config(tmp_path)
    for num_threads, name in ((1, "one.mcap"), (2, "two.mcap")):
        replay_team(team, tmp_path / name, num_threads=num_threads)
    assert (tmp_path / "one.mcap").read_bytes() == (tmp_path / "two.mcap").read_bytes()


@long
def test_a_run_resumed_before_and_after_a_join_ends_with_the_same_bytes(found, tmp_path: Path) -> None:
    team = config(tmp_path)
    summary = replay_team(team, tmp_path / "whole.mcap")
    (join,) = summary.joins
    resumed(team, tmp_path / "resumed.mcap", join.tick - 1, join.tick, join.tick + 1)
    assert (tmp_path / "resumed.mcap").read_bytes() == (tmp_path / "whole.mcap").read_bytes()
