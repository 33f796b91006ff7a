"""The command 'demo'."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from octoreplay.config.team_file import load_team_file
from support.command_line import assert_fails, octoreplay
from support.long_suite import long


@long
def test_demo_finds_the_frames_and_writes_every_file(tmp_path: Path) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    done = octoreplay("demo", "show", "--robots", 3, "--duration", 30, "--seed", 2, folder=tmp_path)
    robots = load_team_file(tmp_path / "show" / "aligned.yaml").robots
    # A robot whose map shares too little with the others is left out.
    assert done.returncode == (0 if len(robots) == 3 else 3), done.stderr
    assert len(robots) >= 2
    files = (
        "logs/team.yaml", "logs/frames.yaml", "logs/world.ply", "result.mcap", "map.ply", "metrics.csv",
        "figures/disagreement.png", "figures/frames.png", "report.html", "local.mcap", "gradient.mcap",
    )  # fmt: skip
    for name in files:
        assert (tmp_path / "show" / name).stat().st_size > 0
    assert "Foxglove" in done.stdout
    rules = re.findall(r"^(local|gradient|bayes|all evidence).* ([01]\.\d{3})$", done.stdout, re.M)
    assert [name for name, _ in rules] == ["local", "gradient", "bayes", "all evidence"]
    iou = {name: float(value) for name, value in rules}
    assert iou["local"] < iou["bayes"]
    assert done.stdout.rstrip().rpartition("\n")[2] == str((tmp_path / "show" / "report.html").resolve())
    before, after = re.findall(r"^(?:as in the logs|found) .*", done.stdout, re.M)
    assert "%" in before
    assert "%" in after
    again = octoreplay("demo", "show", "--robots", 3, "--duration", 30, "--seed", 2, "--json", folder=tmp_path)
    assert again.returncode == done.returncode, again.stderr
    assert "used the team in show/logs again" in again.stderr
    assert json.loads(again.stdout)["verdict"]["has_agreed"] is True


def test_a_demo_never_writes_into_the_folder_of_something_else(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    assert_fails(1, "already exists; give another name, or use --force", "demo", tmp_path)
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "robot.mcap").write_text("mine")
    assert_fails(1, "logs: exists and holds no simulated team", "demo", tmp_path, "--force")
    assert (tmp_path / "logs" / "robot.mcap").read_text() == "mine"


def test_a_demo_needs_two_robots() -> None:
    assert_fails(2, "'--robots': 1 is not in the range", "demo", "--robots", 1)
