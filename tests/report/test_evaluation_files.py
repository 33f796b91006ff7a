"""Evaluations as CSV and JSON hold what the records hold."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
from pathlib import Path

import pytest

from octoreplay.errors import OutputError
from octoreplay.evaluate.records import MapScores
from octoreplay.records import CENTRAL
from octoreplay.report.evaluation_files import SCORES, evaluation_csv, evaluation_json, write_evaluation
from support.evaluation_factory import evaluation


def rows(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def number(cell: str) -> float:
    return float(cell) if cell else math.nan


def test_csv_has_a_row_for_each_map_and_three_for_the_team() -> None:
    judged = evaluation()
    table = rows(evaluation_csv(judged))
    assert len(table) == len(judged.ticks) * (len(judged.ticks[0].maps) + 3)
    places = iter(table)
    for tick in judged.ticks:
        for scores in tick.maps:
            row = next(places)
            assert (int(row["tick"]), float(row["seconds"])) == (tick.tick, tick.seconds)
            assert float(row["label_disagreement"]) == tick.label_disagreement
            assert row["robot_id"] == scores.robot_id
            assert row["kind"] == ("central" if scores.robot_id == CENTRAL else "robot")
            assert row["is_active"] == str(int(scores.is_active))
            for name in SCORES:
                assert repr(number(row[name])) == repr(float(getattr(scores, name)))
            for name, value in zip(judged.class_names, scores.iou, strict=True):
                assert repr(number(row[f"iou.{name}"])) == repr(value)
        for kind in ("mean", "least", "largest"):
            row = next(places)
            assert (row["kind"], row["robot_id"], row["is_active"]) == (kind, "", "")
            over_robots = {"mean": tick.mean, "least": tick.least}.get(kind)
            if over_robots is not None:
                assert all(repr(number(row[name])) == repr(float(over_robots(name))) for name in SCORES)


def test_csv_and_json_leave_no_field_out() -> None:
    names = {item.name for item in dataclasses.fields(MapScores)} - {"iou"}
    assert names | {"iou.ground", "iou.tree"} <= set(rows(evaluation_csv(evaluation()))[0])
    tick = json.loads(evaluation_json(evaluation()))["ticks"][0]
    assert set(tick["maps"][0]) == names | {"iou"}
    assert set(tick["mean"]) == set(tick["least"]) == set(tick["largest"]) == {*SCORES, "iou"}


def test_json_says_what_csv_says() -> None:
    judged = evaluation()
    content = json.loads(evaluation_json(judged))
    assert {name: content[name] for name in ("result", "truth", "against")} == {
        "result": "result.mcap", "truth": "world.npz", "against": "central",
    }  # fmt: skip
    assert content["class_names"] == list(judged.class_names)
    places = iter(rows(evaluation_csv(judged)))
    for tick in content["ticks"]:
        for entry in (*tick["maps"], tick["mean"], tick["least"], tick["largest"]):
            row = next(places)
            for name in SCORES:
                assert (entry[name] is None) == (row[name] == "")
                assert entry[name] is None or entry[name] == float(row[name])
            assert [number(row[f"iou.{name}"]) for name in judged.class_names] == pytest.approx(
                [math.nan if value is None else value for value in entry["iou"]], nan_ok=True
            )


def test_the_team_is_counted_over_its_active_robots() -> None:
    judged = evaluation()
    tick = judged.ticks[0]
    by_kind = {row["kind"]: row for row in rows(evaluation_csv(judged))[: len(tick.maps) + 3]}
    values = [scores.coverage for scores in tick.maps if scores.is_active and scores.robot_id != CENTRAL]
    assert len(values) == 2
    assert float(by_kind["least"]["coverage"]) == min(values)
    assert float(by_kind["largest"]["coverage"]) == max(values)
    assert float(by_kind["mean"]["coverage"]) == pytest.approx(sum(values) / 2)
    # A class that one of the robots has no IoU of has none in the team.
    assert by_kind["mean"]["iou.tree"] == by_kind["least"]["iou.tree"] == ""


def test_files_are_written(tmp_path: Path) -> None:
    write_evaluation(evaluation())
    assert list(tmp_path.iterdir()) == []
    write_evaluation(evaluation(), csv_path=tmp_path / "a.csv", json_path=tmp_path / "a.json")
    assert (tmp_path / "a.csv").read_text() == evaluation_csv(evaluation())
    assert (tmp_path / "a.json").read_text() == evaluation_json(evaluation())
    with pytest.raises(OutputError):
        write_evaluation(evaluation(), csv_path=tmp_path / "none" / "a.csv")
