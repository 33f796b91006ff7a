"""The command 'info'."""

from __future__ import annotations

from pathlib import Path

from support.command_line import octoreplay
from support.fixture_paths import FIXTURES, TRIO


def test_logs_are_described() -> None:
    done = octoreplay("info", *sorted(TRIO.glob("*.mcap")))
    assert done.returncode == 0, done.stderr
    assert "/husky_3/camera/depth/image_raw" in done.stdout
    assert "nothing is missing for a run" in done.stdout
    assert max(len(line) for line in done.stdout.splitlines()) <= 100


def test_a_log_that_cannot_be_opened_does_not_hide_the_others(tmp_path: Path) -> None:
    done = octoreplay("info", tmp_path / "none.mcap", FIXTURES / "containers" / "lz4.bag")
    assert done.returncode == 1
    assert f"error: {tmp_path / 'none.mcap'}: no such file" in done.stderr
    assert "/camera/depth/image_raw" in done.stdout
