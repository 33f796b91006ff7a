"""Tables and figures of the experiments: means, missing values and groups."""

import io
import itertools
import math

import pytest

from octoreplay.report import tables
from octoreplay.report.experiment_plots import figures
from octoreplay.report.experiment_tables import NOISES, answer_tables, groups, mean, of_noise, paper_table, variant

NUMBERS = {
    "total_distance_all_log_end": 12345678.0, "total_distance_all": 0.0, "agreement_mean": 0.91234,
    "agreement_occupied_mean": 0.95, "agreement": 0.99, "agreement_occupied": 1.0, "mean_iou": 0.7,
    "mean_iou_known": 0.71, "central_mean_iou": 0.72, "sent_bytes_per_second": 12_345.0, "ticks_to_consensus": 3.0,
    "realtime_factor": 6.54, "peak_rss_bytes": 5e8, "memory_bytes": 2e7, "num_leaves": 43_210.0,
    "contraction": 0.444, "contraction_theory": 0.4444, "epsilon_share": 0.5, "wrong": 0.25, "repaired": 0.125,
    "spread": 0.01, "calibration_error_occupied": 0.5,
    "central_calibration_error_occupied": 0.09,
}  # fmt: skip


def rows(**values: tuple) -> list[dict]:
    """One row for every combination of values."""
    return [
        {"status": "ok", "team": "village_0", **NUMBERS, **dict(zip(values, combination, strict=True))}
        for combination in itertools.product(*values.values())
    ]


ANSWERS = {
    "rules": {
        "rules": rows(
            rule=("gradient", "bayes"), evidence=("sum",), gamma=("1",), gamma_power=("1",), topology=("ring", "line")
        )
    },
    "steps": {
        "steps": rows(rule=("gradient", "natural"), epsilon=("0.1", "0.5"), gamma=("0.5", "1")),
        "bound": rows(topology=("ring",), epsilon=("0.1", "0.5")),
    },
    "scale": {
        "robots": rows(
            team=("robots_02", "robots_04"), topology=("complete", "nearest"), num_robots=(2, 4), resolution=("0.3",)
        ),
        "resolution": rows(resolution=("0.1", "0.2"), rule=("gradient", "bayes")),
        "classes": rows(team=("classes_04", "classes_08"), rule=("gradient",), num_classes=(4, 8)),
    },
    "noise": {
        "noise": [
            {**row, "rule": rule, "label_noise": 0.1, "pose_noise": 0.0, "depth_noise": 1.0, **change}
            for row in rows()
            for rule in ("local", "gradient", "bayes")
            for change in ({}, {"label_noise": 0.4}, {"pose_noise": 0.2}, {"depth_noise": 4.0})
        ]
    },
    "choose": {
        plan: rows(rule=("gradient", "ratio"), packets=("full",), content=("float32",))
        for plan in ("good_radio", "poor_radio", "many_robots")
    },
}


@pytest.mark.parametrize("name", ANSWERS)
def test_every_experiment_has_tables_and_figures(name: str) -> None:
    text = answer_tables(name, ANSWERS[name])
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert lines
    assert "nan" not in text
    for line, below in itertools.pairwise(text.splitlines()):
        if line.startswith("|") and below.startswith("|"):
            assert line.count("|") == below.count("|")
    for file, figure in figures(name, ANSWERS[name]).items():
        assert file.endswith(".png")
        assert any(axes.lines or axes.images for axes in figure.axes)
        figure.canvas.draw()


def test_numbers_are_means_with_three_digits() -> None:
    found = rows(rule=("gradient",), evidence=("sum",), gamma=("0.5",), gamma_power=("0",), topology=("ring",)) * 2
    found[1] = {**found[1], "mean_iou": 0.8, "sent_bytes_per_second": 2_000_345.0, "ticks_to_consensus": math.nan}
    line = answer_tables("rules", {"rules": found}).splitlines()[4]
    assert line == (
        "| gradient, sum, γ 0.5 | 1.2e+07 | 0 | 0.9123 / 0.9500 | 0.9900 / 1.0000 | 0.750 | 0.720 | 1,006 |"
        " never in 1 of 2 |"
    )


def test_a_missing_value_is_a_dash() -> None:
    found = rows(rule=("local",), evidence=("-",), gamma=("-",), gamma_power=("-",), topology=("ring",))
    found[0] |= {"mean_iou": math.nan, "ticks_to_consensus": math.nan, "sent_bytes_per_second": math.nan}
    line = answer_tables("rules", {"rules": found}).splitlines()[4]
    assert line == "| local | 1.2e+07 | 0 | 0.9123 / 0.9500 | 0.9900 / 1.0000 | - | 0.720 | - | never |"


def test_groups_keep_the_order_and_means_skip_missing_values() -> None:
    found = [{"a": 2, "x": 1.0}, {"a": 1, "x": math.nan}, {"a": 2, "x": 4.0}, {"a": 1}]
    assert list(groups(found, "a")) == [(2,), (1,)]
    assert mean(found, "x") == 2.5
    assert math.isnan(mean(found[1:2], "x"))


def test_rows_of_one_kind_of_noise() -> None:
    levels = [(0.4, 0.0, 1.0), (0.3, 0.0, 1.0), (0.1, 0.0, 1.0), (0.1, 0.2, 1.0), (0.1, 0.0, 4.0)]
    found = [dict(zip(NOISES, level, strict=True)) for level in levels]
    assert [row["label_noise"] for row in of_noise(found, "label_noise")] == [0.1, 0.3, 0.4]
    assert [row["pose_noise"] for row in of_noise(found, "pose_noise")] == [0.0, 0.2]
    assert [row["depth_noise"] for row in of_noise(found, "depth_noise")] == [1.0, 4.0]


def test_only_rules_with_gamma_are_named_with_their_evidence_and_gamma() -> None:
    row = {"rule": "natural", "evidence": "sum", "gamma": "1", "gamma_power": "1"}
    assert variant(row) == "natural, sum, γ 1/k"
    assert variant({**row, "rule": "flood"}) == "flood"


def test_the_paper_table_has_one_column_per_moment() -> None:
    moment = {
        "seconds": 60.0, "total_distance": 123.4, "relative_distance": 0.5, "num_known_cells": 12_345,
        "label_disagreement": 0.25, "agreement": 0.9, "agreement_occupied": 0.8, "grid_bytes": 2e6,
        "octree_bytes": 5e5, "ratio": 4.0,
    }  # fmt: skip
    text = io.StringIO()
    tables.show(tables.terminal(file=text, width=100), paper_table([moment, {**moment, "seconds": 300.0}]))
    lines = [line.strip() for line in text.getvalue().splitlines() if line.strip()]
    assert lines[1].split() == ["60", "s", "300", "s"]
    assert [line.split("  ")[-1].strip() for line in lines[3:]] == [
        "123", "50.00 %", "12,345", "25.00 %", "90.00 %", "80.00 %", "2 MB", "500 kB", "4.00",
    ]  # fmt: skip
