"""Contradiction of evidence during a run, and its warnings."""

from __future__ import annotations

import dataclasses
import itertools

import pytest

from octoreplay.config.network import ScheduleEntry
from octoreplay.config.team_file import load_team_file
from octoreplay.evaluate.evaluation import evaluate_result
from octoreplay.mapping.contradiction import (
    CLEAR_LIMIT,
    LABEL_LIMIT,
    EvidenceComparer,
    state_limits,
)
from octoreplay.replay.run import replay_team
from octoreplay.replay.warnings import frame_warnings
from octoreplay.result import open_result
from octoreplay.run_metrics import PairMetrics
from support.faulty_team import configured, session_of
from support.fixture_paths import PAIR_TEAM

FORGETTING = (ScheduleEntry(5.0, 8.0, robots_off=("robot_1",), forget=True),)
PAIR = PairMetrics("a", "b", 20_000, 12_400, 0.38, CLEAR_LIMIT + 0.1, 0.3, 0.2, 9_000, 0.02)


def cells(robot_ids):
    """Known cells of each robot, of which PAIR shares a fifth."""
    return dict.fromkeys(robot_ids, 100_000)


@pytest.mark.parametrize(
    "parameters",
    [{"rule": "bayes"}, {"rule": "local", "evidence": "time-average"}, {"rule": "bayes", "schedule": FORGETTING}],
    ids=["sum", "average", "restart"],
)
def test_every_tick_has_the_pairs_of_its_evidence(parameters):
    config = configured(settle=0, **parameters)
    ids = [robot.robot_id for robot in config.robots]
    seen, shared = set(), []
    for tick, other in zip(session_of(config).ticks(), session_of(config, 3).ticks(), strict=True):
        scratch = EvidenceComparer(ids, config.classes.num_classes, state_limits(config.sensor))
        assert repr(tick.metrics.pairs) == repr(scratch.compare(tick.evidence, 0)) == repr(other.metrics.pairs)
        seen |= {(pair.first, pair.second) for pair in tick.metrics.pairs}
        of_robot = [pair for pair in tick.metrics.pairs if "robot_1" in (pair.first, pair.second)]
        shared.append(sum(pair.overlap_cells for pair in of_robot))
    assert seen == set(itertools.combinations(ids, 2))
    # A robot that forgets loses its evidence, and with it the cells that it shares.
    assert (shared == sorted(shared)) == ("schedule" not in parameters)


def test_the_result_stores_the_evidence_of_every_robot(tmp_path):
    path = tmp_path / "out.mcap"
    config = load_team_file(PAIR_TEAM).with_parameters({"rule": "local", "evidence_every": 2.0, "prob_free": 0.7})
    summary = replay_team(config, path)
    with open_result(path) as result:
        for robot_id in result.robots:
            ticks = result.evidence_ticks(robot_id)
            assert len(ticks) > 2
            assert ticks[-1] == result.metrics[-1].tick
            # Under rule local a robot's map is its evidence.
            stored = result.evidence(robot_id)
            expected = result.map(robot_id)
            assert stored.leaves().log_odds.tobytes() == expected.leaves().log_odds.tobytes()
            assert stored.num_robots == 1
            assert stored.octree.num_cells > result.evidence(robot_id, tick=ticks[0]).octree.num_cells
        with_evidence = {
            tick for tick in result.evidence_ticks(result.robots[0]) if tick in result.stored_ticks("central")
        }
        metrics = {tick.tick: tick.pairs for tick in result.metrics}
    # The evaluation of the stored evidence has the numbers of the run.
    evaluation = evaluate_result(path)
    for tick in evaluation.ticks:
        assert tick.pairs == (metrics[tick.tick] if tick.tick in with_evidence else ())
    assert evaluation.final.pairs == summary.last.pairs != ()


def test_evidence_is_stored_at_the_end_only_by_default(pair_result):
    with open_result(pair_result) as result:
        assert result.evidence_ticks("husky_1") == [result.metrics[-1].tick]


def test_contradicting_robots_are_named_with_the_remedy():
    (sentence,) = frame_warnings([PAIR], cells("ab"))
    assert sentence == (
        f"a and b contradict each other in 38 % of the 12,400 occupied cells that both know,"
        f" clearly in {100 * PAIR.clear_contradiction:.0f} %: try `octoreplay align`"
    )
    others = [dataclasses.replace(PAIR, first="b", second=name, clear_contradiction=0.9) for name in "cde"]
    (sentence,) = frame_warnings([PAIR, *others], cells("abcde"))
    assert sentence.startswith("b and c contradict")
    assert "clearly in 90 % (3 more pairs, all with b): try" in sentence
    apart = dataclasses.replace(PAIR, first="c", second="d")
    agreeing = dataclasses.replace(PAIR, second="c", clear_contradiction=0.0)
    (sentence,) = frame_warnings([PAIR, apart, agreeing], cells("abcd"))
    assert "(and c and d): try" in sentence


def test_robots_with_other_labels_are_named():
    pair = dataclasses.replace(PAIR, clear_contradiction=0.0, label_contradiction=LABEL_LIMIT + 0.1)
    (sentence,) = frame_warnings([pair], cells("ab"))
    share = f"{100 * pair.label_contradiction:.0f} %"
    assert sentence.startswith(f"a and b have different labels in {share} of the 9,000 cells that both call occupied: ")


@pytest.mark.parametrize(
    "changes",
    [
        {"contradiction": 1.0, "clear_contradiction": CLEAR_LIMIT},
        {"occupied_cells": 499},
        {"clear_contradiction": 0.0, "label_contradiction": LABEL_LIMIT},
        {"clear_contradiction": 0.0, "label_contradiction": 1.0, "both_occupied_cells": 499},
    ],
)
def test_no_warning_up_to_the_limits_and_for_few_cells(changes):
    assert frame_warnings([dataclasses.replace(PAIR, **changes)], cells("ab")) == ()


def shared(*pairs):
    """Pairs that share known cells and agree."""
    return [dataclasses.replace(PAIR, first=a, second=b, clear_contradiction=0.0) for a, b in pairs]


@pytest.mark.parametrize(
    ("pairs", "ids", "beginning"),
    [
        ([], "ab", "a and b share no known space: nothing to agree on"),
        ([], "abc", "a, b and c share no known space: "),
        (["ac"], "abc", "b shares no known space with any other robot: "),
        (["ac"], "abcd", "b and d share no known space with any other robot: "),
        (["ac", "bd"], "abcde", "the robots are in 3 groups that share no known space (a and c; b and d; e): "),
        (["cd", "ad"], "abcd", "b shares no known space with any other robot: "),
    ],
)
def test_robots_without_common_space_are_named_in_one_sentence(pairs, ids, beginning):
    (sentence,) = frame_warnings(shared(*pairs), cells(ids))
    assert sentence.startswith(beginning)


@pytest.mark.parametrize(("overlap", "occupied", "warns"), [(4999, 499, True), (5000, 499, False), (4999, 500, False)])
def test_robots_that_share_too_little_space_are_named(overlap, occupied, warns):
    pair = dataclasses.replace(PAIR, overlap_cells=overlap, occupied_cells=occupied, clear_contradiction=0.0)
    sentences = frame_warnings([pair], cells("ab"))
    beginning = "a and b share hardly any known space (at most 4,999 cells): little to agree on"
    assert [sentence.startswith(beginning) for sentence in sentences] == [True] * warns


@pytest.mark.parametrize(("pairs", "ids"), [([], ""), ([], "a"), (["ab"], "ab"), (["ab", "bc"], "abc")])
def test_robots_that_share_space_give_no_warning(pairs, ids):
    assert frame_warnings(shared(*pairs), cells(ids)) == ()


def test_a_wrong_frame_is_reported_by_run_and_evaluation(tmp_path):
    config = load_team_file(PAIR_TEAM)
    far = dataclasses.replace(config.robots[1], T_team_map=(500.0, 0, 0, 0, 0, 0, 1))
    moved = dataclasses.replace(config, robots=(config.robots[0], far)).with_parameters({"settle": 0, "duration": 1.0})
    summary = replay_team(moved, tmp_path / "out.mcap")
    sentence = "husky_1 and husky_2 share no known space: nothing to agree on"
    assert sum(warning.startswith(sentence) for warning in summary.warnings) == 1
    evaluation = evaluate_result(tmp_path / "out.mcap")
    assert evaluation.warnings == tuple(warning for warning in summary.warnings if warning.startswith(sentence))
