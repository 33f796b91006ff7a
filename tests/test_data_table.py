"""Results as tables of NumPy, pandas and Polars."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import octoreplay
from octoreplay.data_table import Table
from octoreplay.errors import ConfigError, InputError
from octoreplay.evaluate.checks import CheckRow
from octoreplay.evaluate.evaluation import evaluate_result
from octoreplay.io.results.result_writer import partial_path
from octoreplay.records import LeafTable
from octoreplay.report.evaluation_files import evaluation_csv
from octoreplay.report.plots import metrics_csv
from octoreplay.result import open_result
from octoreplay.study.folder import table_csv
from octoreplay.study.sweep import Sweep
from support.fixture_paths import FIXTURES
from support.result_factory import START, leaf_table, write_killed, write_result, write_until
from support.result_factory import tick_metrics as metrics_of

RESULT = FIXTURES / "result_3.mcap"


def assert_equal_texts(column: np.ndarray, texts: list[str]) -> None:
    """Compare a column with cells of a CSV file."""
    if column.dtype.kind in "US":
        assert column.tolist() == texts
    else:
        numbers = [math.nan if text == "" else float(text) for text in texts]
        np.testing.assert_array_equal(column.astype(np.float64), numbers)


def test_the_summary_is_a_table_of_one_row() -> None:
    with open_result(RESULT) as result:
        summary = result.summary
    table = summary.as_table()
    assert len(table) == 1
    for name in ("num_ticks", "stop_reason", "total_sent_bytes", "sent_bytes_per_second"):
        assert table[name][0] == getattr(summary, name)
    assert {"last", "links", "joins"}.isdisjoint(table.columns)


def test_metric_tables_hold_the_values_of_metrics_csv() -> None:
    with open_result(RESULT) as result:
        tables = {kind: result.as_table(kind) for kind in ("ticks", "robots", "links", "pairs")}
        rows = list(csv.DictReader(io.StringIO(metrics_csv(result.metrics))))
    left = set(rows[0])
    for name in rows[0]:
        if "." not in name:
            assert_equal_texts(tables["ticks"][name], [row[name] for row in rows])
            left.remove(name)
    keys = {
        "robots": lambda table: table["robot_id"],
        "links": lambda table: np.char.add(np.char.add(table["sender"], ">"), table["receiver"]),
        "pairs": lambda table: np.char.add(np.char.add(table["first"], "&"), table["second"]),
    }
    for kind, key in keys.items():
        table = tables[kind]
        for member in set(key(table)):
            chosen = key(table) == member
            of_tick = dict(zip(table["tick"][chosen].tolist(), np.flatnonzero(chosen), strict=True))
            for name in table.columns:
                if f"{member}.{name}" in left:
                    texts = [row[f"{member}.{name}"] for row in rows if int(row["tick"]) in of_tick]
                    assert_equal_texts(table[name][list(of_tick.values())], texts)
                    left.remove(f"{member}.{name}")
    assert not left
    assert len(tables["pairs"]) > 0


def test_tables_have_times_since_the_start(tmp_path: Path) -> None:
    with open_result(write_result(tmp_path)) as result:
        for kind in ("ticks", "robots", "links", "pairs", "poses"):
            table = result.as_table(kind)
            assert list(table.columns)[:3] == ["tick", "stamp_ns", "seconds"]
            np.testing.assert_array_equal(table["stamp_ns"], START + table["tick"] * 1_000_000_000)
            np.testing.assert_array_equal(table["seconds"], [result.seconds(int(stamp)) for stamp in table["stamp_ns"]])
            assert (np.diff(table["tick"]) >= 0).all()


def test_the_table_of_poses_has_a_row_per_tick_and_robot(tmp_path: Path) -> None:
    with open_result(write_result(tmp_path)) as result:
        table = result.as_table("poses")
    assert table["robot_id"].tolist() == ["alpha", "beta"] * 4
    assert table["x"].tolist() == [1, 0, 2, 0, 3, 0, 4, 0]
    assert set(table["frame_id"]) == {"team"}
    np.testing.assert_allclose(np.column_stack([table[name] for name in ("qx", "qy", "qz", "qw")])[0],
                               [0, 0, math.sqrt(0.5), math.sqrt(0.5)])  # fmt: skip


def test_an_unknown_table_and_a_result_without_a_tick_are_sentences(tmp_path: Path) -> None:
    with open_result(RESULT) as result, pytest.raises(ConfigError, match="'rows' is not one of ticks, robots, links"):
        result.as_table("rows")
    killed = write_killed(tmp_path / "result.mcap", [])
    with open_result(killed) as result:
        for kind in ("ticks", "links", "poses"):
            with pytest.raises(InputError, match="holds no tick"):
                result.as_table(kind)


def test_tables_without_rows_have_their_columns(tmp_path: Path) -> None:
    path = tmp_path / "result.mcap"
    with pytest.raises(RuntimeError):
        write_until(RuntimeError, path, [metrics_of(1, links=False)])
    with open_result(partial_path(path)) as result:
        links, poses = result.as_table("links"), result.as_table("poses")
    assert (len(links), len(poses)) == (0, 0)
    assert links["sender"].dtype.kind == "U"
    assert links["sent_bytes"].dtype == np.int64
    assert poses["x"].dtype == np.float64
    assert links.to_numpy().shape == (0,)
    assert list(links.to_pandas().columns) == list(links.columns) == links.to_polars().columns


def test_the_leaves_of_a_map_are_a_table() -> None:
    with open_result(RESULT) as result:
        stored = result.map(result.robots[0])
        leaves, table = stored.leaves(), stored.as_table()
        answer = stored.query(leaves.centers[:5])
        mean = stored.as_table(map_kind="mean")
    np.testing.assert_array_equal(np.column_stack([table[name] for name in "xyz"]), leaves.centers)
    np.testing.assert_array_equal(table["size"], leaves.sizes)
    np.testing.assert_array_equal(table["label"][:5], answer.labels)
    probabilities = answer.probabilities[range(5), answer.labels]
    np.testing.assert_allclose(table["probability"][:5], probabilities, rtol=1e-5)
    np.testing.assert_array_equal(table["log_odds_1"], leaves.log_odds[:, 0])
    asked = answer.as_table()
    np.testing.assert_array_equal(asked["known"], np.ones(5, dtype=np.bool_))
    np.testing.assert_array_equal(asked["probability_0"], answer.probabilities[:, 0])
    np.testing.assert_array_equal(asked["size"], answer.sizes)
    assert not np.array_equal(mean["log_odds_1"], table["log_odds_1"])
    empty = LeafTable(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2), dtype=np.float32)).as_table()
    assert list(empty.columns) == ["x", "y", "z", "size", "log_odds_1", "log_odds_2"]


def test_an_evaluation_as_a_table_holds_the_values_of_its_csv() -> None:
    evaluation = evaluate_result(RESULT, over_time=False)
    table = evaluation.as_table()
    rows = [row for row in csv.DictReader(io.StringIO(evaluation_csv(evaluation))) if row["robot_id"]]
    assert len(table) == len(rows) > 0
    for name in table.columns:
        assert_equal_texts(table[name], [row[name] for row in rows])
    assert set(rows[0]) - set(table.columns) <= {"kind", "map_kind", *octoreplay.run_metrics.PAIR_SHARES}


def test_comparisons_and_checks_are_tables() -> None:
    comparison = octoreplay.compare_results(RESULT, RESULT)
    table = comparison.as_table()
    assert table["robot_id"].tolist() == [difference.robot_id for difference in comparison.maps]
    assert table["num_cells_both"].tolist() == [difference.num_cells_both for difference in comparison.maps]
    assert "label_changes" not in table.columns
    rows = octoreplay.check_result(RESULT, {"max_packet_bytes": 1, "min_agreement": 0})
    checks = Table.from_records(CheckRow, rows)
    assert checks["measured"].tolist() == [row.measured for row in rows]
    assert checks["robot"].tolist() == [row.robot or "" for row in rows]
    assert checks["passed"].dtype == np.bool_


def test_a_sweep_as_a_table_holds_the_values_of_its_csv(tmp_path: Path) -> None:
    names = ("rule", "loss", "bounds", "status", "num_ticks", "total_distance", "exact", "error")
    varied = ("rule", "loss", "bounds")
    rows = (
        {"rule": "bayes", "loss": "0", "bounds": "-1,2", "status": "ok", "num_ticks": 4, "total_distance": 0.1,
         "exact": True, "error": ""},
        {"rule": "local", "loss": "0.25", "bounds": "-", "status": "failed", "error": "it failed", "exact": False},
    )  # fmt: skip
    table = Sweep(tmp_path, tmp_path / "table.csv", varied, names, rows, 0, ()).as_table()
    written = list(csv.DictReader(io.StringIO(table_csv(names, rows))))
    for name in ("rule", "loss", "bounds", "status", "num_ticks", "total_distance", "error"):
        assert_equal_texts(table[name], [row[name] for row in written])
    assert (table["loss"].dtype, table["bounds"].dtype.kind) == (np.float64, "U")
    assert table["exact"].dtype == np.bool_
    assert Table.from_rows(["n"], [{"n": 1}, {"n": 2}])["n"].dtype == np.int64
    assert Table.from_rows(["n"], [{"n": 1}, {"n": "a"}])["n"].tolist() == ["1", "a"]


@pytest.fixture
def table() -> Table:
    values = {"name": ["a", "bc"], "share": [0.5, math.nan], "count": [1, 2], "passed": [True, False]}
    return Table({name: np.array(column) for name, column in values.items()})


def test_a_table_becomes_an_array_and_data_frames(table: Table) -> None:
    array = table.to_numpy()
    assert array.dtype.names == ("name", "share", "count", "passed")
    frames: list[Any] = [array, table.to_pandas(), table.to_polars()]
    for frame in frames:
        assert list(frame["name"]) == ["a", "bc"]
        assert list(frame["count"]) == [1, 2]
        assert list(frame["passed"]) == [True, False]
        np.testing.assert_array_equal(np.array(frame["share"]), [0.5, math.nan])
    assert repr(table) == "Table(2 rows: name, share, count, passed)"
    assert len(Table({})) == 0


@pytest.mark.parametrize("name", ["pandas", "polars"])
def test_a_missing_library_is_one_sentence(table: Table, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigError, match=f"^{name} is not installed; use pip install {name}$"):
        getattr(table, f"to_{name}")()


def test_dir_shows_public_names_only() -> None:
    assert dir(octoreplay) == sorted(octoreplay.__all__)
    with open_result(RESULT) as result:
        stored = result.map("central")
        for value in (result, stored):
            names = dir(value)
            assert {"as_table", "robots" if value is result else "leaves"} <= set(names)
            assert not [name for name in names if name.startswith("_")]
    fields = {item.name for item in dataclasses.fields(leaf_table())}
    assert fields <= set(dir(leaf_table()))
