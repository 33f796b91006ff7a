"""Evaluations as CSV and JSON have the values of the records."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
from pathlib import Path

import pytest

from octoreplay.errors import OutputError
from octoreplay.evaluate.records import SCORES, MapScores, TruthScores
from octoreplay.io.text_files import json_text
from octoreplay.records import CENTRAL
from octoreplay.report.evaluation_files import evaluation_content, evaluation_csv, write_evaluation
from octoreplay.run_metrics import PAIR_SHARES
from support.evaluation_factory import evaluation


def rows(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def number(cell: str) -> float:
    return float(cell) if cell else math.nan


def test_csv_has_one_row_per_map_and_three_for_the_team() -> None:
    judged = evaluation()
    table = rows(evaluation_csv(judged))
    assert len(table) == len(judged.ticks) * (len(judged.ticks[0].maps) + 3)
    assert {row["map_kind"] for row in table} == {"posterior"}
    of_means = dataclasses.replace(judged, map_kind="mean")
    assert {row["map_kind"] for row in rows(evaluation_csv(of_means))} == {"mean"}
    assert json.loads(json_text(evaluation_content(of_means)))["map_kind"] == "mean"
    places = iter(table)
    for tick in judged.ticks:
        for scores in tick.maps:
            row = next(places)
            assert (int(row["tick"]), float(row["seconds"])) == (tick.tick, tick.seconds)
            assert float(row["label_disagreement"]) == tick.label_disagreement
            assert [repr(number(row[name])) for name in PAIR_SHARES] == [
                repr(getattr(tick, name)) for name in PAIR_SHARES
            ]
            assert row["robot_id"] == scores.robot_id
            assert row["kind"] == ("central" if scores.robot_id == CENTRAL else "robot")
            assert row["is_active"] == str(int(scores.is_active))
            for name in SCORES:
                assert repr(number(row[name])) == repr(float(scores.score(name)))
            for name, value in zip(judged.class_names, judged.iou(scores), strict=True):
                assert repr(number(row[f"iou.{name}"])) == repr(value)
        for kind in ("mean", "least", "largest"):
            row = next(places)
            assert (row["kind"], row["robot_id"], row["is_active"]) == (kind, "", "")
            over_robots = {"mean": tick.mean, "least": tick.least}.get(kind)
            if over_robots is not None:
                assert all(repr(number(row[name])) == repr(float(over_robots(name))) for name in SCORES)


def test_csv_and_json_have_every_field() -> None:
    fields = (item.name for record in (MapScores, TruthScores) for item in dataclasses.fields(record))
    names = set(fields) - {"truth", "iou"}
    assert names | {"iou.ground", "iou.tree"} <= set(rows(evaluation_csv(evaluation()))[0])
    tick = json.loads(json_text(evaluation_content(evaluation())))["ticks"][0]
    assert set(tick["maps"][0]) == names | {"iou"}
    assert set(tick["mean"]) == set(tick["least"]) == set(tick["largest"]) == {*SCORES, "iou"}


def test_json_and_csv_have_equal_values() -> None:
    judged = evaluation()
    content = json.loads(json_text(evaluation_content(judged)))
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


def test_team_statistics_are_over_the_active_robots() -> None:
    judged = evaluation()
    tick = judged.ticks[0]
    by_kind = {row["kind"]: row for row in rows(evaluation_csv(judged))[: len(tick.maps) + 3]}
    values = [scores.score("coverage") for scores in tick.maps if scores.is_active and scores.robot_id != CENTRAL]
    assert len(values) == 2
    assert float(by_kind["least"]["coverage"]) == min(values)
    assert float(by_kind["largest"]["coverage"]) == max(values)
    assert float(by_kind["mean"]["coverage"]) == pytest.approx(sum(values) / 2)
    # A class without an IoU in the map of one robot has none in the team.
    assert by_kind["mean"]["iou.tree"] == by_kind["least"]["iou.tree"] == ""


def test_a_file_is_written_to_the_given_path(tmp_path: Path) -> None:
    write_evaluation(evaluation(), tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text() == evaluation_csv(evaluation())
    with pytest.raises(OutputError):
        write_evaluation(evaluation(), tmp_path / "none" / "a.csv")
