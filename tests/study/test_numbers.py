"""Tests of a run's numbers against the ticks of its result."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from octoreplay.config.network import ScheduleEntry
from octoreplay.config.team_file import load_team_file
from octoreplay.evaluate.records import SCORES, EvaluatedTick, Evaluation, MapScores, TruthScores
from octoreplay.replay.run import replay_team
from octoreplay.result import open_result
from octoreplay.run_metrics import RunSummary, TickMetrics
from octoreplay.study import numbers
from octoreplay.study.numbers import (
    RUN_COLUMNS,
    TRUTH_COLUMNS,
    contraction,
    is_connected,
    run_numbers,
    truth_numbers,
)
from support.fixture_paths import PAIR_TEAM
from support.result_factory import tick_metrics


def ticks(*disagreements: float, num_log_ticks: int) -> list[TickMetrics]:
    return [
        dataclasses.replace(tick_metrics(tick, settling=tick >= num_log_ticks), label_disagreement=value)
        for tick, value in enumerate(disagreements)
    ]


def test_contraction_is_the_mean_factor_over_the_later_half() -> None:
    assert contraction([0.25**n for n in range(9)]) == pytest.approx(0.25)
    # The first half is ignored; of the later half only the first and the last value count.
    assert contraction([7.0, 900.0, 8.0, 3.0, 1.0, 1.0]) == pytest.approx((1 / 8) ** (1 / 3))
    # Values at the level of rounding are ignored.
    assert contraction([*(0.25**n for n in range(14)), *[1e-13] * 40]) == pytest.approx(0.25)
    assert math.isnan(contraction([8.0, 4.0, 2.0]))
    assert math.isnan(contraction([8.0, 4.0, 2.0, 0.0]))
    assert math.isnan(contraction([]))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunSummary, tuple[TickMetrics, ...]]:
    path = tmp_path_factory.mktemp("run") / "result.mcap"
    changes = {"loss": 0.5, "network_seed": 3, "rule": "bayes", "resolution": 0.6}
    summary = replay_team(load_team_file(PAIR_TEAM).with_parameters(changes), path)
    with open_result(path) as result:
        return summary, tuple(result.metrics)


def test_the_numbers_of_a_run_match_its_ticks(run: tuple[RunSummary, tuple[TickMetrics, ...]]) -> None:
    summary, metrics = run
    row = run_numbers(summary, metrics)
    assert tuple(row) == RUN_COLUMNS
    log_ticks = [tick for tick in metrics if not tick.settling]
    assert 2 < len(log_ticks) < len(metrics) == row["num_ticks"]
    for name in ("total_distance", "total_distance_all"):
        values = [getattr(tick, name) for tick in metrics]
        assert row[name] == values[-1]
        assert row[f"{name}_log_end"] == values[len(log_ticks) - 1]
        assert row[f"{name}_mean"] == pytest.approx(np.mean(values[1 : len(log_ticks)]))
        assert row[f"{name}_peak"] == max(values)
    for name in ("agreement", "agreement_occupied"):
        # In the first tick no robot has integrated a scan.
        worst = [np.nan, *(min(getattr(r, name) for r in tick.robots if r.active) for tick in metrics[1:])]
        assert row[name] == worst[-1]
        assert row[f"{name}_log_end"] == worst[len(log_ticks) - 1] < row[name]
        assert row[f"{name}_mean"] == pytest.approx(np.mean(worst[1 : len(log_ticks)]))
    for name in ("contradiction", "clear_contradiction", "label_contradiction"):
        np.testing.assert_equal(row[name], getattr(metrics[-1], name))
    sent = sum(robot.sent_bytes for tick in log_ticks for robot in tick.robots)
    assert row["sent_bytes_per_second"] == pytest.approx(sent / 2 / summary.log_seconds)
    links = [link for tick in metrics for link in tick.links]
    share = sum(link.num_delivered for link in links) / sum(link.num_sent for link in links)
    assert row["delivered_share"] == pytest.approx(share)
    assert 0.2 < share < 0.8
    assert row["memory_bytes"] == max(robot.memory_bytes for robot in metrics[-1].robots)
    assert row["num_leaves"] == np.mean([robot.num_leaves for robot in metrics[-1].robots])


def test_dormant_robots_do_not_count_as_the_worst() -> None:
    tick = tick_metrics(1)
    summary_tick = dataclasses.replace(
        tick, robots=(tick.robots[0], dataclasses.replace(tick.robots[1], agreement=0.0, active=False))
    )
    assert numbers.worst(summary_tick, "agreement") == tick.robots[0].agreement


def scores(robot_id: str, number: float) -> MapScores:
    """Scores that differ by name and robot."""
    values = [number + index / 100 for index in range(len(SCORES))]
    return MapScores(robot_id, True, 1000, *values[1:4], TruthScores((number,), *values[4:]))


def test_the_truth_numbers_are_means_over_robots() -> None:
    maps = (scores("a", 0.25), scores("b", 0.5), scores("central", 0.75))
    tick = EvaluatedTick(3, 1.0, 0.0, maps)
    row = truth_numbers(Evaluation("r", "t", "central", "posterior", ("x",), (tick,)))
    assert tuple(row) == TRUTH_COLUMNS
    for name in ("mean_iou", "coverage", "free_accuracy", "calibration_error", "calibration_error_occupied"):
        assert row[name] == pytest.approx((maps[0].score(name) + maps[1].score(name)) / 2)
    assert row["mean_iou_least"] == maps[0].score("mean_iou")
    assert row["central_mean_iou"] == maps[2].score("mean_iou")
    assert row["central_calibration_error"] == maps[2].score("calibration_error")
    alone = truth_numbers(
        Evaluation("r", "t", "central", "posterior", ("x",), (dataclasses.replace(tick, maps=maps[:2]),))
    )
    assert math.isnan(alone["central_mean_iou"])


def test_a_team_is_connected_where_links_work_both_ways() -> None:
    tick = tick_metrics(0)
    tick = dataclasses.replace(tick, robots=tuple(dataclasses.replace(robot, active=True) for robot in tick.robots))
    first, second, *others = (robot.robot_id for robot in tick.robots)
    assert not others
    (link, *_) = tick.links
    both = tuple(
        dataclasses.replace(link, sender=sender, receiver=receiver)
        for sender, receiver in ((first, second), (second, first))
    )
    assert is_connected(dataclasses.replace(tick, links=both))
    assert not is_connected(dataclasses.replace(tick, links=both[:1]))
    assert not is_connected(dataclasses.replace(tick, links=()))
    # A robot that is off needs no link.
    off = dataclasses.replace(tick.robots[1], active=False)
    assert is_connected(dataclasses.replace(tick, links=(), robots=(tick.robots[0], off)))


def test_agreement_while_connected_is_that_of_the_last_such_tick(tmp_path) -> None:
    cut = ScheduleEntry(start=1.0, groups=(("husky_1",), ("husky_2",)))
    config = load_team_file(PAIR_TEAM).with_parameters({"publish_period": 0.5})
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, schedule=(cut,)))
    summary = replay_team(config, tmp_path / "cut.mcap")
    with open_result(tmp_path / "cut.mcap") as result:
        before = [tick for tick in result.metrics if tick.links and not tick.settling]
        row = run_numbers(summary, result.metrics)
    assert 0 < len(before) < summary.num_ticks - summary.num_settling_ticks
    worst = min(robot.agreement_occupied for robot in before[-1].robots)
    assert row["agreement_occupied_connected"] == worst > row["agreement_occupied"]
