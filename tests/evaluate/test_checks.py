"""Checks of results with known numbers."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest

from octoreplay.errors import ConfigError, InputError
from octoreplay.evaluate import checks
from octoreplay.evaluate.checks import LIMITS, CheckRow, check_result, ticks_to_consensus
from octoreplay.evaluate.records import EvaluatedTick, Evaluation, MapScores, TruthScores
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.io.text_files import json_text
from octoreplay.records import CENTRAL, CONVERGED, FrameCounts
from octoreplay.run_metrics import PairMetrics, RobotMetrics, RunSummary, TickMetrics
from support.result_factory import CLASSES, summary, team, tick_metrics, write_killed, write_until

DOCS = Path(__file__).parents[2] / "docs"


def with_robots(tick: TickMetrics, **changes: Sequence[object]) -> TickMetrics:
    """A tick with these values for alpha and beta."""
    robots = tuple(
        dataclasses.replace(robot, **{name: values[index] for name, values in changes.items()})
        for index, robot in enumerate(tick.robots)
    )
    return dataclasses.replace(tick, robots=robots)


def ticks() -> list[TickMetrics]:
    """Three ticks of the logs and two settling ticks; the label disagreement is low from the first of these on."""
    made = [tick_metrics(tick, settling=tick > 3) for tick in range(1, 6)]
    made = [dataclasses.replace(tick, label_disagreement=0.25 if tick.tick < 4 else 0.0005) for tick in made]
    made[1] = with_robots(made[1], packet_bytes=(90, 7000), memory_bytes=(500_000, 12))
    return [with_robots(tick, sent_bytes=(100, 200 * tick.tick)) for tick in made]


def run_summary(metrics: Sequence[TickMetrics]) -> RunSummary:
    """A settled run; one of the links lost one packet of four, and alpha two frames of eight."""
    links = (
        dataclasses.replace(metrics[-1].links[0], num_sent=4, num_delivered=3),
        dataclasses.replace(metrics[-1].links[1], num_sent=5, num_delivered=5),
    )
    counts = {"alpha": FrameCounts(used=6, no_pose=1, late=1, duplicate=9), "beta": FrameCounts(used=9)}
    return dataclasses.replace(
        summary(metrics), stop_reason=CONVERGED, links=links, frame_counts=counts, log_seconds=3.0
    )


def stored(folder: Path, metrics: Sequence[TickMetrics], of_run: RunSummary | None = None) -> Path:
    """A finished result with these ticks."""
    path = folder / "result.mcap"
    with ResultWriter(path, team(folder)) as writer:
        for tick in metrics:
            writer.write_metrics(tick)
        writer.complete(run_summary(metrics) if of_run is None else of_run)
    return path


@pytest.fixture
def result(tmp_path: Path) -> Path:
    return stored(tmp_path, ticks())


def only(path: Path, **limits: float) -> CheckRow:
    """The only row of a check with one limit."""
    (row,) = check_result(path, limits, truth=path if any(LIMITS[name].needs_truth for name in limits) else None)
    return row


SCORES = MapScores(
    robot_id="alpha", is_active=True, num_cells=5, entropy_bits=0.5, agreement=1.0, agreement_occupied=1.0,
    truth=TruthScores(
        iou=(0.5, 0.75), mean_iou=0.625, mean_iou_known=0.7, occupied_accuracy=0.9, free_accuracy=0.9, coverage=0.75,
        world_coverage=0.3, calibration_error=0.125, calibration_error_occupied=0.2,
    ),
)  # fmt: skip


@pytest.fixture
def _evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the evaluation by one in which beta has worse scores than alpha, and the centralised map the worst."""

    def scores(robot_id: str, **changes: float) -> MapScores:
        assert SCORES.truth is not None
        return dataclasses.replace(SCORES, robot_id=robot_id, truth=dataclasses.replace(SCORES.truth, **changes))

    beta = scores("beta", mean_iou=0.5, coverage=0.25, calibration_error=0.375)
    central = scores(CENTRAL, mean_iou=0.0, coverage=0.0, calibration_error=1.0)
    end = EvaluatedTick(tick=5, seconds=5.0, label_disagreement=0.0, maps=(SCORES, beta, central))

    def evaluate_result(path: Path, *, truth: Path, map_kind: str, over_time: bool) -> Evaluation:
        assert (map_kind, over_time) == ("posterior", False)
        return Evaluation(str(path), str(truth), "central", map_kind, CLASSES.names, (end,))

    stand_in = SimpleNamespace(evaluate_result=evaluate_result)
    monkeypatch.setitem(sys.modules, "octoreplay.evaluate.evaluation", stand_in)


LAST = tick_metrics(5)
WORST = {
    "max_label_disagreement": (0.0005, None, None, 5.0),
    "max_total_distance": (LAST.total_distance, None, None, 5.0),
    "max_total_distance_all": (LAST.total_distance_all, None, None, 5.0),
    "max_ticks_to_consensus": (1.0, None, None, None),
    "min_agreement": (0.9, "alpha", None, 5.0),
    "min_agreement_occupied": (LAST.robots[1].agreement_occupied, "beta", None, 5.0),
    "max_contradiction": (0.2, None, "alpha and beta", 5.0),
    "max_clear_contradiction": (0.05, None, "alpha and beta", 5.0),
    "max_label_contradiction": (0.125, None, "alpha and beta", 5.0),
    "max_entropy_bits": (LAST.robots[1].entropy_bits, "beta", None, 5.0),
    "max_num_leaves": (105.0, "alpha", None, 5.0),
    "min_num_leaves": (105.0, "alpha", None, 5.0),
    "max_memory_bytes": (500_000.0, "alpha", None, 2.0),
    "max_packet_bytes": (7000.0, "beta", None, 2.0),
    "max_sent_bytes_per_second": (400.0, "beta", None, None),
    "min_delivered_share": (0.75, None, "alpha -> beta", None),
    "max_frames_lost_share": (0.25, "alpha", None, None),
    "min_mean_iou": (0.5, "beta", None, 5.0),
    "min_coverage": (0.25, "beta", None, 5.0),
    "max_calibration_error": (0.375, "beta", None, 5.0),
}
"""Worst value of every limit in ``ticks``, with its robot, its link or pair, and its time."""


def test_worst_values_are_given_for_every_limit() -> None:
    assert set(WORST) == set(LIMITS)


@pytest.mark.usefixtures("_evaluation")
@pytest.mark.parametrize("name", WORST)
def test_a_limit_holds_at_the_worst_value_and_on_one_side_of_it(result: Path, name: str) -> None:
    value, robot, link, seconds = WORST[name]
    good, bad = (math.inf, -math.inf) if name.startswith("max") else (-math.inf, math.inf)
    for limit, passed in ((value, True), (math.nextafter(value, good), True), (math.nextafter(value, bad), False)):
        pair = link if name.endswith("contradiction") else None
        expected = CheckRow(name, limit, value, robot, None if pair else link, seconds, passed, pair=pair)
        assert only(result, **{name: limit}) == expected


def test_each_of_two_bounds_is_checked_with_its_worst_robot(tmp_path: Path) -> None:
    metrics = ticks()
    metrics[-1] = with_robots(metrics[-1], num_leaves=(10, 30), active=(True, True))
    path = stored(tmp_path, metrics)
    assert [(row.measured, row.robot) for row in check_result(path, {"max_num_leaves": 1, "min_num_leaves": 99})] == [
        (30, "beta"), (10, "alpha"),
    ]  # fmt: skip


def test_inactive_robots_are_checked_only_if_no_robot_is_active(tmp_path: Path) -> None:
    metrics = ticks()
    metrics[-1] = with_robots(metrics[-1], agreement=(0.5, 0.75), active=(False, True))
    assert only(stored(tmp_path, metrics), min_agreement=0.75) == CheckRow(
        "min_agreement", 0.75, 0.75, "beta", None, 5.0, passed=True
    )
    metrics[-1] = with_robots(metrics[-1], active=(False, False))
    assert only(stored(tmp_path, metrics), min_agreement=0.75).robot == "alpha"


@pytest.mark.parametrize("name", ["min_agreement", "max_entropy_bits"])
def test_nan_fails_and_is_the_worst_value(tmp_path: Path, name: str) -> None:
    metrics = ticks()
    metrics[-1] = with_robots(metrics[-1], agreement=(0.0, math.nan), entropy_bits=(9.0, math.nan))
    row = only(stored(tmp_path, metrics), **{name: 1.0})
    assert (row.passed, row.robot, row.detail) == (False, "beta", "no value to measure")
    assert math.isnan(row.measured)


def test_the_contradiction_of_the_worst_pair_with_enough_cells_is_checked(tmp_path: Path) -> None:
    (pair,) = LAST.pairs
    small = dataclasses.replace(pair, first="small", occupied_cells=499, contradiction=0.9)
    worst = dataclasses.replace(pair, first="worst", occupied_cells=500, contradiction=0.7)
    path = stored(tmp_path, [*ticks()[:-1], dataclasses.replace(ticks()[-1], pairs=(pair, small, worst))])
    row = only(path, max_contradiction=0.5)
    assert (row.passed, row.measured, row.pair) == (False, 0.7, "worst and beta")


def test_the_contradiction_of_robots_without_common_cells_cannot_be_checked(tmp_path: Path) -> None:
    path = stored(tmp_path, [dataclasses.replace(tick, pairs=()) for tick in ticks()])
    row = only(path, max_label_contradiction=1.0)
    assert (row.passed, row.pair) == (False, None)
    assert row.detail.startswith("no two robots share 500 occupied cells")


def test_limits_without_packets_or_frames_fail(tmp_path: Path) -> None:
    metrics = ticks()
    of_run = dataclasses.replace(run_summary(metrics), links=(), frame_counts={"alpha": FrameCounts()})
    rows = check_result(stored(tmp_path, metrics, of_run), {"min_delivered_share": 0, "max_frames_lost_share": 1})
    assert [(row.passed, row.detail) for row in rows] == [
        (False, "no value to measure"),
        (False, "there are no frames, or a log is truncated or damaged"),
    ]
    # The number of frames of a truncated log is unknown.
    (tmp_path / "cut").mkdir()
    cut = {"alpha": FrameCounts(used=9, truncated_files=["a.mcap: is cut off"])}
    row = only(
        stored(tmp_path / "cut", metrics, dataclasses.replace(of_run, frame_counts=cut)), max_frames_lost_share=0
    )
    assert (row.passed, row.robot) == (False, "alpha")
    assert math.isnan(row.measured)


def test_links_without_packets_are_not_checked(tmp_path: Path) -> None:
    metrics = ticks()
    of_run = run_summary(metrics)
    silent = dataclasses.replace(of_run.links[0], num_sent=0, num_delivered=0)
    path = stored(tmp_path, metrics, dataclasses.replace(of_run, links=(silent, of_run.links[1])))
    assert only(path, min_delivered_share=1.0).link == "beta -> alpha"


@pytest.mark.parametrize(
    ("shares", "expected"),
    [((0.0, 0.0, 0.0), 0), ((0.5, 0.0, 0.0), 1), ((0.5, 0.0, 0.001, 0.0009), 3), ((0.0, 0.5, 0.0), 2),
     ((0.5, 0.5, 0.5), None), ((0.0, 0.0, 0.001), None), ((0.5, math.nan, 0.0), 2)],
)  # fmt: skip
def test_ticks_to_consensus_count_from_the_last_evidence_until_it_lasts(
    shares: tuple[float, ...], expected: int | None
) -> None:
    metrics = [
        dataclasses.replace(tick_metrics(3 + n, settling=n > 0), label_disagreement=share)
        for n, share in enumerate(shares)
    ]
    before = [dataclasses.replace(tick_metrics(n), label_disagreement=0.9) for n in (1, 2)]
    found = ticks_to_consensus([*before, *metrics])
    assert math.isnan(found) if expected is None else found == expected


def test_a_team_without_consensus_fails(tmp_path: Path) -> None:
    row = only(stored(tmp_path, [tick_metrics(1), tick_metrics(2, settling=True)]), max_ticks_to_consensus=1e9)
    assert (row.passed, row.detail) == (False, "the labels did not reach consensus")


# --- checks without a limit -------------------------------------------------------------------------------------------


def test_settled_checks_the_stop_reason(tmp_path: Path) -> None:
    metrics = ticks()
    path = stored(tmp_path, metrics)
    assert check_result(path, {}, settled=True) == (CheckRow("settled", 1, 1, None, None, 5.0, passed=True),)
    path = stored(tmp_path, metrics, dataclasses.replace(run_summary(metrics), stop_reason="settle_max reached"))
    (row,) = check_result(path, {}, settled=True)
    assert (row.passed, row.measured, row.detail) == (False, 0.0, "stopped: settle_max reached")


def test_an_interrupted_run_fails_with_any_numbers(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_until(KeyboardInterrupt, tmp_path / "cut.mcap", ticks())
    rows = check_result(tmp_path / "cut.partial.mcap", {"max_label_disagreement": 0.5}, settled=True)
    assert [(row.name, row.passed) for row in rows] == [
        ("complete", False), ("settled", False), ("max_label_disagreement", True),
    ]  # fmt: skip
    assert rows[0].detail == "the run was interrupted (interrupted); replay the logs again"


def test_a_run_without_a_tick_is_refused(tmp_path: Path) -> None:
    killed = write_killed(tmp_path / "cut.mcap", [])
    with pytest.raises(InputError, match="holds no tick; the run was interrupted before its first one"):
        check_result(killed, {"max_label_disagreement": 0.5})


def test_failed_rows_come_first_in_the_order_of_the_limits(result: Path) -> None:
    limits = {"max_packet_bytes": 1, "max_total_distance": 1e9, "max_label_disagreement": 0, "min_num_leaves": 1}
    assert [(row.name, row.passed) for row in check_result(result, limits)] == [
        ("max_label_disagreement", False), ("max_packet_bytes", False), ("max_total_distance", True),
        ("min_num_leaves", True),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("limits", "sentence"),
    [
        ({}, "no limit given; give at least one, such as --max-label-disagreement 0.001"),
        ({"max_agreement": 1}, "unknown limit 'max_agreement'; did you mean 'min_agreement'?"),
        ({"packet_bytes": 1}, "unknown limit 'packet_bytes'; did you mean 'max_packet_bytes'?"),
        ({"min_agreement": 99.9}, "min_agreement: 99.9 is more than 1; give a share, such as 0.999 for 99.9 %"),
        ({"max_packet_bytes": -1}, "max_packet_bytes: -1 is not a finite number of at least 0"),
        ({"max_packet_bytes": math.nan}, "max_packet_bytes: nan is not a finite number of at least 0"),
        ({"max_packet_bytes": math.inf}, "max_packet_bytes: inf is not a finite number of at least 0"),
        ({"min_mean_iou": 0.5}, "min_mean_iou: needs the truth; give it with --truth"),
    ],
)
def test_invalid_limits_are_refused_with_one_sentence(tmp_path: Path, limits: dict[str, float], sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        check_result(tmp_path / "none.mcap", limits)
    assert str(caught.value).removeprefix("check: ") == sentence


def test_a_truth_that_no_limit_needs_is_refused(result: Path) -> None:
    with pytest.raises(ConfigError, match=r"truth: no limit needs the truth; add one, such as --min-mean-iou 0.5"):
        check_result(result, {"min_agreement": 0.5}, truth=result)


def test_a_file_that_is_not_a_result_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"not a container")
    with pytest.raises(InputError, match=r"x.mcap: not a finished MCAP file, or damaged; give the OUT.mcap"):
        check_result(tmp_path / "x.mcap", {"min_agreement": 0.5})


def test_rows_as_json(tmp_path: Path) -> None:
    rows = check_result(stored(tmp_path, [tick_metrics(1), tick_metrics(2, settling=True)]),
                        {"max_ticks_to_consensus": 3, "min_num_leaves": 1})  # fmt: skip
    assert json.loads(json_text(rows)) == [
        {"name": "max_ticks_to_consensus", "limit": 3.0, "measured": None, "robot": None, "link": None,
         "seconds": None, "passed": False, "detail": "the labels did not reach consensus", "pair": None},
        {"name": "min_num_leaves", "limit": 1.0, "measured": 102.0, "robot": "alpha", "link": None, "seconds": 2.0,
         "passed": True, "detail": "", "pair": None},
    ]  # fmt: skip


def test_quantities_have_the_names_of_the_metrics() -> None:
    records = (TickMetrics, RobotMetrics, PairMetrics, TruthScores)
    fields = {item.name for record in records for item in dataclasses.fields(record)}
    counted = {"ticks_to_consensus", "sent_bytes_per_second", "delivered_share", "frames_lost_share"}
    assert {quantity.name for quantity in checks.QUANTITIES} <= fields | counted


def test_the_documentation_lists_every_limit_with_its_meaning() -> None:
    text = (DOCS / "cli.md").read_text(encoding="utf-8")
    for quantity in checks.QUANTITIES:
        options = ", ".join(f"`--{name.replace('_', '-')}`" for name in quantity.limits)
        assert f"| {options} | {quantity.meaning} |" in text
