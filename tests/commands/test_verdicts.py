"""Tests of the commands 'check' and 'compare', run as processes on results of the fixture teams."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from octoreplay.config.team_file import load_team_file
from octoreplay.evaluate.checks import CheckRow
from octoreplay.io.robots.discover import resolve
from octoreplay.replay.run import replay_team
from octoreplay.report import verdict_tables
from support.processes import octoreplay
from support.result_factory import tick_metrics, write_until

FIXTURES = Path(__file__).parents[1] / "fixtures"


def ends(code: int, *arguments: object) -> str:
    """Run a command, check its exit code, and return its output without a traceback."""
    done = octoreplay(*arguments)
    assert done.returncode == code, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr if code == 2 or not done.stdout else done.stdout


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Results by name: two robots twice, with smaller steps and other cells, and three robots."""
    folder = tmp_path_factory.mktemp("runs")
    chosen = {
        "pair": ("pair", {}), "again": ("pair", {}), "slower": ("pair", {"epsilon": 0.1, "settle": 0}),
        "near": ("pair", {"gamma": 0.49}), "finer": ("pair", {"resolution": 0.4}), "trio": ("trio", {}),
    }  # fmt: skip
    paths = {}
    for name, (team, parameters) in chosen.items():
        paths[name] = folder / f"{name}.mcap"
        config = load_team_file(FIXTURES / team / "team.yaml").with_parameters(parameters)
        replay_team(resolve(config), paths[name])
    return paths


# --- compare ----------------------------------------------------------------------------------------------------------


def test_a_result_equals_itself_and_its_repetition(runs: dict[str, Path]) -> None:
    for other in ("pair", "again"):
        text = ends(0, "compare", runs["pair"], runs[other])
        assert text.endswith("\nthe same: all cells of 3 maps\n")
        assert "logs: the same" in text
        assert "Different settings" not in text
        assert "Places of the differences" not in text


def test_a_changed_parameter_is_named(runs: dict[str, Path], tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    text = ends(1, "compare", runs["pair"], runs["slower"], "--json", report)
    assert "\ndifferent: 2 of 3 maps, in up to " in text
    content = json.loads(report.read_text(encoding="utf-8"))
    assert {(one["name"], one["value_b"]) for one in content["settings"]} == {("epsilon", 0.1), ("settle", 0)}
    assert [one["robot_id"] for one in content["maps"]] == ["husky_1", "husky_2", "central"]
    assert content["maps"][0]["num_differing"] > 0
    assert content["maps"][2]["num_differing"] == 0
    assert "the same: all cells of 1 map" in ends(0, "compare", runs["pair"], runs["slower"], "--robot", "central")


def test_maps_are_equal_within_a_tolerance(runs: dict[str, Path]) -> None:
    assert ends(1, "compare", runs["pair"], runs["near"]).splitlines()[-1].startswith("different: 2 of 3 maps")
    text = ends(0, "compare", runs["pair"], runs["near"], "--tolerance", 0.5)
    assert text.splitlines()[-1].startswith("the same within 0.5: all cells of 3 maps")


def test_a_map_that_only_one_result_has_is_named(runs: dict[str, Path]) -> None:
    text = ends(1, "compare", runs["pair"], runs["trio"])
    assert "logs: different" in text
    assert text.endswith("; only B has a map of husky_3\n")


def test_early_maps_can_be_compared(runs: dict[str, Path]) -> None:
    assert "the same" in ends(0, "compare", runs["pair"], runs["again"], "--at", 1.5)


def test_results_that_cannot_be_compared_are_reported_in_one_sentence(runs: dict[str, Path], tmp_path: Path) -> None:
    text = ends(1, "compare", runs["pair"], runs["finer"])
    assert text.count("\n") == 1
    assert "finer.mcap: the resolution is 0.4 m" in text
    text = ends(1, "compare", runs["pair"], FIXTURES / "pair" / "husky_1.mcap")
    assert text.count("\n") == 1
    assert "no result of octoreplay" in text
    assert "cannot be read" in ends(1, "compare", runs["pair"], tmp_path / "none.mcap")
    assert "has a map of robot 'nobody'" in ends(1, "compare", runs["pair"], runs["again"], "--robot", "nobody")


def test_wrong_usage_of_compare(runs: dict[str, Path], tmp_path: Path) -> None:
    assert "Missing argument 'B.mcap'" in ends(2, "compare", runs["pair"])
    assert "tolerance: -1 is not" in ends(2, "compare", runs["pair"], runs["again"], "--tolerance", -1)
    assert "must end in .json" in ends(2, "compare", runs["pair"], runs["again"], "--json", tmp_path / "a.txt")


# --- check ------------------------------------------------------------------------------------------------------------

EASY = ("--max-label-disagreement", 0.001, "--min-agreement", 0.5, "--max-packet-bytes", 10**9, "--settled")


def test_limits_that_hold(runs: dict[str, Path]) -> None:
    text = ends(0, "check", runs["pair"], *EASY)
    assert text.endswith("\npassed: all 4 checks\n")
    assert "FAILED" not in text
    assert ends(0, "check", runs["pair"], "--min-num-leaves", 1).endswith("\npassed: 1 check\n")


def test_a_limit_that_fails_is_named_first(runs: dict[str, Path], tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    text = ends(1, "check", runs["pair"], *EASY, "--max-packet-bytes", 1000, "--json", report)
    assert text.splitlines()[2].startswith("FAILED  max packet bytes")
    assert text.endswith("\nfailed: 1 of 4 checks: max packet bytes\n")
    content = json.loads(report.read_text(encoding="utf-8"))
    assert content["result"] == str(runs["pair"])
    assert content["passed"] is False
    first = content["rows"][0]
    assert (first["name"], first["limit"], first["passed"]) == ("max_packet_bytes", 1000.0, False)
    assert first["measured"] > 1000
    assert first["robot"] in ("husky_1", "husky_2")


def test_a_run_that_did_not_settle_fails(runs: dict[str, Path]) -> None:
    text = ends(1, "check", runs["slower"], "--settled")
    assert "stopped: " in text
    assert text.endswith("\nfailed: 1 of 1 check: settled\n")


def test_an_interrupted_run_fails(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_until(KeyboardInterrupt, tmp_path / "cut.mcap", [tick_metrics(1), tick_metrics(2)])
    text = ends(1, "check", tmp_path / "cut.partial.mcap", "--min-agreement", 0.1)
    assert "the run was interrupted" in text
    assert text.endswith("\nfailed: 1 of 2 checks: complete\n")


def test_wrong_usage_of_check(runs: dict[str, Path], tmp_path: Path) -> None:
    assert "no limit given; give at least one, such as --max-label-disagreement 0.001" in ends(2, "check", runs["pair"])
    assert "No such option '--max-fun'" in ends(2, "check", runs["pair"], "--max-fun", 1)
    assert "is more than 1; give a share" in ends(2, "check", runs["pair"], "--min-agreement", 99)
    assert "needs the truth; give it with --truth" in ends(2, "check", runs["pair"], "--min-coverage", 0.5)
    assert "must end in .json" in ends(2, "check", runs["pair"], *EASY, "--json", tmp_path / "a.txt")


def test_another_file_than_a_result_is_reported_in_one_sentence(tmp_path: Path) -> None:
    text = ends(1, "check", FIXTURES / "pair" / "team.yaml", "--min-agreement", 0.5)
    assert text.count("\n") == 1
    assert "team.yaml: not a finished MCAP file" in text


# --- texts ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (1234567.0, "1,234,567"), (0.99899, "0.99899"), (float("nan"), "-"), (float("inf"), "inf"),
     (1.5e-7, "1.5e-07"), (1e20, "1e+20")],
)  # fmt: skip
def test_numbers_have_a_fixed_format(value: float, text: str) -> None:
    assert verdict_tables.six_digits(value) == text


def test_close_values_are_shown_with_enough_digits() -> None:
    row = CheckRow("min_agreement", 0.999, 0.9989999999, "alpha", None, None, passed=False)
    assert verdict_tables._values(row) == ("at least 0.999", "0.9989999999")


def test_limits_that_need_the_ground_truth(runs: dict[str, Path]) -> None:
    world = FIXTURES / "pair" / "world.npz"
    text = ends(0, "check", runs["pair"], "--truth", world, "--min-coverage", 0.5, "--min-mean-iou", 0.05)
    assert text.endswith("\npassed: all 2 checks\n")
    assert "failed: 1 of 1 check" in ends(1, "check", runs["pair"], "--truth", world, "--min-coverage", 1)
