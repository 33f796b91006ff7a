"""Tables of evaluations."""

from __future__ import annotations

import dataclasses
import io

import pytest

from octoreplay.evaluate.records import Evaluation
from octoreplay.report import tables
from octoreplay.report.evaluation_tables import MAX_TIMES, evaluation_tables
from support.evaluation_factory import evaluation


def rendered(judged: Evaluation, *, is_verbose: bool = False) -> str:
    text = io.StringIO()
    tables.show(tables.terminal(file=text, width=100), evaluation_tables(judged, is_verbose=is_verbose))
    lines = [line.rstrip() for line in text.getvalue().splitlines()]
    assert all(len(line) <= 100 for line in lines)
    return "\n".join(lines)


def row(text: str, title: str, name: str) -> list[str]:
    """Cells of the first row called ``name`` below a title."""
    lines = text[text.index(title) :].splitlines()
    return next(line for line in lines if line.startswith(name)).split()[1:]


def test_every_map_and_the_mean_have_a_row() -> None:
    judged = evaluation()
    text = rendered(judged)
    final = judged.final
    for scores in final.maps:
        assert row(text, "Against world.npz", scores.robot_id) == [
            f"{scores.score(name):.3f}"
            for name in ("mean_iou", "mean_iou_known", "occupied_accuracy", "free_accuracy", "coverage",
                         "world_coverage", "calibration_error", "calibration_error_occupied")
        ]  # fmt: skip
        cells, entropy, bit, *agreement = row(text, "Maps 5.0 s after the start", scores.robot_id)
        assert (cells, entropy, bit) == (tables.number(scores.num_cells), f"{scores.entropy_bits:.3f}", "bit")
        assert " ".join(agreement) == f"{tables.share(scores.agreement)} {tables.share(scores.agreement_occupied)}"
    assert row(text, "Against world.npz", "mean")[0] == f"{final.mean('mean_iou'):.3f}"
    assert "(posterior of the team), agreement with the centralised map\n" in text
    mean = rendered(dataclasses.replace(judged, map_kind="mean"))
    assert "(mean of the team), agreement with the centralised map\n" in mean
    assert "cells with different labels: 8.33 %" in text


def test_robots_with_equal_maps_are_one_row() -> None:
    judged = evaluation()
    first, final = judged.final.robots[0], judged.final
    equal = tuple(dataclasses.replace(first, robot_id=scores.robot_id) for scores in final.robots)
    assert final.central is not None
    tick = dataclasses.replace(final, maps=(*equal, final.central))
    same = dataclasses.replace(judged, ticks=(tick,))
    text = rendered(same)
    for title in ("Maps 5.0 s after the start", "Against world.npz"):
        assert row(text, title, "all 3")[1:] == row(rendered(same, is_verbose=True), title, first.robot_id)
    assert first.robot_id not in text.replace(f"{first.robot_id} and", "")
    assert "\nmean " not in text
    assert "The robots' maps agree; -v shows each robot." in text
    assert len(row(text, "IoU of the classes", "ground")) == 2
    off = dataclasses.replace(tick, maps=(dataclasses.replace(first, is_active=False), *tick.maps[1:]))
    assert f"{first.robot_id} (off)" in rendered(dataclasses.replace(judged, ticks=(off,)))


def test_the_classes_of_a_small_team_have_one_column_per_robot() -> None:
    judged = evaluation()
    ground = row(rendered(judged), "IoU of the classes", "ground")
    robots = [judged.iou(scores)[0] for scores in judged.final.robots]
    central = judged.final.central
    assert central is not None
    assert ground == [f"{value:.3f}" for value in (*robots, sum(robots) / 3, judged.iou(central)[0])]
    assert row(rendered(judged), "IoU of the classes", "tree")[1] == "-"


def test_the_classes_of_a_large_team_have_columns_mean_least_and_largest() -> None:
    judged = evaluation(num_robots=12)
    ground = row(rendered(judged), "IoU of the classes", "ground")
    robots = [judged.iou(scores)[0] for scores in judged.final.robots]
    assert ground[:3] == [f"{value:.3f}" for value in (sum(robots) / 12, min(robots), max(robots))]
    assert row(rendered(judged), "IoU of the classes", "tree")[:3] == ["-", "-", "-"]


def test_the_table_over_time_ends_at_the_last_tick() -> None:
    judged = evaluation(num_ticks=40)
    lines = rendered(judged).split("Over time")[1].splitlines()
    times = [float(line.split()[0]) for line in lines if " s " in line]
    assert len(times) == MAX_TIMES
    assert (times[0], times[-1]) == (0.0, judged.final.seconds)
    assert times == sorted(set(times))
    assert "Over time" not in rendered(evaluation(num_ticks=1))
    last = next(line for line in lines if line.strip().startswith("97.5 s"))
    central = judged.final.central
    assert central is not None
    assert last.split()[-4:] == [
        *(f"{judged.final.mean(name):.3f}" for name in ("mean_iou", "coverage", "calibration_error")),
        f"{central.score('mean_iou'):.3f}",
    ]


@pytest.mark.parametrize("num_ticks", [1, 2, 11, 12, 13, 14, 25])
def test_the_table_over_time_has_no_duplicate_rows(num_ticks: int) -> None:
    lines = rendered(evaluation(num_ticks=num_ticks)).partition("Over time")[2].splitlines()
    times = [line.split()[0] for line in lines if " s " in line]
    assert len(set(times)) == len(times) == (min(num_ticks, MAX_TIMES) if num_ticks > 1 else 0)


def test_tables_without_truth_and_centralised_map() -> None:
    text = rendered(evaluation(has_truth=False, has_central=False))
    assert "IoU" not in text
    assert "central" not in text.replace("the centralised map", "")
    assert "Over time" in text


def test_inactive_robots_and_the_reference_are_shown() -> None:
    first = evaluation(num_ticks=1)
    text = rendered(dataclasses.replace(first, against="other.mcap"))
    assert "alpha (off)" in text
    assert "agreement with the centralised map of other.mcap" in text
