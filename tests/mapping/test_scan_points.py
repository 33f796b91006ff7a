"""Points of a scan with their classes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from octoreplay.config.sensor import SensorConfig
from octoreplay.mapping.scan_points import scan_points
from octoreplay.records import BodyBox, CameraModel, CloudFrame, DepthFrame

CAMERA = CameraModel(4, 3, 2.0, 2.0, 1.5, 1.0)


def depth_frame(depth: np.ndarray, unit: float = 1.0, **fields: Any) -> DepthFrame:
    """Depth image with a camera at the origin."""
    values: dict[str, Any] = {"class_image": None, "camera": CAMERA, "T_team_sensor": np.eye(4), **fields}
    return DepthFrame("r", 0, depth, unit, **values)


def test_pixels_become_points_along_their_rays() -> None:
    classes = np.arange(12, dtype=np.uint8).reshape(3, 4)
    frame = depth_frame(np.full((3, 4), 2000, np.uint16), 0.001, class_image=classes)
    points, class_ids = scan_points(frame, SensorConfig(), max_range=10.0, max_points=100)
    np.testing.assert_allclose(points[[0, 11]], [[-1.5, -1.0, 2.0], [1.5, 1.0, 2.0]])
    np.testing.assert_array_equal(class_ids, np.arange(12))


@pytest.mark.parametrize("invalid", [0.0, -1.0, np.nan, np.inf, 7.0, 8.0])
def test_depths_without_information_are_left_out(invalid: float) -> None:
    depth = np.full((3, 4), 2.0, np.float32)
    depth[1, 2] = invalid
    sensor = SensorConfig(invalid_depth=(7.0,), no_return_depth=(8.0,))
    points, class_ids = scan_points(depth_frame(depth), sensor, max_range=10.0, max_points=100)
    assert len(points) == 11
    np.testing.assert_array_equal(class_ids, 1)


def test_the_largest_value_of_an_integer_image_is_no_depth() -> None:
    depth = np.full((3, 4), 65535, np.uint16)
    assert len(scan_points(depth_frame(depth, 0.0001), SensorConfig(), max_range=10.0, max_points=100)[0]) == 0


def test_points_are_limited_by_range_and_number() -> None:
    cloud = np.column_stack([np.linspace(0.0, 10.0, 101), np.zeros((101, 2))]).astype(np.float32)
    frame = CloudFrame("r", 0, cloud, np.full(101, 3, np.uint8), np.eye(4))
    points, class_ids = scan_points(frame, SensorConfig(min_range=1.0), max_range=5.0, max_points=1000)
    assert (points[:, 0].min(), points[:, 0].max(), set(class_ids.tolist())) == (1.0, 5.0, {3})
    assert len(scan_points(frame, SensorConfig(), max_range=20.0, max_points=11)[0]) == 10


def test_points_in_bodies_are_left_out() -> None:
    cloud = np.array([[1.0, 0.0, 0.0], [3.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    T_team_sensor = np.eye(4)
    T_team_sensor[0, 3] = 5.0
    box = BodyBox(np.array([5.5, -1.0, -1.0]), np.array([6.5, 1.0, 1.0]), np.eye(4), is_own=True)
    frame = CloudFrame("r", 0, cloud, None, T_team_sensor, boxes=(box,))
    points, _ = scan_points(frame, SensorConfig(), max_range=20.0, max_points=100)
    np.testing.assert_array_equal(points, [[3.0, 0.0, 0.0]])


def test_rays_of_a_lens_with_distortion_are_used() -> None:
    slopes = np.zeros((2, 3, 4), np.float32)
    slopes[0, 2, 3] = 0.5
    camera = CameraModel(4, 3, 2.0, 2.0, 1.5, 1.0, slopes)
    depth = np.full((3, 4), 2.0, np.float32)
    points, _ = scan_points(depth_frame(depth, camera=camera), SensorConfig(), max_range=10.0, max_points=100)
    np.testing.assert_allclose(points[-1], [1.0, 0.0, 2.0])
