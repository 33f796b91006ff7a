"""Work files of scans: their cells come back, each in one tile."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.errors import InputError
from octoreplay.io.containers.fingerprint import fingerprint
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.sensor_logs import SensorCounts
from octoreplay.mapping.octree import brick_keys
from octoreplay.mapping.sensor import ScanCaster
from octoreplay.records import CloudFrame, FrameCounts
from octoreplay.replay.sources import TeamSources
from octoreplay.study.tiles.casting import cast_groups, cast_scans, team_start_ns
from octoreplay.study.tiles.geometry import tiles_of
from octoreplay.study.tiles.scans import SAMPLE, ScanFile, ScanFiles, ScanWriter, load_index
from octoreplay.study.tiles.worker import Setup
from support.fixture_paths import TRIO_TEAM

COUNTS = SensorCounts((FrameCounts(),), FrameCounts())
CASTER = ScanCaster(SensorConfig(max_range=15.0), MapConfig(0.25), 3)


def cells_of(cells):
    """Marks, and strengths, of touched bricks by code."""
    strengths = cells.strengths if cells.strengths.size else cells.marks
    rows = zip(cells.codes.tolist(), cells.marks.tolist(), strengths.tolist(), strict=True)
    return {code: (marks, of_hits) for code, marks, of_hits in rows}


@given(
    seed=st.integers(0, 99), num_frames=st.integers(0, 4), block_cells=st.sampled_from([32, 64]),
    factor=st.sampled_from([1, 4]), num_axes=st.sampled_from([2, 3]), is_weighted=st.booleans(),
)  # fmt: skip
def test_each_cell_comes_back_in_one_tile(
    tmp_path_factory, seed, num_frames, block_cells, factor, num_axes, is_weighted
):
    random = np.random.default_rng(seed)
    files = ScanFiles(tmp_path_factory.mktemp("scans"), 0)
    written = []
    with ScanWriter(files, block_cells, num_axes) as writer:
        for number in range(num_frames):
            pose = np.eye(4)
            pose[:3, 3] = random.uniform(-9, 9, 3)
            points = random.uniform(-12, 12, (random.integers(0, 40), 3)).astype(np.float32)
            classes = random.integers(0, 4, len(points)).astype(np.uint8)
            confidences = random.integers(1, 256, len(points)).astype(np.uint8) if is_weighted else None
            frame = CloudFrame("r", 10 * number, points, classes, pose, confidences, sensor_index=number % 2)
            cells = CASTER.cast(frame)
            writer.write(frame, cells)
            written.append((frame, cells_of(cells)))
        writer.finish(COUNTS)
    index = load_index(files.index)
    found = [{} for _ in written]
    tiles = tiles_of(index.blocks, factor, block_cells * factor)
    for tile in tiles:
        with ScanFile(files, "r", tile) as scans:
            for (frame, _), cast, into in zip(written, scans.frames(), found, strict=True):
                assert (cast.robot_id, cast.stamp_ns, cast.sensor_index) == ("r", frame.stamp_ns, frame.sensor_index)
                np.testing.assert_array_equal(cast.T_team_sensor, frame.T_team_sensor)
                keys = brick_keys(cast.cells.codes)[:, :num_axes]
                assert (keys // tile.num_cells == [tile.x, tile.y, tile.z][:num_axes]).all()
                assert not into.keys() & cells_of(cast.cells).keys()
                into.update(cells_of(cast.cells))
    if tiles:
        assert found == [cells for _, cells in written]
    else:
        assert not any(cells for _, cells in written)


def test_the_sample_is_alike_for_all_robots(tmp_path):
    random = np.random.default_rng(5)
    frame = CloudFrame("r", 0, random.uniform(-12, 12, (400, 3)).astype(np.float32), None, np.eye(4))
    cells = CASTER.cast(frame)
    samples = []
    for index in range(2):
        with ScanWriter(ScanFiles(tmp_path, index), 32, 2) as writer:
            for _ in range(index + 1):
                writer.write(frame, cells)
            writer.finish(COUNTS)
        samples.append(load_index(ScanFiles(tmp_path, index).index).sample)
    np.testing.assert_array_equal(*samples)
    assert set(samples[0].tolist()) <= set(cells.codes.tolist())
    assert cells.codes.size / SAMPLE / 2 < samples[0].size < cells.codes.size / SAMPLE * 2


def test_a_pass_over_the_logs_gives_their_frames_and_counts(tmp_path):
    config = resolve(load_team_file(TRIO_TEAM))
    setup = Setup(config, tmp_path, 2)
    assert cast_groups(config, tmp_path, 2) == [(0, 1), (2,)]
    assert cast_scans(setup, (0, 2), team_start_ns(config), 64, 2, {}) == 2
    assert cast_groups(config, tmp_path, 2) == [(1,)]
    cast_scans(setup, (1,), team_start_ns(config), 64, 2, {})
    assert cast_groups(config, tmp_path, 2) == []
    with TeamSources(config) as team:
        for index, (source, robot) in enumerate(zip(team.sources, config.robots, strict=True)):
            frames, scans = list(source.frames()), load_index(ScanFiles(tmp_path, index).index)
            assert scans.stamps.tolist() == [frame.stamp_ns for frame in frames]
            np.testing.assert_array_equal(scans.poses, [frame.T_team_sensor for frame in frames])
            assert scans.counts.total({}) == team.counts[robot.robot_id]


def test_damaged_files_are_refused(tmp_path):
    files = ScanFiles(tmp_path, 0)
    frame = CloudFrame("r", 0, np.ones((3, 3), np.float32), None, np.eye(4))
    with ScanWriter(files, 32, 2) as writer:
        writer.write(frame, CASTER.cast(frame))
        writer.finish(COUNTS)
    index = load_index(files.index)
    tile = tiles_of(index.blocks, 1, 32)[0]
    files.cells.write_bytes(files.cells.read_bytes()[:-20])
    with (
        ScanFile(files, "r", tile) as scans,
        pytest.raises(InputError, match=r"robot_0\.cells: cannot be read: .*--restart"),
    ):
        list(scans.frames())
    files.cells.unlink()
    with pytest.raises(InputError, match=r"robot_0\.cells: cannot be read"), ScanFile(files, "r", tile):
        pass
    files.index.write_bytes(b"other")
    with pytest.raises(InputError, match=r"robot_0\.index: cannot be read: .*--restart"):
        load_index(files.index)


def test_a_log_that_differs_from_that_of_the_run_is_refused(tmp_path):
    config = resolve(load_team_file(TRIO_TEAM))
    paths = [robot.logs[0] for robot in config.robots]
    inputs = {str(path.resolve()): fingerprint(path, whole=path == paths[0]) for path in paths}
    inputs[str(paths[1].resolve())] = dataclasses.replace(inputs[str(paths[1].resolve())], value="0")
    arguments = (team_start_ns(config), 64, 2, inputs)
    assert cast_scans(Setup(config, tmp_path, 2), (0, 2), *arguments) == 2
    with pytest.raises(InputError, match=r"husky_2.mcap: a worker found another version of it than the run began with"):
        cast_scans(Setup(config, tmp_path, 2), (0, 1), *arguments)
