"""A result in tiles reads as that of the whole run."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.team_file import load_team_file
from octoreplay.errors import InputError, OutputError
from octoreplay.evaluate.comparison import compare_results
from octoreplay.evaluate.evaluation import evaluate_result
from octoreplay.io.containers.mcap_writer import RosMcapWriter
from octoreplay.io.results.result_reader import ResultReader
from octoreplay.io.results.tile_files import maps_folder
from octoreplay.log_odds import best_labels
from octoreplay.records import CENTRAL
from octoreplay.replay.run import replay_team
from octoreplay.report.cell_colors import COLORS
from octoreplay.report.export import export_map
from octoreplay.report.page.page import write_page
from octoreplay.report.queries import answer_query
from octoreplay.report.viewers.rerun_recording import write_rerun
from octoreplay.result import Result, open_result
from octoreplay.study.tiles import run as tiled_run
from octoreplay.study.tiles.run import replay_tiles
from support.command_line import assert_fails, octoreplay
from support.fixture_paths import TRIO_TEAM
from support.long_suite import long
from support.page_reader import Page

EDGE = 9.6
"""Least edge of tiles of the fixture, 32 cells [m]."""
BOUNDS = (-2.0, -3.0, 0.0, 11.5, 4.0, 2.0)
"""Box over several tiles [m]."""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Result of a whole run, and of the same run in tiles."""
    folder = tmp_path_factory.mktemp("results")
    config = load_team_file(TRIO_TEAM).with_parameters({"state_every": 4.0, "evidence_every": 4.0, "duration": 8.0})
    replay_team(config, folder / "whole.mcap")
    replay_tiles(config, folder / "tiled.mcap", EDGE, num_jobs=2, result_per_tile=True)
    return folder / "whole.mcap", folder / "tiled.mcap"


@pytest.fixture
def moved(results: tuple[Path, Path], tmp_path: Path) -> Path:
    """Copy of the result in tiles, with its files, in another folder."""
    shutil.copy(results[1], tmp_path)
    shutil.copytree(maps_folder(results[1]), tmp_path / "tiled.maps")
    return tmp_path / "tiled.mcap"


def check_close(one, other, place: str = "") -> None:
    """Compare records: real numbers to 1e-12, calibration errors to 1e-9, all else exactly."""
    if dataclasses.is_dataclass(one):
        one, other = vars(one), vars(other)
    if isinstance(one, dict):
        for name in one.keys() - {"result", "b"}:
            check_close(one[name], other[name], f"{place}.{name}")
    elif isinstance(one, list | tuple):
        assert len(one) == len(other), place
        for number, pair in enumerate(zip(one, other, strict=True)):
            check_close(*pair, f"{place}[{number}]")
    elif isinstance(one, float) and not math.isnan(one):
        # Probabilities are rounded to 24 bits, which depends on the number of leaves that are computed together.
        tolerance = 1e-9 if "calibration" in place else 1e-12
        assert other == pytest.approx(one, rel=tolerance, abs=tolerance), place
    else:
        assert one == other or (one != one and other != other), place


def leaves(stored) -> dict[bytes, bytes]:
    """Log-odds of leaves by their place and size."""
    table = stored.leaves()
    places = np.column_stack([table.centers, table.sizes])
    return {place.tobytes(): values.tobytes() for place, values in zip(places, table.log_odds, strict=True)}


@long
def test_maps_and_evidence_are_those_of_the_whole_run(results: tuple[Path, Path]) -> None:
    with open_result(results[0]) as whole, open_result(results[1]) as tiled:
        assert len(list(tiled.boxes())) > 4
        assert list(whole.boxes(BOUNDS)) == [BOUNDS]
        for name in (*whole.robots, CENTRAL):
            assert tiled.stored_ticks(name) == whole.stored_ticks(name)
            assert leaves(tiled.map(name)) == leaves(whole.map(name))
            tick = whole.stored_ticks(name)[1]
            part = whole.map(name, tick=tick, bounds=BOUNDS)
            assert leaves(tiled.map(name, tick=tick, bounds=BOUNDS)) == leaves(part)
            cells = [tiled.map(name, tick=tick, bounds=box).octree.num_cells for box in tiled.boxes(BOUNDS)]
            assert sum(cells) == part.octree.num_cells
        for robot_id in whole.robots:
            assert leaves(tiled.evidence(robot_id)) == leaves(whole.evidence(robot_id))
        for one, other in zip(whole.history(), tiled.history(), strict=True):
            assert {name: leaves(stored) for name, stored in one.items()} == {
                name: leaves(stored) for name, stored in other.items()
            }


@long
def test_comparison_and_evaluation_are_those_of_the_whole_run(results: tuple[Path, Path]) -> None:
    whole, tiled = results
    assert compare_results(whole, tiled).is_same
    assert compare_results(tiled, tiled).is_same
    truth = TRIO_TEAM.parent / "world.npz"
    check_close(evaluate_result(whole, truth=truth), evaluate_result(tiled, truth=truth))
    check_close(evaluate_result(whole, against=whole, over_time=False).ticks,
                evaluate_result(tiled, against=tiled, over_time=False).ticks)  # fmt: skip


@long
def test_differences_between_results_in_tiles_of_two_sizes(results: tuple[Path, Path], tmp_path: Path) -> None:
    config = load_team_file(TRIO_TEAM).with_parameters({"state_every": 4.0, "duration": 8.0, "rule": "gradient"})
    replay_team(config, tmp_path / "whole.mcap")
    replay_tiles(config, tmp_path / "tiled.mcap", 2 * EDGE, result_per_tile=True)
    expected = compare_results(results[0], tmp_path / "whole.mcap")
    assert not expected.is_same
    assert compare_results(results[1], tmp_path / "tiled.mcap").maps == expected.maps


@long
@pytest.mark.parametrize("color", COLORS)
def test_ply_files_have_the_leaves_of_the_whole_run(results: tuple[Path, Path], tmp_path: Path, color: str) -> None:
    found = []
    for path in results:
        export_map(path, tmp_path / "map.ply", color=color, free=True, bounds=BOUNDS)
        header, _, rows = (tmp_path / "map.ply").read_bytes().partition(b"end_header\n")
        found.append((header, sorted(np.frombuffer(rows, "V24").tolist())))
    assert found[0] == found[1]


@long
@pytest.mark.parametrize("name", ["map.npz", "map.ot", "map.yaml"])
@pytest.mark.parametrize("options", [{}, {"max_depth": 17}])
def test_other_files_are_those_of_the_whole_run(results, tmp_path: Path, name: str, options) -> None:
    contents = []
    for path in results:
        files = export_map(path, tmp_path / name, heights=(0.2, 2.0), **options)
        contents.append({file.name: file.read_bytes() for file in files})
    assert contents[0] == contents[1]


def page_parts(path: Path, page: Path, **options) -> tuple[dict, list[str], list[str]]:
    """Header of a page with the bytes of its arrays but those of sent bytes, its pictures, and its last line."""
    write_page(path, page, **options)
    found = Page(page)

    def arrays(value):
        if isinstance(value, dict) and value.keys() == {"type", "offset", "count"}:
            return found.array(value).tobytes()
        if isinstance(value, dict) and value.get("id") in ("sent_bytes", "link_bytes"):
            return value["id"]
        if isinstance(value, dict):
            return {name: arrays(part) for name, part in value.items()}
        return [arrays(part) for part in value] if isinstance(value, list) else value

    pictures = re.findall(r'<img alt="Maps[^>]*>', found.text)
    assert pictures
    return arrays(found.header), pictures, re.findall(r"The finest cells[^<]*", found.text)


@long
@pytest.mark.parametrize("options", [{}, {"max_depth": 16}, {"max_depth": 12}, {"max_bytes": 400_000}])
def test_pages_have_the_data_of_the_whole_run(results: tuple[Path, Path], tmp_path: Path, options) -> None:
    whole, tiled = (page_parts(path, tmp_path / f"{path.stem}.html", **options) for path in results)
    assert whole == tiled
    header = whole[0]
    kinds = [layer["kind"] for layer in header["layers"]]
    assert kinds == ["team", *["map"] * 3, *["evidence"] * 3, "central"]
    assert header["hasFirst"]
    contradictions = np.frombuffer(header["pools"]["team"]["contradiction"], np.uint8)
    assert len(np.unique(contradictions)) > (1 if options else 3)


@long
def test_a_page_reads_the_maps_of_one_tile_at_a_time(results, tmp_path: Path, monkeypatch) -> None:
    largest = []

    def counted(result, **options):
        for maps in history(result, **options):
            largest.append(max(stored.octree.num_cells for stored in maps.values()))
            yield maps

    history = Result.history
    with monkeypatch.context() as patch:
        patch.setattr(Result, "history", counted)
        write_page(results[1], tmp_path / "page.html")
    with open_result(results[1]) as tiled:
        cells = [tiled.map(CENTRAL, bounds=box).octree.num_cells for box in tiled.boxes()]
    assert max(largest) == max(cells) < sum(cells) / 2


@long
@pytest.mark.parametrize("options", [*({"color": color} for color in COLORS), {"color": "height", "max_depth": 17}])
def test_pictures_of_maps_are_those_of_the_whole_run(results: tuple[Path, Path], tmp_path: Path, options) -> None:
    drawn = []
    for path in results:
        with open_result(path) as result:
            result.plot("map", label="map", **options).savefig(tmp_path / "map.png", metadata={"Software": None})
        drawn.append((tmp_path / "map.png").read_bytes())
    assert drawn[0] == drawn[1]


def last_boxes(path: Path, recording: Path, tick: int) -> list[tuple[str, bytes]]:
    """Robot, and centre and size, of the boxes that a recording adds at a tick."""
    from rerun.chunk import RrdReader

    write_rerun(path, recording)
    found = []
    for chunk in RrdReader(recording).stream().to_chunks():
        for row in chunk.to_record_batch().to_pylist():
            if row.get("tick") == tick and row.get("Boxes3D:centers"):
                rows = np.column_stack([row["Boxes3D:centers"], row["Boxes3D:half_sizes"]])
                found += [(str(chunk.entity_path).split("/")[2], boxes.tobytes()) for boxes in rows]
    return sorted(found)


@long
def test_recordings_of_rerun_have_the_leaves_of_the_whole_run(results: tuple[Path, Path], tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    with open_result(results[0]) as result:
        tick = result.stored_ticks(CENTRAL)[-1]
        num_leaves = sum(
            int((best_labels(result.map(name).leaves().log_odds) > 0).sum()) for name in (*result.robots, CENTRAL)
        )
    whole, tiled = (last_boxes(path, tmp_path / f"{path.stem}.rrd", tick) for path in results)
    assert whole == tiled
    assert len(whole) == num_leaves


@long
def test_queries_are_those_of_the_whole_run(results: tuple[Path, Path]) -> None:
    inside = np.random.default_rng(0).uniform((-12, -12, -0.5), (15, 12, 3), (200, 3))
    points = [*inside.tolist(), [1e6, 0.0, 0.0]]
    answers = []
    for path in results:
        with open_result(path) as result:
            found = answer_query(result, "husky_2", points=points, box=BOUNDS)
            assert found.points is not None
            assert found.points.known.any()
            assert not found.points.known[-1]
            answers.append(found)
    for name, values in vars(answers[0].points).items():
        np.testing.assert_array_equal(values, getattr(answers[1].points, name))
    rows = [sorted(np.column_stack([a.box.centers, a.box.sizes, a.box.log_odds]).tolist()) for a in answers]
    assert rows[0] == rows[1]


@long
def test_files_are_the_same_for_any_number_of_jobs_and_replace_earlier_ones(results, tmp_path: Path) -> None:
    config = load_team_file(TRIO_TEAM).with_parameters({"state_every": 4.0, "evidence_every": 4.0, "duration": 8.0})
    output, before = tmp_path / "tiled.mcap", tmp_path / "tiled.maps" / "tile_9_9-0123456789abcdef.mcap"
    before.parent.mkdir()
    before.write_bytes(b"of an earlier result")
    (before.parent / "notes.txt").write_text("not a tile")
    replay_tiles(config, output, EDGE, result_per_tile=True)
    names = {path.name for path in maps_folder(output).iterdir()}
    assert names == {path.name for path in maps_folder(results[1]).iterdir()} | {"notes.txt"}


@long
def test_a_moved_result_is_read_and_lost_or_damaged_files_are_named(moved: Path) -> None:
    with open_result(moved) as result:
        assert result.map(CENTRAL).octree.num_cells
    first, second = sorted(maps_folder(moved).iterdir())[:2]
    content = first.read_bytes()
    first.unlink()
    with open_result(moved) as result, pytest.raises(InputError, match=rf"{first.name}: is missing, .* run the logs"):
        result.map(CENTRAL)
    shutil.copy(second, first)
    with open_result(moved) as result, pytest.raises(InputError, match=rf"{first.name}: is damaged, or not the file"):
        result.map(CENTRAL)
    first.write_bytes(content[:-200])
    done = octoreplay("query", moved, "--box", -90, -90, -90, 90, 90, 90)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert f"{first.name}: is damaged" in done.stderr


@long
def test_an_interrupted_run_keeps_the_earlier_result_and_a_finished_one_replaces_its_files(
    moved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = load_team_file(TRIO_TEAM).with_parameters({"duration": 4.0})
    earlier = {path.name for path in maps_folder(moved).iterdir()}

    def fail(*_, **__):
        raise OutputError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(tiled_run, "write_result", fail)
        with pytest.raises(OutputError, match="disk is full"):
            replay_tiles(config, moved, EDGE, result_per_tile=True)
    assert earlier < {path.name for path in maps_folder(moved).iterdir()}
    with open_result(moved) as result:
        assert result.summary.log_seconds > 4.0
        assert result.map(CENTRAL).octree.num_cells
    replay_tiles(config, moved, EDGE, result_per_tile=True, resume=True)
    with open_result(moved) as result:
        assert result.tiles is not None
        listed = {Path(file.file).name for file in result.tiles.files}
        assert {path.name for path in maps_folder(moved).iterdir()} == listed
    replay_team(config, moved)
    assert not maps_folder(moved).exists()


SHORT_RUN = ("--tiles", EDGE, "--result-per-tile", "--duration", 4, "--quiet")


@pytest.fixture(scope="module")
def short_result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Result of SHORT_RUN, in a folder beside those of the tests."""
    output = tmp_path_factory.mktemp("short") / "tiled.mcap"
    assert octoreplay("run", TRIO_TEAM, "-o", output, *SHORT_RUN).returncode == 0
    return output


KILLED_AT = """
import os, pkgutil, signal, sys
from unittest import mock
from octoreplay import cli

process, name = os.getpid(), sys.argv.pop(1)
function = pkgutil.resolve_name(name)

def killed(*arguments, **options):
    if os.getpid() == process:
        os.kill(process, signal.SIGKILL)
    return function(*arguments, **options)

with mock.patch(name, killed):
    cli.main()
"""
"""Program of the command line whose process, not those of its workers, is killed where it calls a function."""


@long
@pytest.mark.parametrize(
    "name",
    [
        "octoreplay.io.results.result_writer.ResultWriter.write_tiles",
        "octoreplay.io.results.result_writer.ResultWriter.write_metrics",
        "octoreplay.io.results.result_writer.publish",
    ],
)
def test_a_run_that_is_killed_before_its_index_is_in_place_keeps_the_earlier_result(
    moved: Path, short_result: Path, name: str
) -> None:
    earlier = {path: path.read_bytes() for path in (moved, *maps_folder(moved).iterdir())}
    words = [str(word) for word in ("run", TRIO_TEAM, "-o", moved, *SHORT_RUN)]
    done = subprocess.run([sys.executable, "-c", KILLED_AT, name, *words, "--force"], check=False, timeout=300)
    assert done.returncode == -signal.SIGKILL
    assert {path: path.read_bytes() for path in earlier} == earlier
    new = {path.name for path in maps_folder(short_result).iterdir()}
    assert new < {path.name for path in maps_folder(moved).iterdir()}
    assert octoreplay("check", moved, "--min-agreement", 0).returncode == 0
    with open_result(moved) as result:
        *_, last = result.history()
        assert last[CENTRAL].octree.num_cells

    assert octoreplay(*words, "--resume", "--force").returncode == 0
    assert moved.read_bytes() == short_result.read_bytes()
    assert {path.name: path.read_bytes() for path in maps_folder(moved).iterdir()} == {
        path.name: path.read_bytes() for path in maps_folder(short_result).iterdir()
    }
    assert {path.name for path in moved.parent.iterdir() if path.name[0] != "."} == {"tiled.mcap", "tiled.maps"}


@long
def test_an_unfinished_index_is_recovered_beside_its_files_only(moved: Path) -> None:
    partial = moved.with_name("tiled.partial.mcap")
    data = moved.read_bytes()
    partial.write_bytes(data[: data.rindex(b"summary") - 20])
    elsewhere = moved.parent / "elsewhere"
    elsewhere.mkdir()
    assert_fails(
        2, r"other\.mcap: .*tiled\.maps.*; name an output in", "recover", partial, "-o", elsewhere / "other.mcap"
    )
    assert not list(elsewhere.iterdir())
    link = moved.parent / "link"
    link.symlink_to(moved.parent)
    assert octoreplay("recover", partial, "-o", link / "other.mcap").returncode == 0
    with open_result(moved) as whole, open_result(moved.with_name("other.mcap")) as result:
        assert leaves(result.map(CENTRAL)) == leaves(whole.map(CENTRAL))


@long
def test_an_unfinished_index_ends_the_maps_at_its_last_tick(moved: Path) -> None:
    with open_result(moved) as whole:
        early, late = (whole.stored_ticks(CENTRAL)[place] for place in (1, -1))
        end_ns = whole.map(CENTRAL, tick=late).stamp_ns - 1
        expected = leaves(whole.map(CENTRAL, at_ns=end_ns))
        evidence = [tick for tick in whole.evidence_ticks("husky_1") if tick < late]
    partial = moved.with_name("tiled.partial.mcap")
    with ResultReader(moved) as reader, RosMcapWriter(partial) as writer:
        for name, values in reader._metadata.items():
            if name != "summary":
                writer.write_metadata(name, values)
        for schema, channel, record in reader._reader.iter_messages(log_time_order=False):
            if record.log_time <= end_ns:
                writer.copy(schema, channel, record)
        writer.write_metadata("summary", {"complete": "false", "stop_reason": "killed"})
    with open_result(partial) as result:
        last = result.stored_ticks(CENTRAL)[-1]
        assert early <= last <= result.metrics[-1].tick < late
        assert leaves(result.map(CENTRAL)) == leaves(result.map(CENTRAL, at_ns=2 * end_ns)) == expected
        assert [max(stored.tick for stored in maps.values()) for maps in result.history()][-1] == last
        assert result.evidence_ticks("husky_1") == evidence
        with pytest.raises(InputError, match=f"no map of robot 'central' is stored at tick {late}; stored nearby: "):
            result.map(CENTRAL, tick=late)
    for words in (
        ["evaluate", partial],
        ["report", partial, "-o", moved.with_name("a.html")],
        ["compare", partial, moved],
    ):
        done = octoreplay(*words)
        assert "the run did not finish" in done.stderr
        assert "error" not in done.stderr


@long
def test_the_command_writes_and_reads_a_result_per_tile(tmp_path: Path) -> None:
    output = tmp_path / "out.mcap"
    done = octoreplay("run", TRIO_TEAM, "-o", output, "--tiles", EDGE, "--result-per-tile", "--duration", 4, "-q")
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir() if not path.name.startswith(".")) == ["out.maps", "out.mcap"]
    done = octoreplay("query", output, "--point", 3, -2, 0.4, "--json")
    assert json.loads(done.stdout)["points"][0]["known"]
    assert octoreplay("report", output, "-o", tmp_path / "page.html").returncode == 0
    done = octoreplay("run", TRIO_TEAM, "-o", output, "--result-per-tile", "--force")
    assert (done.returncode, "--result-per-tile need --tiles" in done.stderr) == (2, True)
