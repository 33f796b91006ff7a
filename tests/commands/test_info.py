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


def test_a_team_file_is_no_log_and_the_command_that_takes_it_is_named(tmp_path: Path) -> None:
    team = tmp_path / "my team.yaml"
    team.write_text("robots: {}\n")
    done = octoreplay("info", team)
    assert done.returncode == 1
    assert f"not a log; for a team file use 'octoreplay run '{team}'', or name its logs" in done.stderr


def test_info_and_run_refuse_the_same_logs(trio_result: Path, tmp_path: Path) -> None:
    refused = (FIXTURES / "containers" / "lz4.bag", trio_result)
    for path in refused:
        assert octoreplay("info", path).returncode == 1
        assert octoreplay("run", path, "-o", tmp_path / "x.mcap").returncode != 0
    done = octoreplay("run", trio_result, "-o", tmp_path / "x.mcap")
    sentence = (
        "is a result of octoreplay, not a log; give its logs, or repeat its run with 'octoreplay run --config-from "
    )
    assert done.returncode == 1
    for stderr in (done.stderr, octoreplay("info", trio_result).stderr):
        assert sentence in stderr
    assert list(tmp_path.iterdir()) == []
