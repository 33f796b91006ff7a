"""First pass over the logs of a run in tiles."""

from __future__ import annotations

import numpy as np
import pytest

from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.io.robots.discover import resolve
from octoreplay.mapping.octree import codes_to_keys
from octoreplay.mapping.sensor import ScanCaster
from octoreplay.records import CameraModel, CloudFrame, DepthFrame
from octoreplay.replay.sources import TeamSources
from octoreplay.study.tiles.geometry import tiles_of
from octoreplay.study.tiles.survey import Survey, load_frames, ray_box, touching
from support.fixture_paths import TRIO_TEAM

RESOLUTION = 0.25


def pose(x, y, z, turn):
    cos, sin = np.cos(turn), np.sin(turn)
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


def frames(random):
    """Frames with measured points, points out of range, and rays without an end."""
    T = pose(*random.uniform(-5, 5, 3), random.uniform(0, 6))
    points = random.uniform(-15, 15, (20, 3)).astype(np.float32)
    yield CloudFrame("r", 0, points, None, T)
    points[3] = np.nan
    points[4] = (np.inf, 0.0, 0.0)
    yield CloudFrame("r", 0, points, None, T)
    depth = random.uniform(0.2, 14.0, (6, 8)).astype(np.float32)
    depth[0, 0] = 0.0
    camera = CameraModel(8, 6, 5.0, 5.0, 4.0, 3.0)
    yield DepthFrame("r", 0, depth, 1.0, None, camera, T)
    depth[1, 1] = np.inf
    yield DepthFrame("r", 0, depth, 1.0, None, camera, T)
    yield DepthFrame("r", 0, depth, 1.0, None, camera, T, max_range=3.0)
    slopes = random.uniform(-1, 1, (2, 6, 8)).astype(np.float32)
    yield DepthFrame("r", 0, depth, 1.0, None, CameraModel(8, 6, 5.0, 5.0, 4.0, 3.0, slopes), T)


@pytest.mark.parametrize("rays", ["cells", "all"])
@pytest.mark.parametrize("seed", range(4))
def test_boxes_hold_all_cells_of_a_scan(seed, rays):
    random = np.random.default_rng(seed)
    sensor = SensorConfig(max_range=8.0, rays=rays, no_return_depth=() if seed % 2 else (0.0,))
    caster = ScanCaster(sensor, MapConfig(RESOLUTION), 1)
    for frame in frames(random):
        touched = caster.cast(frame)
        keys = codes_to_keys(touched.codes * 64)
        # A brick has four cells along each axis.
        low, high = keys.min(axis=0) * RESOLUTION, (keys.max(axis=0) + 4) * RESOLUTION
        box = ray_box(frame, sensor)
        margin = 2 * RESOLUTION + 4 * RESOLUTION
        assert (low >= box[:3] - margin).all()
        assert (high <= box[3:] + margin).all()


def test_frames_elsewhere_are_given_without_points(tmp_path):
    config = resolve(load_team_file(TRIO_TEAM))
    survey = Survey(config)
    survey.save(tmp_path)
    bounds = tiles_of(survey.boxes, 32, config)[0].bounds(config.map)
    elsewhere = [
        robot.elsewhere(bounds, len(of.views)) for robot, of in zip(load_frames(tmp_path), config.robots, strict=True)
    ]
    num_skipped = 0
    with TeamSources(config, elsewhere) as team:
        for source, robot in zip(team.sources, survey.robots, strict=True):
            found = list(source.frames())
            assert [frame.stamp_ns for frame in found] == robot.stamps.tolist()
            is_near = touching(robot.boxes, bounds)
            for frame, T_team_sensor, near in zip(found, robot.poses, is_near, strict=True):
                np.testing.assert_array_equal(frame.T_team_sensor, T_team_sensor)
                assert near or len(frame.points) == 0
                num_skipped += not near
        assert team.counts == survey.counts()
    assert num_skipped > 0
