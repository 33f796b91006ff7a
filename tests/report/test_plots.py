import csv
import dataclasses
import io
import itertools
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from octoreplay.errors import InputError, OutputError
from octoreplay.report import plots
from octoreplay.report.contradiction_plots import MAX_COLORED, contradiction_figure
from octoreplay.report.figures import SCREEN
from octoreplay.report.log_time import PlottedRun
from octoreplay.run_metrics import MIN_COMPARED_CELLS, PAIR_SHARES, PairMetrics, TickMetrics
from support.long_suite import long
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
    of_tick = {item.name for item in dataclasses.fields(tick)} - {"robots", "links", "pairs", "places"}
    of_tick |= {*PAIR_SHARES, "num_components"}
    of_robot = {f"alpha.{item.name}" for item in dataclasses.fields(robot)} - {"alpha.robot_id"}
    of_pair = {f"alpha&beta.{item.name}" for item in dataclasses.fields(PairMetrics)}
    assert names >= of_tick | of_robot | of_pair - {"alpha&beta.first", "alpha&beta.second"}


def test_csv_has_the_pairs_and_empty_cells_without_them() -> None:
    none = dataclasses.replace(METRICS[0], pairs=())
    table = rows(plots.metrics_csv([none, *METRICS[1:]]))
    assert (table[0]["contradiction"], table[0]["alpha&beta.overlap_cells"]) == ("", "")
    assert float(table[1]["clear_contradiction"]) == float(table[1]["alpha&beta.clear_contradiction"]) == 0.02
    assert (table[1]["alpha&beta.occupied_cells"], table[1]["label_contradiction"]) == ("1000", "0.125")


def test_ticks_without_a_link_have_empty_columns_for_it() -> None:
    table = rows(plots.metrics_csv([tick_metrics(1, links=False), tick_metrics(2), tick_metrics(3, links=False)]))
    assert [row["alpha>beta.num_sent"] for row in table] == ["", "1", ""]


@long
def test_figures_are_not_blank_and_reproducible(tmp_path: Path) -> None:
    first = plots.write_figures(METRICS, tmp_path / "a" / "b")
    second = plots.write_figures(METRICS, tmp_path / "c")
    names = ("disagreement", "agreement", "packet_size", "contradiction")
    assert [path.name for path in first] == [f"{name}.png" for name in names]
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()
        with Image.open(one) as image:
            assert image.width == (1650 if one.name == "contradiction.png" else 1050)
            assert len(np.unique(np.asarray(image.convert("L")))) > 20


def large_team(num_robots: int) -> list[TickMetrics]:
    """Ticks of a team in which the pairs of the last robot contradict each other most, and one pair is too small."""
    ids = [f"robot_{index}" for index in range(num_robots)]
    robots = tuple(dataclasses.replace(METRICS[0].robots[0], robot_id=name) for name in ids)
    made = []
    for tick in METRICS:
        pairs = tuple(
            dataclasses.replace(
                tick.pairs[0],
                first=a,
                second=b,
                contradiction=(0.6 if b == ids[-1] else 0.1) + n / 1e4,
                clear_contradiction=(0.06 if b == ids[-1] else 0.01) + n / 1e5,
            )
            for n, (a, b) in enumerate(itertools.combinations(ids, 2))
        )
        small = dataclasses.replace(
            pairs[0], occupied_cells=MIN_COMPARED_CELLS - 1, contradiction=1.0, clear_contradiction=1.0
        )
        made.append(dataclasses.replace(tick, robots=robots, pairs=(small, *pairs[1:])))
    return made


@long
@pytest.mark.parametrize("num_robots", [2, 6, 16])
def test_the_worst_pairs_have_colours_and_the_others_are_grey(num_robots: int) -> None:
    metrics = METRICS if num_robots == 2 else large_team(num_robots)
    figure, _ = contradiction_figure([PlottedRun("run", metrics)], SCREEN)
    lines = figure.axes[0].get_lines()
    counted = 1 if num_robots == 2 else num_robots * (num_robots - 1) // 2 - 1
    assert len(lines) == counted
    named = [line.get_label() for line in lines if "," in line.get_label()]
    assert len(named) == min(counted, MAX_COLORED)
    if num_robots > 2:
        assert all(f", robot_{num_robots - 1}" in label for label in named)
        assert max(line.get_ydata()[-1] for line in lines) < 100.0
    (image,) = next(axes for axes in figure.axes if axes.images).images
    assert image.get_array().shape == (num_robots, num_robots)


@long
def test_figures_of_a_run_without_exchange_or_disagreement(tmp_path: Path) -> None:
    silent = [
        dataclasses.replace(
            tick, total_distance_published=0.0, total_distance=0.0, total_distance_all=0.0, links=(), pairs=(),
            robots=tuple(dataclasses.replace(r, packet_bytes=0, octree_bytes=0, grid_bytes=0) for r in tick.robots),
        )
        for tick in METRICS[:1]
    ]  # fmt: skip
    assert len(plots.write_figures(silent, tmp_path)) == 3


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
