"""Pages of results, read by a slow reader and compared with the results."""

from __future__ import annotations

import csv
import dataclasses
import gzip
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from octoreplay.errors import InputError
from octoreplay.log_odds import best_labels, class_probabilities
from octoreplay.report.page import page_tables, series
from octoreplay.report.page.columns import Columns
from octoreplay.report.page.page import page_of, write_page
from octoreplay.report.plots import write_metrics_csv
from octoreplay.result import Result, open_result
from octoreplay.run_metrics import FramePlace
from support.command_line import assert_fails, octoreplay
from support.long_suite import long
from support.page_reader import Page
from support.result_factory import write_result


@pytest.fixture(scope="module")
def trio_page(trio_result: Path, tmp_path_factory: pytest.TempPathFactory) -> Page:
    path = tmp_path_factory.mktemp("page") / "trio.html"
    size = write_page(trio_result, str(path))
    assert size == path.stat().st_size
    return Page(path)


def labels_of(result: Result, robot_id: str, at_ns: int, cells: list[tuple[int, int, int]]) -> tuple[list, list]:
    """Labels and probabilities of cells in a robot's map, 255 where it is unknown."""
    points = (np.array(cells, dtype=np.float64).reshape(-1, 3) + 0.5) * result.config.map.resolution
    answer = result.map(robot_id, at_ns=at_ns).query(points)
    return np.where(answer.known, answer.labels, 255).tolist(), answer.probabilities.max(axis=1).tolist()


@pytest.mark.parametrize("index", [1, -1])
def test_the_maps_are_those_of_the_result(trio_result: Path, trio_page: Page, index: int) -> None:
    rows = trio_page.array(trio_page.header["storedRows"]).tolist()
    index %= len(rows)
    with open_result(trio_result) as result:
        at_ns = result.metrics[rows[index]].stamp_ns
        for name in (*result.robots, "central"):
            cubes, free = trio_page.map(name, index)
            leaves = result.map(name, at_ns=at_ns).leaves()
            assert len(cubes) == int((best_labels(leaves.log_odds) > 0).sum()) > 0
            labels, probabilities = labels_of(result, name, at_ns, list(cubes))
            assert [cube.values["label"] for cube in cubes.values()] == labels
            shown = [cube.values["probability"] / 65535 for cube in cubes.values()]
            np.testing.assert_allclose(shown, probabilities, atol=1e-5)
            assert set(labels_of(result, name, at_ns, sorted(free))[0]) == {0}


def test_the_team_is_the_mean_of_the_maps_that_know_a_cell(trio_result: Path, trio_page: Page) -> None:
    index = len(trio_page.array(trio_page.header["storedRows"])) // 2
    row = trio_page.array(trio_page.header["storedRows"])[index]
    cubes, _ = trio_page.map("/team", index)
    shown = {cell: cube for cell, cube in cubes.items() if cube.values["label"]}
    with open_result(trio_result) as result:
        points = (np.array(list(shown), dtype=np.float64) + 0.5) * result.config.map.resolution
        at_ns = result.metrics[row].stamp_ns
        answers = [result.map(name, at_ns=at_ns).query(points) for name in result.robots]
        means = [result.map(name, at_ns=at_ns).query(points, map_kind="mean") for name in result.robots]
    known = np.stack([answer.known for answer in answers])[:, :, None]
    log_odds = np.sum([np.where(k, a.log_odds, 0) for k, a in zip(known, answers, strict=True)], axis=0)
    log_odds = log_odds / known.sum(axis=0)
    assert best_labels(log_odds).tolist() == [cube.values["label"] for cube in shown.values()]
    np.testing.assert_allclose(
        class_probabilities(log_odds).max(axis=1), [c.values["probability"] / 65535 for c in shown.values()], atol=1e-4
    )
    largest = np.zeros(len(shown))
    for own in means:
        for other in means:
            largest = np.maximum(largest, np.linalg.norm(own.log_odds - other.log_odds, axis=1))
    found = np.array([cube.values["disagreement"] / 500 for cube in shown.values()])
    np.testing.assert_allclose(found, largest, atol=2e-3)
    assert largest.max() > 0.01


def test_contradictions_are_those_of_the_metrics(trio_result: Path, trio_page: Page) -> None:
    index = len(trio_page.array(trio_page.header["storedRows"])) - 1
    cubes, _ = trio_page.map("/team", index)
    masks = trio_page.header["masks"]
    with open_result(trio_result) as result:
        pairs = result.metrics[-1].pairs
        evidence = [result.evidence(name) for name in result.robots]
        centers = (np.array(list(cubes), dtype=np.float64) + 0.5) * result.config.map.resolution
        for robot, own in enumerate(evidence):
            known = own.query(centers).known.tolist()
            assert [robot in masks[cube.values["seen"]] for cube in cubes.values()] == known
    # A cell that two pairs dispute counts once here and twice there.
    most = sum(round(pair.contradiction * pair.occupied_cells) for pair in pairs if pair.occupied_cells)
    clear = sum(round(pair.clear_contradiction * pair.occupied_cells) for pair in pairs if pair.occupied_cells)
    disputed = sum(cube.values["contradiction"] >= 3 for cube in cubes.values())
    assert most / len(pairs) <= disputed <= most
    assert sum(cube.values["contradiction"] == 4 for cube in cubes.values()) <= clear


def test_the_charts_hold_the_values_of_the_csv(trio_result: Path, trio_page: Page, tmp_path: Path) -> None:
    with open_result(trio_result) as result:
        write_metrics_csv(result.metrics, tmp_path / "m.csv")
    rows = list(csv.DictReader((tmp_path / "m.csv").read_text().splitlines()))
    lines = [(chart, line) for chart in trio_page.header["charts"] for line in chart["lines"]]
    assert {"total_distance", "label_disagreement", "agreement", "sent_bytes", "link_bytes", "observed_volume",
            "entropy_bits"} <= {chart["id"] for chart, _ in lines}  # fmt: skip
    for chart, line in lines:
        factor = 100 if chart["unit"] == "%" else 1
        # A link that a tick does not have sent nothing.
        missing = 0 if chart["id"] == "link_bytes" else math.nan
        expected = [factor * float(row[line["column"]] or missing) for row in rows]
        np.testing.assert_allclose(trio_page.array(line["values"]), expected, rtol=1e-12)


def test_poses_and_links(trio_result: Path, trio_page: Page) -> None:
    with open_result(trio_result) as result:
        _, poses = result.poses(result.robots[1])
        shown = trio_page.array(trio_page.header["poses"][1]["poses"]).reshape(-1, 7)
        np.testing.assert_allclose(shown[-1], poses[-1], atol=1e-6)
        assert len(shown) == len(result.metrics)
        pairs = trio_page.array(trio_page.header["links"]["pairs"]).reshape(-1, 2).tolist()
        last = result.metrics[-1].links
        sent = trio_page.array(trio_page.header["links"]["sent"]).reshape(len(pairs), -1)
        ends = [(result.robots[a], result.robots[b]) for a, b in pairs]
        assert {ends[k]: sent[k, -1] for k in range(len(ends))} == {(x.sender, x.receiver): x.num_sent for x in last}


def test_robots_without_a_common_frame_have_different_frames(tmp_path: Path) -> None:
    # Two ticks apart, beta's map gets into the frame of alpha.
    with open_result(write_result(tmp_path, lambda writer: None)) as result:
        apart = (FramePlace("alpha", "team", (0.0,) * 7), FramePlace("beta", "beta/map", (0.0,) * 7))
        together = (apart[0], FramePlace("beta", "team", (0.0,) * 7))
        ticks = [
            dataclasses.replace(tick, places=places)
            for tick, places in zip(result.metrics[:2], (apart, together), strict=True)
        ]
        result.metrics = ticks
        columns = Columns()
        places = series.frames(result, columns)
        block = gzip.decompress(columns.compressed())
    assert [places[name]["count"] for name in ("robots", "team")] == [2 * len(ticks), len(ticks)]
    low_bytes = np.frombuffer(block, np.uint8)[: 2 * len(ticks)].reshape(2, -1)
    assert (low_bytes[0] != low_bytes[1]).tolist() == [True, *[False] * (len(ticks) - 1)]


def test_a_page_loads_nothing_from_elsewhere(trio_page: Page) -> None:
    text = re.sub(r"http://www\.w3\.org/2000/svg", "", trio_page.text)
    assert not re.search(r"""(src|href)=["'](?!data:)|https?://|@import|url\(""", text)
    assert "default-src 'none'" in text


@long
def test_a_page_of_a_depth_has_the_coarse_maps(trio_result: Path, tmp_path: Path) -> None:
    path = tmp_path / "coarse.html"
    done = octoreplay("report", trio_result, "-o", path, "--max-depth", 17)
    assert done.returncode == 0, done.stderr
    page = Page(path)
    with open_result(trio_result) as result:
        assert page.header["resolution"] == 4 * result.config.map.resolution
        for name in (*result.robots, "central"):
            stored = result.map(name).coarsened(17)
            leaves = stored.leaves()
            cubes, _ = page.map(name, len(page.array(page.header["storedRows"])) - 1)
            assert len(cubes) == int((best_labels(leaves.log_odds) > 0).sum()) > 0
            answer = stored.query((np.array(list(cubes)).reshape(-1, 3) + 0.5) * stored.resolution)
            assert [cube.values["label"] for cube in cubes.values()] == answer.labels.tolist()
    edge = page.header["resolution"]
    assert f"The finest cells of the team&#x27;s map on this page have an edge of {edge:g} m." in page.text


@long
def test_equal_results_give_equal_pages(trio_result: Path, trio_page: Page) -> None:
    with open_result(trio_result) as result:
        text = page_of(result)
    assert text.replace("trio.mcap", "") == trio_page.text.replace("trio.mcap", "")


@long
def test_a_page_of_limited_size_has_coarser_maps(trio_result: Path, trio_page: Page, tmp_path: Path) -> None:
    path = tmp_path / "small.html"
    limit = len(trio_page.text) - 20_000
    assert write_page(trio_result, path, max_bytes=limit) <= limit
    small = Page(path)
    levels = small.columns(small.layer("husky_1")["tiles"])["levels"]
    assert levels.min() >= 1
    assert "octoreplay view shows all cells" in small.text
    index = len(small.array(small.header["storedRows"])) - 1
    fine, _ = trio_page.map("husky_1", index)
    coarse, _ = small.map("husky_1", index, level=int(levels.min()))
    step = 1 << int(levels.min())
    assert {tuple(v // step for v in cell) for cell in fine} == {
        (x + i, y + j, z + k) for (x, y, z), cube in coarse.items()
        for i in range(cube.edge) for j in range(cube.edge) for k in range(cube.edge)
    }  # fmt: skip


@long
def test_names_cannot_leave_their_place(trio_result: Path, tmp_path: Path) -> None:
    result = shutil.copy(trio_result, tmp_path / "a<img src=x>&\x1b.mcap")
    text = write_and_read(Path(result), tmp_path)
    assert "<img src=x>" not in text
    assert "\x1b" not in text
    assert "a&lt;img src=x&gt;&amp;\\x1b.mcap" in text


def write_and_read(result: Path, folder: Path) -> str:
    write_page(result, folder / "p.html")
    return (folder / "p.html").read_text()


def test_settings_have_units(trio_result: Path) -> None:
    with open_result(trio_result) as result:
        text = page_tables.tables(result)
    for name, unit in (("max_range", "m"), ("publish_period", "s"), ("rule", "")):
        [found] = re.findall(rf"<tr><td[^>]*>{name}</td><td[^>]*>[^<]*</td><td[^>]*>([^<]*)</td>", text)
        assert found == unit


def test_a_result_without_maps_or_evidence(tmp_path: Path) -> None:
    result = write_result(tmp_path, lambda writer: None)
    text = write_and_read(result, tmp_path)
    assert "holds no map" in text
    page = Page(tmp_path / "p.html")
    assert page.header["layers"] == []
    assert not page.header["hasEvidence"]


def test_bad_results(tmp_path: Path, trio_result: Path) -> None:
    assert_fails(1, "none.mcap", "report", tmp_path / "none.mcap", "-o", tmp_path / "a.html")
    assert_fails(2, "must end in .html", "report", trio_result, "-o", tmp_path / "a.txt")
    assert_fails(2, "'9 cows' is not a size", "report", trio_result, "-o", tmp_path / "a.html", "--max-size", "9 cows")
    (tmp_path / "other.mcap").write_bytes(b"not MCAP")
    assert_fails(1, "other.mcap", "report", tmp_path / "other.mcap", "-o", tmp_path / "a.html")
    assert not (tmp_path / "a.html").exists()


@long
def test_the_command_names_the_page(trio_result: Path, tmp_path: Path) -> None:
    done = octoreplay("report", trio_result, "-o", tmp_path / "a.html")
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(
        rf"wrote {re.escape(str(tmp_path / 'a.html'))} \([\d.]+ kB\); open it in a browser\n", done.stdout
    )


def test_a_result_without_ticks_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("octoreplay.result.Result.metrics", [])
    result = write_result(tmp_path, lambda writer: None)
    with pytest.raises(InputError, match="holds no tick"):
        write_page(result, tmp_path / "a.html")


@long
def test_a_page_that_cannot_be_small_enough_warns(trio_result: Path, tmp_path: Path) -> None:
    done = octoreplay("report", trio_result, "-o", tmp_path / "a.html", "--max-size", "10kB")
    assert done.returncode == 0
    assert "a.html is larger than --max-size" in done.stderr


def test_a_window_needs_a_screen(trio_result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert_fails(1, "has no screen; use 'octoreplay view' without --window", "view", trio_result, "--window")
