"""The command 'init'."""

from __future__ import annotations

from pathlib import Path

from octoreplay.config.team_file import load_team_file
from octoreplay.result import open_result
from support.command_line import assert_fails, octoreplay
from support.fixture_paths import FIXTURES, PAIR


def test_the_written_team_file_gives_the_maps_of_the_logs(tmp_path: Path) -> None:
    logs = sorted(PAIR.glob("*.mcap"))
    team_file = tmp_path / "team.yaml"
    done = octoreplay("init", *logs, "-o", team_file)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"wrote {team_file} (2 robots)\n", "")
    assert load_team_file(team_file).robots[0].pose_topic == "/husky_1/odom"
    assert_fails(
        1, f"error: {team_file}: already exists; give another name, or use --force", "init", *logs, "-o", team_file
    )
    assert octoreplay("init", *logs, "-o", team_file, "--force").returncode == 0
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    assert octoreplay("run", team_file, "-o", first, "--settle", "0").returncode == 0
    assert octoreplay("run", *logs, "-o", second, "--settle", "0").returncode == 0
    with open_result(first) as one, open_result(second) as other:
        for robot in one.robots:
            assert (one.map(robot).leaves().log_odds == other.map(robot).leaves().log_odds).all()


def test_missing_inputs_are_reported(tmp_path: Path) -> None:
    team_file = tmp_path / "team.yaml"
    done = octoreplay("init", FIXTURES / "containers" / "foxglove_json.mcap", "-o", team_file)
    assert done.returncode == 0
    assert "missing for a run: no LabelInfo names the labels on " in done.stderr
    (tmp_path / "empty.bag").touch()
    assert_fails(1, "the file is empty", "init", tmp_path / "empty.bag", "-o", tmp_path / "x.yaml")
    assert not (tmp_path / "x.yaml").exists()
