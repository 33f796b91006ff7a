"""The command 'check', on runs of the small recorded teams."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from support.command_line import output_of
from support.fixture_paths import PAIR, PAIR_TEAM
from support.result_factory import tick_metrics, write_until

EASY = ("--max-label-disagreement", 0.001, "--min-agreement", 0.5, "--max-packet-bytes", 10**9, "--settled")


def test_kept_limits(runs: dict[str, Path]) -> None:
    text = output_of(0, "check", runs["pair"], *EASY)
    assert text.endswith("\npassed: all 4 checks\n")
    assert "FAILED" not in text
    assert output_of(0, "check", runs["pair"], "--min-num-leaves", 1).endswith("\npassed: 1 check\n")


def test_a_broken_limit_is_listed_first(runs: dict[str, Path]) -> None:
    arguments = ("check", runs["pair"], *EASY, "--max-packet-bytes", 1000)
    text = output_of(1, *arguments)
    assert text.splitlines()[2].startswith("FAILED  max packet bytes")
    assert text.endswith("\nfailed: 1 of 4 checks: max packet bytes\n")
    content = json.loads(output_of(1, *arguments, "--json"))
    assert content["result"] == str(runs["pair"])
    assert content["passed"] is False
    first = content["rows"][0]
    assert (first["name"], first["limit"], first["passed"]) == ("max_packet_bytes", 1000.0, False)
    assert first["measured"] > 1000
    assert first["robot"] in ("husky_1", "husky_2")


def test_an_unsettled_run_fails(runs: dict[str, Path]) -> None:
    text = output_of(1, "check", runs["slower"], "--settled")
    assert "stopped: " in text
    assert text.endswith("\nfailed: 1 of 1 check: settled\n")


def test_an_interrupted_run_fails(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_until(KeyboardInterrupt, tmp_path / "cut.mcap", [tick_metrics(1), tick_metrics(2)])
    text = output_of(1, "check", tmp_path / "cut.partial.mcap", "--min-agreement", 0.1)
    assert "the run was interrupted" in text
    assert text.endswith("\nfailed: 1 of 2 checks: complete\n")


def test_wrong_usage(runs: dict[str, Path]) -> None:
    sentence = "no limit given; give at least one, such as --max-label-disagreement 0.001"
    assert sentence in output_of(2, "check", runs["pair"])
    removed = output_of(2, "check", runs["pair"], "--max-team-calibration-error", 0.1)
    assert "No such option '--max-team-calibration-error': use '--max-calibration-error'" in removed
    assert "No such option '--max-fun'" in output_of(2, "check", runs["pair"], "--max-fun", 1)
    assert "is more than 1; give a share" in output_of(2, "check", runs["pair"], "--min-agreement", 99)
    assert "needs the truth; give it with --truth" in output_of(2, "check", runs["pair"], "--min-coverage", 0.5)


def test_a_file_that_is_no_result(tmp_path: Path) -> None:
    text = output_of(1, "check", PAIR_TEAM, "--min-agreement", 0.5)
    assert text.count("\n") == 1
    assert "team.yaml: not a finished MCAP file" in text


def test_limits_on_scores_against_the_truth(runs: dict[str, Path]) -> None:
    world = PAIR / "world.npz"
    text = output_of(0, "check", runs["pair"], "--truth", world, "--min-coverage", 0.5, "--min-mean-iou", 0.05)
    assert text.endswith("\npassed: all 2 checks\n")
    assert "failed: 1 of 1 check" in output_of(1, "check", runs["pair"], "--truth", world, "--min-coverage", 1)
