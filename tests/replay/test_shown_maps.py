"""Occupancy grids and OctoMap trees in a result, read by rosbags and OctoMap."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from octoreplay.config.team_file import load_team_file
from octoreplay.errors import ConfigError
from octoreplay.io.results import octomap_trees
from octoreplay.replay.run import replay_team
from octoreplay.report.export import export_map
from octoreplay.result import open_result
from support.fixture_paths import PAIR_TEAM
from support.long_suite import long

SETTINGS = {"resolution": 1.2, "duration": 2.0, "settle": 2, "grid_every": 1.0, "octomap_every": 2.0}
HEIGHTS = {"grid_low": 0.2, "grid_high": 1.5}


def messages(path: Path, name: str) -> dict[str, list[tuple[int, object]]]:
    """Stamps and messages of a topic of both robots, by robot; the types come from the file."""
    found: dict[str, list[tuple[int, object]]] = {"husky_1": [], "husky_2": []}
    with AnyReader([path], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        chosen = [c for c in reader.connections if c.topic.endswith(f"/{name}")]
        # Without connections rosbags reads all of them.
        for connection, stamp, raw in reader.messages(chosen) if chosen else ():
            value = reader.deserialize(raw, connection.msgtype)
            assert value.header.frame_id == "team"
            found[connection.topic.split("/")[1]].append((stamp, value))
    return found


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("shown") / "out.mcap"
    replay_team(load_team_file(PAIR_TEAM).with_parameters({**SETTINGS, **HEIGHTS}), path)
    return path


def test_grids_are_those_of_the_export(result: Path) -> None:
    with open_result(result) as opened:
        last = opened.metrics[-1].stamp_ns
    for robot_id, found in messages(result, "grid").items():
        assert len(found) > 2
        stamp, grid = found[-1]
        assert stamp == last
        image = result.with_name("map.yaml")
        export_map(result, image, robot=robot_id, heights=(HEIGHTS["grid_low"], HEIGHTS["grid_high"]))
        _, size, _, data = image.with_suffix(".pgm").read_bytes().split(b"\n", 3)
        assert size == f"{grid.info.width} {grid.info.height}".encode()
        values = np.frombuffer(data, np.uint8).reshape(grid.info.height, grid.info.width)[::-1].reshape(-1)
        for value, expected in ((254, 0), (205, -1), (0, 100)):
            assert (grid.data[values == value] == expected).all()
        assert (grid.data == 100).any()
        origin = grid.info.origin.position
        assert f"origin: [{origin.x!r}, {origin.y!r}, 0.0]" in image.read_text()
        assert grid.info.resolution == pytest.approx(1.2)


def test_trees_are_those_of_the_export_and_octomap_reads_them(result: Path) -> None:
    pyoctomap = pytest.importorskip("pyoctomap", exc_type=ImportError)
    for robot_id, found in messages(result, "octomap").items():
        _, tree = found[-1]
        assert (tree.binary, tree.id, tree.resolution) == (True, "OcTree", 1.2)
        path = result.with_name("map.bt")
        (count,) = export_map(result, path, robot=robot_id).values()
        header, body = path.read_bytes().split(b"data\n", 1)
        assert tree.data.tobytes() == body
        path.write_bytes(header + b"data\n" + tree.data.tobytes())
        read = pyoctomap.OcTree(0.1)
        assert read.readBinary(str(path))
        assert read.getNumLeafNodes() == count


def test_without_the_options_there_are_none(pair_result: Path) -> None:
    assert messages(pair_result, "grid") == messages(pair_result, "octomap") == {"husky_1": [], "husky_2": []}


@long
def test_a_map_that_a_form_cannot_hold_is_left_out_with_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(octomap_trees, "DEPTH", 3)
    settings = {"resolution": 1.2, "duration": 1.0, "settle": 0, "octomap_every": 1.0, "grid_every": 1.0}
    with caplog.at_level(logging.WARNING):
        replay_team(load_team_file(PAIR_TEAM).with_parameters({**settings, "grid_low": 90.0}), tmp_path / "out.mcap")
    assert "robot 'husky_1': no OctoMap tree is stored: the map reaches further than 4.8 m" in caplog.text
    assert messages(tmp_path / "out.mcap", "octomap")["husky_1"] == []
    # No leaf lies in the heights of the grid.
    assert messages(tmp_path / "out.mcap", "grid")["husky_1"] == []


def test_heights_in_the_wrong_order_are_refused() -> None:
    with pytest.raises(ConfigError, match="grid_low: 2 must be below grid_high, 1"):
        load_team_file(PAIR_TEAM).with_parameters({"grid_low": 2.0, "grid_high": 1.0})
