"""Warnings on frames and clocks that do not fit together, the same from 'info', 'init' and 'run'."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from octoreplay.config.team_file import dump_team, load_team_file
from octoreplay.result import open_result
from support.command_line import assert_fails, octoreplay
from support.log_factory import IDENTITY, SECOND, Entry, robot_entries, ros2, write_mcap

FRAMES = (
    "nothing relates the map frames of a ('odom') and b ('odom'), so their maps are overlaid as if these were one "
    "frame; find T_team_map with 'octoreplay align', or give it in the team file"
)


def odometry_logs(folder: Path, second_start: int = 100) -> list[Path]:
    """Logs of two robots, each in an odometry frame of its own, the second from a time [s] on."""
    paths = []
    for name, start in (("a", 100), ("b", second_start)):
        entries = robot_entries(start_ns=start * SECOND)
        for entry in entries:
            if entry.topic == "/odom":
                entry.value.header.frame_id = "odom"
        paths.append(write_mcap(folder / f"{name}.mcap", entries))
    return paths


def warnings_in(text: str) -> list[str]:
    return [line.removeprefix("warning: ") for line in text.splitlines() if line.startswith("warning: ")]


def test_unrelated_frames_are_said_by_every_command(tmp_path: Path) -> None:
    logs, team, result = odometry_logs(tmp_path), tmp_path / "team.yaml", tmp_path / "out.mcap"
    commands = (["info", *logs], ["init", *logs, "-o", team], ["run", team, "-o", result, "--settle", "0"])
    for words in commands:
        done = octoreplay(*words)
        assert done.returncode == 0, done.stderr
        assert warnings_in(done.stderr) == [FRAMES]
    assert f"# warning: {FRAMES}\nrobots:\n" in team.read_text()
    with open_result(result) as stored:
        assert stored.summary.warnings == (FRAMES,)
        assert stored.config.robots[0].T_team_map is None


def test_strict_frames_are_an_error_before_anything_is_written(tmp_path: Path) -> None:
    logs, team, result = odometry_logs(tmp_path), tmp_path / "team.yaml", tmp_path / "out.mcap"
    for words in (["info", *logs], ["init", *logs, "-o", team], ["run", *logs, "-o", result, "--save-team", team]):
        assert_fails(2, re.escape(f"error: strict_frames: {FRAMES}"), *words, "--strict-frames")
    assert not team.exists()
    assert not result.exists()
    # A placed robot is related, also by the identity.
    assert octoreplay("run", *logs, "--save-team", team).returncode == 0
    config = load_team_file(team)
    placed = dataclasses.replace(config.robots[1], T_team_map=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    team.write_text(dump_team(dataclasses.replace(config, robots=(config.robots[0], placed))))
    done = octoreplay("run", team, "-o", result, "--settle", "0", "--strict-frames")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("second_start", "sentence", "code"),
    [
        (1_326_898_728, "the clocks of the robots have different epochs: the stamps of b (2012-01-18T14:58:48Z, ", 2),
        (300, "the logs share no time: a (100.000 s, 1.2 s); b (300.000 s, 1.2 s); if they were recorded at the ", 0),
    ],
)
def test_clocks_that_differ_are_said_by_info_and_run(
    tmp_path: Path, second_start: int, sentence: str, code: int
) -> None:
    logs = odometry_logs(tmp_path, second_start)
    info = octoreplay("info", *logs)
    run = octoreplay("run", *logs, "-o", tmp_path / "out.mcap", "--settle", "0")
    assert (info.returncode, run.returncode) == (0, code)
    said = warnings_in(info.stderr)
    assert said[1].startswith(sentence)
    # A run also knows when it mapped nothing of a robot.
    assert warnings_in(run.stderr)[: len(said)] == said


def test_a_correction_that_applies_by_default_is_shown(tmp_path: Path) -> None:
    path, _ = odometry_logs(tmp_path)
    entries = robot_entries()
    for entry in entries:
        if entry.topic == "/odom":
            entry.value.header.frame_id = "odom"
    for time in range(2):
        stamp = (100 + time) * SECOND
        tf = ros2.tf(("map", "odom", stamp, (0, time, 0), IDENTITY))
        entries.append(Entry("/tf", "tf2_msgs/msg/TFMessage", tf, stamp))
    write_mcap(path, entries)
    team, saved = tmp_path / "team.yaml", tmp_path / "saved.yaml"
    team.write_text("robots: [{id: a, log: a.mcap}]\n")
    shown = "map (poses in odom, corrected by TF)"
    assert shown in octoreplay("info", path).stdout
    assert shown in octoreplay("run", path, "--save-team", saved).stdout
    assert f"a: map frame {shown}\n" in octoreplay("run", team, "--save-team", tmp_path / "x.yaml").stdout
    assert load_team_file(saved).robots[0].map_frame == "map"
    assert octoreplay("init", path, "-o", team, "--force").returncode == 0
    note = "    # map_frame: poses in odom, corrected by TF; map_frame: odom leaves these transforms out\n"
    assert note in team.read_text()
    assert shown not in octoreplay("run", saved, "--save-team", tmp_path / "y.yaml").stdout
