import csv
import dataclasses
import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from octoreplay.errors import InputError, OutputError
from octoreplay.report import plots
from support.result_factory import tick_metrics

METRICS = [tick_metrics(tick, settling=tick > 6) for tick in range(1, 9)]


def rows(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_csv_has_one_row_per_tick_with_exact_numbers() -> None:
    table = rows(plots.metrics_csv(METRICS))
    assert [int(row["tick"]) for row in table] == list(range(1, 9))
    assert [row["settling"] for row in table] == ["0"] * 6 + ["1"] * 2
    assert float(table[2]["total_distance"]) == METRICS[2].total_distance
    assert float(table[2]["distance_per_cell_and_link"]) == 2e-300
    assert int(table[4]["stamp_ns"]) == METRICS[4].stamp_ns
    assert int(table[4]["beta.packet_bytes"]) == METRICS[4].robots[1].packet_bytes
    assert int(table[4]["beta>alpha.sent_bytes"]) == METRICS[4].links[1].sent_bytes


def test_csv_has_every_field_of_a_robot_and_of_a_tick() -> None:
    names = set(rows(plots.metrics_csv(METRICS))[0])
    tick, robot = METRICS[0], METRICS[0].robots[0]
    of_tick = {item.name for item in dataclasses.fields(tick)} - {"robots", "links"}
    of_robot = {f"alpha.{item.name}" for item in dataclasses.fields(robot)} - {"alpha.robot_id"}
    assert names >= of_tick | of_robot


def test_ticks_without_a_link_have_empty_columns_for_it() -> None:
    table = rows(plots.metrics_csv([tick_metrics(1, links=False), tick_metrics(2), tick_metrics(3, links=False)]))
    assert [row["alpha>beta.num_sent"] for row in table] == ["", "1", ""]


def test_figures_are_not_blank_and_reproducible(tmp_path: Path) -> None:
    first = plots.write_figures(METRICS, tmp_path / "a" / "b")
    second = plots.write_figures(METRICS, tmp_path / "c")
    assert [path.name for path in first] == ["disagreement.png", "packet_size.png"]
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()
        with Image.open(one) as image:
            assert image.size == (1050, 540)
            assert len(np.unique(np.asarray(image.convert("L")))) > 20


def test_figures_have_the_values_of_the_metrics() -> None:
    figure = plots._disagreement_figure(METRICS)
    axes = figure.axes[0]
    curves = {line.get_label(): line for line in axes.get_lines()}
    np.testing.assert_array_equal(curves["\u03a6 over the links"].get_ydata(), [m.total_distance for m in METRICS])
    np.testing.assert_array_equal(curves["\u03a6 over all pairs"].get_ydata(), [m.total_distance_all for m in METRICS])
    assert axes.get_yscale() == "log"
    packets = {line.get_label(): line for line in plots._packet_figure(METRICS).axes[0].get_lines()}
    mean = [np.mean([robot.grid_bytes for robot in tick.robots]) for tick in METRICS]
    np.testing.assert_allclose(packets["uniform grid"].get_ydata(), mean)


def test_a_robot_that_did_not_publish_is_left_out_of_the_mean() -> None:
    silent = dataclasses.replace(METRICS[0].robots[0], packet_bytes=0, octree_bytes=0, grid_bytes=0)
    tick = dataclasses.replace(METRICS[0], robots=(silent, METRICS[0].robots[1]))
    mean, deviation = plots.over_robots([tick], "grid_bytes")
    assert mean.tolist() == [METRICS[0].robots[1].grid_bytes]
    assert deviation.tolist() == [0.0]


def test_figures_of_a_run_without_exchange_or_disagreement(tmp_path: Path) -> None:
    silent = [
        dataclasses.replace(
            tick, total_distance=0.0, total_distance_all=0.0, links=(),
            robots=tuple(dataclasses.replace(r, packet_bytes=0, octree_bytes=0, grid_bytes=0) for r in tick.robots),
        )
        for tick in METRICS[:1]
    ]  # fmt: skip
    assert len(plots.write_figures(silent, tmp_path)) == 2


def test_metrics_without_a_tick_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no tick to draw"):
        plots.write_figures([], tmp_path)


def test_paths_that_cannot_be_written_raise(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"file: cannot be written: File exists"):
        plots.write_figures(METRICS, tmp_path / "file")
    with pytest.raises(OutputError, match=r"none/a\.csv: cannot be written: No such file"):
        plots.write_metrics_csv(METRICS, tmp_path / "none" / "a.csv")


def test_the_csv_file_has_the_text(tmp_path: Path) -> None:
    plots.write_metrics_csv(METRICS, tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text(encoding="utf-8") == plots.metrics_csv(METRICS)
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]
