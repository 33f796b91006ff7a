"""The option --align of 'run' with a value, and settings that do not go with it."""

from __future__ import annotations

from pathlib import Path

import pytest

from octoreplay.commands.running import _with_align_values
from octoreplay.config.network import ScheduleEntry
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.errors import ConfigError
from octoreplay.result import open_result
from support.command_line import octoreplay
from support.log_factory import robot_entries, write_mcap
from support.long_suite import long


@pytest.mark.parametrize(("given", "parsed"), [
    (["--align", "a.mcap", "-o", "b"], ["--align=before", "a.mcap", "-o", "b"]),
    (["a.mcap", "--align"], ["a.mcap", "--align=before"]),
    (["--align", "on-air", "a.mcap"], ["--align=on-air", "a.mcap"]),
    (["--align", "--rule", "bayes"], ["--align=before", "--rule", "bayes"]),
    (["--align=off", "a"], ["--align=off", "a"]),
    (["--", "--align", "on-air"], ["--", "--align", "on-air"]),
])  # fmt: skip
def test_align_stands_without_a_value(given, parsed):
    assert list(_with_align_values(given)) == parsed


@pytest.mark.parametrize(("parameters", "message"), [
    ({"topology": "range"}, "topology 'range' needs"),
    ({"topology": "nearest"}, "topology 'nearest' needs"),
    ({"bounds": (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)}, "give ZMIN,ZMAX"),
    ({"hide_robots": True}, "hide_robots: needs"),
    ({"align_every": 0.0}, "align_every"),
    ({"align": "later"}, "not one of off, on-air"),
])  # fmt: skip
def test_settings_that_need_one_frame_from_the_beginning_are_refused(parameters, message):
    robots = (RobotConfig("a", (Path("a.mcap"),), body_box=(-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)),)
    with pytest.raises(ConfigError, match=message):
        RunConfig(robots).with_parameters({"align": "on-air", **parameters})


def test_a_robot_without_memory_is_refused():
    robots = tuple(RobotConfig(name, (Path(f"{name}.mcap"),)) for name in "ab")
    network = RunConfig(robots).network
    entry = ScheduleEntry(1.0, 2.0, robots_off=("a",), forget=True)
    schedule = type(network)(schedule=(entry,))
    with pytest.raises(ConfigError, match="'forget' does not go with align 'on-air'"):
        RunConfig(robots, network=schedule).with_parameters({"align": "on-air"})


@long
def test_a_team_that_never_joins_ends_with_a_warning_and_exit_code_3(tmp_path: Path) -> None:
    logs, result, csv = [], tmp_path / "out.mcap", tmp_path / "out.csv"
    for name in ("a", "b"):
        entries = robot_entries()
        for entry in entries:
            if entry.topic == "/odom":
                entry.value.header.frame_id = "odom"
        logs.append(write_mcap(tmp_path / f"{name}.mcap", entries))
    done = octoreplay("run", *logs, "--align", "on-air", "--rule", "bayes", "-o", result)
    assert done.returncode == 3, done.stderr
    assert done.stderr.count("warning:") == 1
    assert "the robots are in 2 frames at the end" in done.stderr
    assert "2 at the end, in different frames: a; b" in done.stdout
    with open_result(result) as stored:
        assert stored.metrics[-1].num_components == 2
        assert stored.config.alignment.is_on_air
    assert octoreplay("metrics", result, "--csv", csv).returncode == 0
    header, *rows = csv.read_text().splitlines()
    assert {"num_components", "a.frame", "b.frame"} <= set(header.split(","))
    assert "a/map" in rows[-1]
    asked = octoreplay("query", result, "--robot", "b", "--point", 1, 0, 0)
    assert "frame b/map" in asked.stdout
    assert octoreplay("evaluate", result).returncode == 0
