"""Networks and schedules that the command 'run' refuses."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from support.command_line import assert_fails, octoreplay
from support.fixture_paths import FIXTURES, PAIR, PAIR_TEAM, TRIO_TEAM

HUSKIES = "husky_1:husky_2"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--one-way", "husky_1:spot"], "one_way: robot 'spot' is not in the team: husky_1, husky_2"),
        (["--one-way", "husky_1"], "one_way: 'husky_1' is not A:B"),
        (["--one-way", f"{HUSKIES}:0.5"], "one_way: 'husky_1:husky_2:0.5' is not A:B"),
        (["--edges", f"{HUSKIES}:-0.5"], "edges: the weight of husky_1 - husky_2 must be finite and at least 0"),
        (["--edges", f"{HUSKIES}:1.5"], "edges: the weights of robot 'husky_1' sum to 1.5; lower them to at most 1"),
        (["--epsilon", "1.5"], r"epsilon: 1.5 is not below 1, the bound of this .*; use 0.9 or leave epsilon out"),
        (["--jitter", "0.5", "--latency", "0.2"], "jitter: 0.5 is above latency 0.2; a delay cannot be negative"),
        (
            ["--budget", "5000", "--packets", "full"],
            "budget: goes with packets 'delta'; a whole map cannot be sent in parts",
        ),
        (["--budget", "5000", "--packets", "delta", "--no-acknowledge"], "budget: goes with acknowledge"),
        (["--budget", "300", "--packets", "delta"], r"budget: 300 bytes may not hold one brick .* give at least \d+"),
        (["--rule", "ratio", "--content", "int8"], "rule: 'ratio' sends running sums.* use packets 'full', content"),
        (["--rule", "ratio", "--packets", "delta"], "rule: 'ratio' sends running sums.* use packets 'full', content"),
        (["--rule", "flood", "--mode", "on-arrival"], "mode: rule 'flood' does not support 'on-arrival'; use 'sync'"),
        (["--rule", "flood", "--preset", "paper"], "mode: rule 'flood' does not support 'on-arrival'; use 'sync'"),
        (["--top-classes", "0"], "top_classes: 0 is below the least value 1"),
        (["--loss", "1.5"], "loss: 1.5 is above the largest value 1"),
        (["--corruption", "-0.1"], "corruption: -0.1 is below the least value 0"),
        (["--burst-start", "nan"], "burst_start: nan is not a finite number"),
        (["--start", "1e300"], r"start: 1e\+300 is above the largest value 1e\+12"),
        (["--pose-gap", "1e13"], r"pose_gap: 1e\+13 is above the largest value 1e\+12"),
        (["--rate", "1e-300"], "rate: 1e-300 is below the least value 1e-15"),
        (["--publish-period", "1e6"], r"publish_period: 1000000\.0 is above the largest value 86400"),
        (["--schedule", "none.yaml"], r"none\.yaml: cannot be read: No such file"),
        (["--schedule", FIXTURES], "fixtures: cannot be read: Is a directory"),
        (["--schedule", PAIR / "husky_1.mcap"], r"husky_1\.mcap: not a schedule file: its text is"),
        (["--schedule", PAIR_TEAM], r"team\.yaml: schedule: expects a list of entries, each with 'from'"),
    ],
)  # fmt: skip
def test_a_refused_network_is_one_sentence_and_nothing_is_written(
    arguments: list[object], sentence: str, tmp_path: Path
) -> None:
    done = octoreplay("run", PAIR_TEAM, "-o", "x.mcap", *arguments, folder=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert re.search(sentence, done.stderr), done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("entries", "sentence"),
    [
        ("- {from: 1, to: 5, robots_off: [husky_1]}\n- {from: 3, robots_off: [husky_1]}",
         r"robot 'husky_1' is in two entries at 3 s \(from 1 s to 5 s, and from 3 s on\); end one before"),
        ("- {from: 1, links_down: [[husky_1, husky_2]], links_up: [[husky_2, husky_1]]}", "is in two entries at 1 s"),
        ("- {from: 1}", "the entry from 1 s on has no effect; give it groups, links_down"),
        ("- {from: 1, robots_off: [spot]}", "schedule: robot 'spot' is not in the team: husky_1, husky_2"),
        ("- {from: 1, robot_off: [husky_1]}", r"schedule\.yaml: schedule: robot_off: unknown key; did you mean"),
        ("- {from: 1\n", r"schedule\.yaml: not valid YAML \(line 2\)"), ("", "expects a list of entries"),
        ("- {from: 5, to: 1, robots_off: [husky_1]}", "from 5 s to 1 s; 'from' must be first"),
    ],
)  # fmt: skip
def test_a_refused_schedule_is_one_sentence_and_nothing_is_written(entries: str, sentence: str, tmp_path: Path) -> None:
    path = tmp_path / "schedule.yaml"
    path.write_text(entries)
    done = octoreplay("run", PAIR_TEAM, "-o", tmp_path / "x.mcap", "--schedule", path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert re.search(sentence, done.stderr), done.stderr
    assert list(tmp_path.iterdir()) == [path]


def test_a_step_above_the_bound_of_a_scheduled_graph_is_refused(tmp_path: Path) -> None:
    """The bound is 2/3 for the complete graph of three robots, and 1/2 for the line that the schedule leaves."""
    path = tmp_path / "schedule.yaml"
    path.write_text("- {from: 2, links_down: [[husky_1, husky_3]]}")
    arguments = ("--weights", "degree", "--epsilon", "0.6", "--schedule", path)
    sentence = r"schedule: at 2 s: epsilon: 0\.6 is not below 0\.5,.*; use 0\.45 or leave"
    assert_fails(2, sentence, "run", TRIO_TEAM, "-o", tmp_path / "x.mcap", *arguments)
    assert list(tmp_path.iterdir()) == [path]
