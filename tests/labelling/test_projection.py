"""Projection of measured points into a colour image, and points that another surface hides."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from octoreplay.io.messages.sensor_messages import Calibration
from octoreplay.labelling.projection import ImageProjection, depth_points
from octoreplay.records import CameraModel

K = np.array([[130.0, 0.0, 79.5], [0.0, 130.0, 59.5], [0.0, 0.0, 1.0]])


def calibration(model: str = "plumb_bob", D: tuple[float, ...] = (), factor: float = 1.0) -> Calibration:
    """Calibration of a camera of 160x120 pixels, or a multiple."""
    matrix = K.copy()
    matrix[:2] *= factor
    matrix[:2, 2] += (factor - 1) / 2
    size = round(160 * factor), round(120 * factor)
    return Calibration(0, "camera", *size, model, np.array(D), matrix, np.zeros((3, 4)))


@pytest.mark.parametrize(
    ("model", "D"),
    [("plumb_bob", ()), ("plumb_bob", (-0.25, 0.08, 0.001, -0.001, 0.0)), ("equidistant", (0.05, -0.01, 0.002, 0.0))],
)
def test_points_on_the_rays_of_pixels_have_these_pixels(model: str, D: tuple[float, ...]) -> None:
    projection = ImageProjection(calibration(model, D), "camera", is_rectified=False)
    rng = np.random.default_rng(1)
    pixels = rng.integers([10, 10], [150, 110], (500, 2))
    if not D:
        slopes = (pixels - K[:2, 2]) / 130.0
    else:
        undistort = cv2.fisheye.undistortPoints if model == "equidistant" else cv2.undistortPoints
        slopes = undistort(pixels.astype(float)[:, None], K, np.array(D))[:, 0]
    z = rng.uniform(0.5, 20.0, (500, 1))
    found, is_inside = projection.pixels(np.hstack([slopes * z, z]))
    assert is_inside.all()
    assert np.array_equal(found, pixels)


def test_points_behind_the_camera_or_outside_the_image_have_no_pixel() -> None:
    projection = ImageProjection(calibration(), "camera", is_rectified=False)
    points = np.array([[0, 0, -2.0], [9.0, 0, 2.0], [0, 0, 0], [np.nan, 0, 1], [0, 0, 2.0]])
    assert projection.pixels(points)[1].tolist() == [False, False, False, False, True]


def test_points_beyond_the_range_of_a_lens_model_have_no_pixel() -> None:
    # Of this polynomial the image radius falls again from a slope of 1.15 on, so that far rays fold back.
    projection = ImageProjection(calibration(D=(-0.25, 0.0, 0.0, 0.0, 0.0)), "camera", is_rectified=False)
    slopes = np.array([0.1, 0.4, 1.9, 1.99])
    assert projection.pixels(np.stack([slopes, 0 * slopes, 1 + 0 * slopes], axis=1))[1].tolist() == [
        True,
        True,
        False,
        False,
    ]


def scene(offset: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a depth camera that sees a box before a wall, whether each is on the box, and whether it is hidden.

    Hidden are points that the colour camera, ``offset`` to the right, does not see.
    """
    camera = CameraModel(160, 120, 130.0, 130.0, 79.5, 59.5)
    u, v = np.meshgrid((np.arange(160) - 79.5) / 130.0, (np.arange(120) - 59.5) / 130.0)
    is_box = (np.abs(2.0 * u) < 0.4) & (np.abs(2.0 * v) < 0.5)
    points = depth_points(np.where(is_box, 2.0, 5.0), camera)
    # Where the line from the colour camera to a point of the wall crosses the plane of the box.
    crossing = np.array([offset, 0.0]) + (points[:, :2] - [offset, 0.0]) * 2.0 / 5.0
    is_hidden = ~is_box.ravel() & (np.abs(crossing[:, 0]) < 0.4) & (np.abs(crossing[:, 1]) < 0.5)
    return points, is_box.ravel(), is_hidden


@pytest.mark.parametrize("offset", [0.3, -0.3, 0.1])
@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_points_that_a_box_hides_from_the_second_camera_are_found(offset: float, factor: float) -> None:
    points, is_box, is_hidden = scene(offset)
    assert is_hidden.sum() > 200
    T_colour_depth = np.eye(4)
    T_colour_depth[0, 3] = -offset
    projection = ImageProjection(calibration(factor=factor), "camera", is_rectified=False)
    _, is_seen = projection.visible_pixels(points, T_colour_depth, factor)
    in_view = projection.pixels(points + T_colour_depth[:3, 3])[1]
    assert is_seen[is_box & in_view].all()
    # Points within about two pixels of the box's outline may be taken for either.
    assert is_seen[is_hidden & in_view].mean() < 0.05
    assert (~is_seen)[~is_hidden & ~is_box & in_view].mean() < 0.02


def test_grazing_ground_hides_nothing() -> None:
    camera = CameraModel(160, 120, 130.0, 130.0, 79.5, 59.5)
    rows = (np.arange(120) - 59.5) / 130.0
    depth = np.where(rows > 0.02, 0.9 / np.maximum(rows, 0.02), 0.0)[:, None] * np.ones(160)
    points = depth_points(depth, camera)
    T_colour_depth = np.eye(4)
    T_colour_depth[:3, 3] = -0.3, 0.05, 0.0
    projection = ImageProjection(calibration(), "camera", is_rectified=False)
    in_view = projection.pixels(points + T_colour_depth[:3, 3])[1]
    assert in_view.sum() > 5000
    assert projection.visible_pixels(points, T_colour_depth, 1.0)[1][in_view].mean() > 0.99
