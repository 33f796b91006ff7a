"""The command 'compare', on runs of the small recorded teams."""

from __future__ import annotations

import json
from pathlib import Path

from support.command_line import output_of
from support.fixture_paths import PAIR


def test_a_run_equals_itself_and_its_repetition(runs: dict[str, Path]) -> None:
    for other in ("pair", "again"):
        text = output_of(0, "compare", runs["pair"], runs[other])
        assert text.endswith("\nthe same: all cells of 3 maps\n")
        assert "logs: the same" in text
        assert "Different settings" not in text
        assert "Places of the differences" not in text


def test_settings_that_differ_are_listed(runs: dict[str, Path]) -> None:
    text = output_of(1, "compare", runs["pair"], runs["slower"])
    assert "\ndifferent: 2 of 3 maps, in up to " in text
    content = json.loads(output_of(1, "compare", runs["pair"], runs["slower"], "--json"))
    assert {(one["name"], one["value_b"]) for one in content["settings"]} == {("epsilon", 0.1), ("settle", 0)}
    assert [one["robot_id"] for one in content["maps"]] == ["husky_1", "husky_2", "central"]
    assert content["maps"][0]["num_differing"] > 0
    assert content["maps"][2]["num_differing"] == 0
    assert "the same: all cells of 1 map" in output_of(0, "compare", runs["pair"], runs["slower"], "--robot", "central")


def test_maps_within_a_tolerance_are_the_same(runs: dict[str, Path]) -> None:
    assert output_of(1, "compare", runs["pair"], runs["near"]).splitlines()[-1].startswith("different: 2 of 3 maps")
    text = output_of(0, "compare", runs["pair"], runs["near"], "--tolerance", 0.5)
    assert text.splitlines()[-1].startswith("the same within 0.5: all cells of 3 maps")


def test_a_robot_of_one_result_only(runs: dict[str, Path]) -> None:
    text = output_of(1, "compare", runs["pair"], runs["trio"])
    assert "logs: different" in text
    assert text.endswith("; only B has a map of husky_3\n")


def test_maps_of_an_earlier_time(runs: dict[str, Path]) -> None:
    assert "the same" in output_of(0, "compare", runs["pair"], runs["again"], "--at", 1.5)


def test_results_that_cannot_be_compared(runs: dict[str, Path], tmp_path: Path) -> None:
    text = output_of(1, "compare", runs["pair"], runs["finer"])
    assert text.count("\n") == 1
    assert "finer.mcap: the resolution is 0.4 m" in text
    text = output_of(1, "compare", runs["pair"], PAIR / "husky_1.mcap")
    assert text.count("\n") == 1
    assert "no result of octoreplay" in text
    assert "cannot be read" in output_of(1, "compare", runs["pair"], tmp_path / "none.mcap")
    assert "has a map of robot 'nobody'" in output_of(1, "compare", runs["pair"], runs["again"], "--robot", "nobody")


def test_wrong_usage(runs: dict[str, Path]) -> None:
    assert "Missing argument 'B.mcap'" in output_of(2, "compare", runs["pair"])
    assert "tolerance: -1 is not" in output_of(2, "compare", runs["pair"], runs["again"], "--tolerance", -1)
