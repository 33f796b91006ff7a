"""Limits of a run: refused in one sentence before the replay, and long runs in fast motion."""

from __future__ import annotations

from pathlib import Path

import pytest

from octoreplay.config.fields import MAX_TICKS
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import MAX_ROBOTS, RunConfig
from octoreplay.errors import ConfigError
from support.command_line import assert_fails
from support.fixture_paths import PAIR, PAIR_TEAM
from support.long_suite import long


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--settle", 10**9, "--latency", 100), r"settle: 1000000000 is above the largest value 1e\+07"),
        (("--settle-max", 10**9), r"settle_max: 1000000000 is above the largest value 1e\+07"),
        (("--settle", MAX_TICKS), r"settle, latency: 10,000,000 settling ticks after \d+ ticks of logs are more than"),
        (("--latency", 1e9), r"settle, latency: 1,000,000,000 settling ticks after \d+ ticks of logs are more than"),
        (("--gamma-power", 1e9), r"gamma_power: 1000000000.0 is above the largest value 10"),
        (("--publish-period", 1e-9), r"publish_period: the logs span .* which takes .* ticks of 1e-09 s, more than"),
    ],
)
def test_settings_that_would_never_end_are_refused(
    tmp_path: Path, arguments: tuple[object, ...], sentence: str
) -> None:
    assert_fails(2, sentence, "run", PAIR_TEAM, "-o", tmp_path / "out.mcap", *arguments)
    assert not list(tmp_path.iterdir())


@long
def test_more_robots_than_a_run_can_have_are_refused(tmp_path: Path) -> None:
    robots = [RobotConfig(f"r{index}", (PAIR / "husky_1.mcap",)) for index in range(MAX_ROBOTS + 100)]
    with pytest.raises(ConfigError, match="robots: 1,100 robots are more than 1,000"):
        RunConfig(tuple(robots))
    team = tmp_path / "team.yaml"
    team.write_text("robots:\n" + "".join(f"- {{id: {r.robot_id}, log: {r.logs[0]}}}\n" for r in robots))
    assert_fails(2, "1,100 robots are more than 1,000", "run", team, "-o", tmp_path / "out.mcap")
    RunConfig(tuple(robots[:MAX_ROBOTS]))
