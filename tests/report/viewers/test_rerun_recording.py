"""Recordings of Rerun, verified by its own program and read back by its own reader."""

from __future__ import annotations

import dataclasses
import logging
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octoreplay.errors import ConfigError, InputError
from octoreplay.io.results.result_writer import ResultWriter, partial_path
from octoreplay.log_odds import best_labels
from octoreplay.report.viewers import rerun_recording
from octoreplay.report.viewers.rerun_recording import write_rerun
from octoreplay.result import open_result
from octoreplay.run_metrics import FramePlace
from support import leaf_list
from support.fixture_paths import FIXTURES
from support.long_suite import long
from support.result_factory import (
    SECOND,
    START,
    leaf_table,
    pose,
    state,
    summary,
    team,
    tick_metrics,
    write_killed,
    write_result,
    write_until,
)

RESULT = FIXTURES / "result_3.mcap"
MOST = 7
"""Largest number of boxes of an entity in most tests."""


def test_a_run_without_a_tick_is_repeated_not_stored_more_often(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    killed = write_killed(tmp_path / "r.mcap", [])
    with pytest.raises(InputError, match=r"before its first tick; repeat it$"):
        write_rerun(killed, tmp_path / "out.rrd")


class Recording:
    """Columns of a recording by entity, read by Rerun's reader: rows of (tick, values of all components)."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        reader = RrdReader(path)
        self.stores = [(entry.kind, entry.application_id, entry.recording_id) for entry in reader.recordings()]
        self.num_blueprints = len(reader.blueprints())
        self.rows: dict[str, list[dict[str, Any]]] = {}
        for chunk in reader.stream().to_chunks():
            self.rows.setdefault(str(chunk.entity_path), []).extend(chunk.to_record_batch().to_pylist())

    def at(self, entity: str, component: str) -> dict[int | None, Any]:
        """Values of a component by tick (None: static)."""
        rows = self.rows.get(entity, ())
        return {row.get("tick"): row[component] for row in rows if row.get(component) is not None}

    def boxes(self, entity: str, ticks: Iterable[int], most: int = 50_000) -> dict[int, np.ndarray]:
        """Boxes (L, 5) that are visible at some ticks, of all parts of a map: centre, edge and class_id."""
        found: dict[int, list[np.ndarray]] = {tick: [] for tick in ticks}
        cleared = {name: self.at(name, "Clear:is_recursive") for name in self.rows}
        for part in (name for name in self.rows if name.startswith(f"{entity}/")):
            events: dict[int, Any] = {
                tick: None for name, clears in cleared.items() if part == name or part.startswith(f"{name}/")
                for tick in clears
            }  # fmt: skip
            halves, classes = self.at(part, "Boxes3D:half_sizes"), self.at(part, "Boxes3D:class_ids")
            for tick, centers in self.at(part, "Boxes3D:centers").items():
                assert 0 < len(centers) <= most
                sizes = np.array(halves[tick]) * 2
                assert (sizes == sizes[:, :1]).all()
                events[tick] = np.column_stack([centers, sizes[:, 0], np.full(len(centers), classes[tick][0])])
            for tick, boxes in found.items():
                latest = events.get(max((before for before in events if before <= tick), default=-1))
                boxes += [] if latest is None else [latest]
        return {tick: np.concatenate([np.zeros((0, 5)), *parts]) for tick, parts in found.items()}


def rerun_says(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run Rerun's program, with its settings in a folder of the test."""
    environment = {**os.environ, "HOME": str(folder), "XDG_CONFIG_HOME": str(folder), "XDG_DATA_HOME": str(folder)}
    command = [Path(sys.executable).with_name("rerun"), *map(str, arguments)]
    return subprocess.run(command, env=environment, text=True, capture_output=True, check=False)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rerun") / "out.rrd"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rerun_recording, "MOST_BOXES", MOST)
        num_maps_and_ticks = write_rerun(str(RESULT), path)
    assert num_maps_and_ticks == (18, 11)
    return path


@long
def test_rerun_verifies_the_recording(path: Path, tmp_path: Path) -> None:
    done = rerun_says(tmp_path, "rrd", "verify", path)
    assert done.returncode == 0, done.stderr
    stats = rerun_says(tmp_path, "rrd", "stats", path)
    assert stats.returncode == 0, stats.stderr
    assert "/team/husky_1/map" in stats.stdout
    # A damaged file does not pass.
    damaged = tmp_path / "damaged.rrd"
    damaged.write_bytes(path.read_bytes()[:-4000])
    assert rerun_says(tmp_path, "rrd", "verify", damaged).returncode != 0


@long
def test_the_recording_holds_the_metrics_of_every_tick(path: Path) -> None:
    recording = Recording(path)
    assert recording.stores == [("recording", "octoreplay", "out")]
    assert recording.num_blueprints == 1
    with open_result(RESULT) as result:
        metrics = result.metrics
        for name in ("total_distance", "label_disagreement", "contradiction"):
            found = recording.at(f"/metrics/team/{name}", "Scalars:scalars")
            np.testing.assert_array_equal(
                [found[tick.tick][0] for tick in metrics], [getattr(tick, name) for tick in metrics]
            )
        for index, robot_id in enumerate(result.robots):
            found = recording.at(f"/metrics/robots/{robot_id}/sent_bytes", "Scalars:scalars")
            assert [found[tick.tick][0] for tick in metrics] == [tick.robots[index].sent_bytes for tick in metrics]
        row = recording.rows["/metrics/team/total_distance"][3]
        assert row["stamp"].value == metrics[row["tick"]].stamp_ns
        assert row["elapsed"].value == round(result.seconds(row["stamp"].value) * 1e9)
    links = [entity for entity in recording.rows if entity.startswith("/metrics/links/")]
    assert len(links) == 2


@long
def test_the_recording_holds_the_leaves_of_every_stored_map(path: Path) -> None:
    recording = Recording(path)
    with open_result(RESULT) as result:
        for robot_id in (*result.robots, "central"):
            stored = result.stored_ticks(robot_id)
            for tick, found in recording.boxes(f"/team/{robot_id}/map", stored, MOST).items():
                leaves = result.map(robot_id, tick=tick).leaves()
                label = best_labels(leaves.log_odds)
                rows = np.column_stack([leaves.centers, leaves.sizes, label])[label > 0].astype(np.float32)
                np.testing.assert_allclose(found[np.lexsort(found.T)], rows[np.lexsort(rows.T)], rtol=1e-6)
        (context,) = recording.at("/", "AnnotationContext:context")[None]
        names = [entry["class_description"]["info"]["label"] for entry in context]
        assert names == list(result.class_table.names)


@long
def test_the_recording_holds_poses_paths_and_links(path: Path) -> None:
    recording = Recording(path)
    with open_result(RESULT) as result:
        poses = result.as_table("poses")
        for robot_id in result.robots:
            rows = np.flatnonzero(poses["robot_id"] == robot_id)
            found = recording.at(f"/team/{robot_id}/pose", "Transform3D:translation")
            assert list(found) == poses["tick"][rows].tolist()
            expected = np.column_stack([poses[axis][rows] for axis in "xyz"])
            np.testing.assert_allclose([found[tick][0] for tick in found], expected, rtol=1e-6)
            strips = recording.at(f"/team/{robot_id}/path", "LineStrips3D:strips")
            assert list(strips) == poses["tick"][rows][1:].tolist()
            np.testing.assert_allclose([strips[tick][0] for tick in strips],
                                       np.stack([expected[:-1], expected[1:]], axis=1), rtol=1e-6)  # fmt: skip
        linked = [tick.tick for tick in result.metrics if tick.links]
    assert list(recording.at("/team/links", "LineStrips3D:strips")) == linked


@long
def test_robots_and_the_least_time_between_maps_are_chosen(tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    assert write_rerun(RESULT, out, robots=("husky_2",), every=100.0).num_maps == 2
    recording = Recording(out)
    with open_result(RESULT) as result:
        stored = result.stored_ticks("husky_2")
    ticks = {tick for part in recording.rows if "/map/" in part for tick in recording.at(part, "Boxes3D:centers")}
    assert stored[-1] in ticks <= {stored[0], stored[-1]}
    assert {part.split("/")[2] for part in recording.rows if "/map/" in part} == {"husky_2"}
    assert "/team/husky_1/pose" in recording.rows


@long
def test_maps_of_a_depth_have_its_cells(tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    write_rerun(RESULT, out, robots=("husky_2",), every=100.0, max_depth=18)
    with open_result(RESULT) as result:
        stored = result.map("husky_2").coarsened(18)
    leaves = stored.leaves()
    labels = best_labels(leaves.log_odds)
    expected = np.column_stack([leaves.centers, leaves.sizes, labels])[labels > 0]
    boxes = Recording(out).boxes("/team/husky_2/map", [stored.tick])[stored.tick]
    assert sorted(map(tuple, boxes.round(3).tolist())) == sorted(map(tuple, expected.round(3).tolist()))


@long
def test_robots_that_find_each_other_change_their_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leaf_list.install(monkeypatch)
    metrics, own = [], ("team", "beta/map")
    path = tmp_path / "result.mcap"
    identity = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    with ResultWriter(path, team(tmp_path)) as writer:
        for tick in range(1, 4):
            frames = own if tick < 3 else ("team", "team")
            places = tuple(
                FramePlace(name, frame, identity) for name, frame in zip(("alpha", "beta"), frames, strict=True)
            )
            metrics.append(dataclasses.replace(tick_metrics(tick, links=tick == 3), places=places))
            writer.write_metrics(metrics[-1])
            poses = [pose("alpha", 1.0 * tick), dataclasses.replace(pose("beta", 2.0 * tick), frame_id=frames[1])]
            writer.write_poses(START + tick * SECOND, poses)
            for name, frame in zip(("alpha", "beta"), frames, strict=True):
                first = state(name, tick - 1, tick, leaf_list.encode(leaf_table()), key=True)
                writer.write_state(dataclasses.replace(first, frame_id=frame))
        writer.complete(summary(metrics))
    out = tmp_path / "out.rrd"
    assert write_rerun(path, out) == (6, 3)
    recording = Recording(out)
    robots = ("beta\\/map/beta", "team/beta", "team/alpha")
    shown = {robot: recording.boxes(f"/{robot}/map", (1, 2, 3)) for robot in robots}
    assert {robot: [len(boxes) for boxes in maps.values()] for robot, maps in shown.items()} == {
        "beta\\/map/beta": [3, 3, 0], "team/beta": [0, 0, 3], "team/alpha": [3, 3, 3]
    }  # fmt: skip
    assert list(recording.at("/team/links", "LineStrips3D:strips")) == [3]
    cleared = {entity: list(recording.at(entity, "Clear:is_recursive")) for entity in recording.rows}
    assert {entity for entity, ticks in cleared.items() if ticks == [3]} == {"/beta\\/map/beta", "/beta\\/map/beta/map"}
    assert rerun_says(tmp_path, "rrd", "verify", out).returncode == 0


@long
def test_refused_results_leave_no_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.ERROR)
    out = tmp_path / "out" / "out.rrd"
    out.parent.mkdir()
    partial = tmp_path / "result.mcap"
    with pytest.raises(RuntimeError):
        write_until(RuntimeError, partial, [tick_metrics(1)])
    (tmp_path / "empty").mkdir()
    cases: Iterator[tuple[Path, dict[str, Any], str]] = iter((
        (RESULT, {"robots": ("husky_9",)}, "robot 'husky_9' not found; robots: husky_1, husky_2"),
        (partial_path(partial), {}, "holds no map of any robot; run the logs again with a shorter --state-every"),
        (write_killed(tmp_path / "empty" / "r.mcap", []), {}, "interrupted before its first tick; repeat it"),
        (tmp_path / "none.mcap", {}, "cannot be read"),
    ))  # fmt: skip
    for path, options, sentence in cases:
        with pytest.raises(InputError, match=sentence):
            write_rerun(path, out, **options)
    with pytest.raises(ConfigError, match="'all' is not one of posterior, mean"):
        write_rerun(RESULT, out, map_kind="all")
    assert list(out.parent.iterdir()) == []


@long
def test_a_result_without_states_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no map of any robot"):
        write_rerun(write_result(tmp_path), tmp_path / "out.rrd")


def test_without_rerun_the_command_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ConfigError, match=r"rerun-sdk is not installed; use pip install 'octoreplay\[rerun\]'"):
        write_rerun(RESULT, tmp_path / "out.rrd")
    assert list(tmp_path.iterdir()) == []
