"""Number of times that a log is opened: once for the survey and once for reading."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path

import pytest

from octoreplay import cli
from octoreplay.config.team_file import load_team_file
from octoreplay.io.containers import logs
from octoreplay.io.robots.discover import discover, resolve
from octoreplay.io.robots.survey import LogSurveys
from octoreplay.replay.run import replay_team
from octoreplay.study.teams import is_replayed, replayed_team

PAIR = Path(__file__).parents[2] / "fixtures" / "pair"
LOGS = sorted(PAIR.glob("*.mcap"))


@pytest.fixture
def openings(monkeypatch):
    """Number of openings by log."""
    counts: Counter[Path] = Counter()

    class CountedLog(logs.McapLog):
        def __init__(self, path: Path) -> None:
            counts[path] += path in LOGS
            super().__init__(path)

    monkeypatch.setattr(logs, "McapLog", CountedLog)
    return counts


def test_run_opens_every_log_twice(openings, tmp_path):
    options = ["--duration", "0.5", "--settle", "0", "-o", str(tmp_path / "out.mcap")]
    assert cli._exit_code(["run", *map(str, LOGS), *options]) == 0
    assert openings == dict.fromkeys(LOGS, 2)


def test_run_of_a_team_file_opens_every_log_twice(openings, tmp_path):
    options = ["--duration", "0.5", "--settle", "0", "-o", str(tmp_path / "out.mcap")]
    assert cli._exit_code(["run", str(PAIR / "team.yaml"), *options]) == 0
    assert openings == dict.fromkeys(LOGS, 2)


def test_a_study_opens_every_log_twice(openings, tmp_path):
    config = load_team_file(PAIR / "team.yaml").with_parameters({"duration": 0.5, "settle": 0})
    result = replayed_team(config, tmp_path / "out.mcap")
    assert openings == dict.fromkeys(LOGS, 2)
    assert is_replayed(config, result)
    assert openings == dict.fromkeys(LOGS, 3)


def test_hiding_robots_takes_one_more_reader(openings):
    team = load_team_file(PAIR / "team.yaml")
    robots = tuple(dataclasses.replace(robot, body_box=(-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)) for robot in team.robots)
    config = dataclasses.replace(team, robots=robots)
    replay_team(config.with_parameters({"duration": 0.5, "settle": 0, "hide_robots": True}), None)
    assert openings == dict.fromkeys(LOGS, 3)


def test_a_resolved_run_is_not_surveyed_again(openings):
    config = resolve(load_team_file(PAIR / "team.yaml"))
    assert openings == dict.fromkeys(LOGS, 1)
    assert resolve(config) is config
    assert resolve(config.with_parameters({"rule": "bayes"})).robots == config.robots
    assert openings == dict.fromkeys(LOGS, 1)


def test_surveys_are_shared(openings):
    with LogSurveys() as surveys:
        found = discover(LOGS, surveys)
        config = resolve(load_team_file(PAIR / "team.yaml"), surveys)
        assert [robot.depth_topic for robot in found] == [robot.depth_topic for robot in config.robots]
    assert openings == dict.fromkeys(LOGS, 1)
