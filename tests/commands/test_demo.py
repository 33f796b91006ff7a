"""The command 'demo'."""

from __future__ import annotations

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
        "figures/disagreement.png", "figures/frames.png",
    )  # fmt: skip
    for name in files:
        assert (tmp_path / "show" / name).stat().st_size > 0
    assert "Foxglove" in done.stdout
    assert f"octoreplay run {Path('show/aligned.yaml')} -o {Path('show/gradient.mcap')} --rule gradient" in done.stdout
    before, after = re.findall(r"^(?:as in the logs|found) .*", done.stdout, re.M)
    assert "%" in before
    assert "%" in after
    assert_fails(1, "show.*logs: is not empty; use a new folder", "demo", tmp_path / "show")


def test_a_demo_needs_two_robots() -> None:
    assert_fails(2, "'--robots': 1 is not in the range", "demo", "--robots", 1)
