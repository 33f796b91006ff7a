"""The command 'demo'."""

from __future__ import annotations

from pathlib import Path

import pytest

from support.command_line import assert_fails, octoreplay
from support.long_suite import long


@long
def test_demo_writes_every_file(tmp_path: Path) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    done = octoreplay("demo", "show", "--robots", 2, "--duration", 3, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    files = (
        "logs/team.yaml", "logs/world.ply", "result.mcap", "map.ply", "metrics.csv", "figures/disagreement.png",
    )  # fmt: skip
    for name in files:
        assert (tmp_path / "show" / name).stat().st_size > 0
    assert "Foxglove" in done.stdout
    assert_fails(1, "show.*logs: is not empty; use a new folder", "demo", tmp_path / "show")
