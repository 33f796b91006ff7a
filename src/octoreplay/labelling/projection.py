"""Labels of measured points from a labelled colour image: projection into the image, and occlusion."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from octoreplay.io.messages.sensor_messages import Calibration
from octoreplay.io.sensors.cameras import FISHEYE_MODELS, camera_model, check_camera, image_size
from octoreplay.records import BoolArray, CameraModel, Float64Array, Int64Array

_LARGEST_CELL = 32
_CELLS_APART, _TIMES_APART = 1.5, 2.0
"""Angle between two points from the sensor above which they are not neighbours on a surface: cells of the image, and
multiples of their angle from the camera."""
_NEARER = 0.98
_LENS_ERROR = 1.5
"""Largest distance of a projected point from the ray of its pixel [pixels]."""


class ImageProjection:
    """Projection of points into the images of one camera, by the formulas of image_geometry and OpenCV.

    Raises InputError for a camera without calibration and for an unknown distortion model; ``where`` begins the error.
    """

    def __init__(self, calibration: Calibration, where: str, *, is_rectified: bool) -> None:
        self._matrix = check_camera(calibration, where, is_rectified=is_rectified)
        self.width, self.height = image_size(calibration)
        self._slopes = camera_model(calibration, where, is_rectified=is_rectified).slopes
        self._lens = calibration.D if self._slopes is not None else np.zeros(0)
        self._is_fisheye = calibration.model in FISHEYE_MODELS

    @property
    def matrix(self) -> Float64Array:
        """Camera matrix (3, 3) [pixels]."""
        return self._matrix

    @property
    def has_lens(self) -> bool:
        """True where the images have lens distortion."""
        return self._slopes is not None

    def pixels(self, points: Float64Array) -> tuple[Int64Array, BoolArray]:
        """Return the pixels (N, 2), column and row, of points (N, 3) in the camera's frame, and a mask (N,).

        The mask is False for points outside the image.
        """
        z = points[:, 2]
        is_ahead = np.isfinite(points).all(axis=1) & (z > 1e-3)
        # A point behind the camera is replaced by one on the optical axis.
        safe = np.where(is_ahead[:, None], points, [0.0, 0.0, 1.0])
        slopes = safe[:, :2] / safe[:, 2:]
        if self._slopes is None:
            image = slopes * self._matrix[[0, 1], [0, 1]] + self._matrix[:2, 2]
        else:
            image = self._distorted(safe)
        with np.errstate(invalid="ignore"):
            is_inside = (
                is_ahead & (image >= -0.5).all(axis=1) & (image < [self.width - 0.5, self.height - 0.5]).all(axis=1)
            )
        found = np.where(is_inside[:, None], np.floor(image + 0.5), 0).astype(np.int64)
        if self._slopes is not None:
            # Outside the range of a lens model, points that the camera does not see have pixels too.
            rays = self._slopes[:, found[:, 1], found[:, 0]].T
            with np.errstate(invalid="ignore"):
                error = np.abs(rays - slopes) * self._matrix[[0, 1], [0, 1]]
                is_inside &= (error <= _LENS_ERROR * (1.0 + (slopes**2).sum(axis=1, keepdims=True))).all(axis=1)
        return found, is_inside

    def _distorted(self, points: Float64Array) -> Float64Array:
        """Positions (N, 2) in a distorted image [pixels]."""
        no_motion = np.zeros(3)
        if self._is_fisheye:
            image, _ = cv2.fisheye.projectPoints(
                points.reshape(-1, 1, 3), no_motion, no_motion, self._matrix, self._lens
            )
        else:
            image, _ = cv2.projectPoints(points.reshape(-1, 1, 3), no_motion, no_motion, self._matrix, self._lens)
        return np.asarray(image, dtype=np.float64).reshape(-1, 2)

    def visible_pixels(
        self, points: Float64Array, T_colour_sensor: Float64Array, spacing: float | None = None
    ) -> tuple[Int64Array, BoolArray]:
        """Return the pixels (N, 2) of points (N, 3) in the sensor's frame, and a mask of those that the camera sees.

        ``T_colour_sensor`` (4, 4) is the transform from the sensor to the camera. ``spacing`` is the distance of
        neighbouring points in the image [pixels]; None estimates it from their density.

        A point is hidden where another point within a cell of the image is nearer to the camera, and the two are
        further apart as the sensor sees them than neighbours on one surface are: parallax has moved them together.
        Labels within the distance of one cell of an outline may be those of the surface in front.
        """
        in_camera = points @ T_colour_sensor[:3, :3].T + T_colour_sensor[:3, 3]
        pixels, is_seen = self.pixels(in_camera)
        chosen = np.flatnonzero(is_seen)
        if chosen.size and np.linalg.norm(T_colour_sensor[:3, 3]) > 1e-6:
            cell = _cell_size(pixels[chosen], spacing)
            angle = _CELLS_APART * cell / float(min(self._matrix[0, 0], self._matrix[1, 1]))
            hidden = _hidden(pixels[chosen] // cell, in_camera[chosen], points[chosen], angle)
            is_seen[chosen[hidden]] = False
        return pixels, is_seen


def depth_points(depth: npt.NDArray[np.floating], camera: CameraModel) -> Float64Array:
    """Return the points (H * W, 3) of a depth image (H, W) [m] in the camera's frame; NaN without a measurement."""
    if camera.slopes is None:
        x = (np.arange(depth.shape[1]) - camera.cx) / camera.fx
        y = (np.arange(depth.shape[0]) - camera.cy) / camera.fy
        slopes = np.stack(np.broadcast_arrays(x[None, :], y[:, None]))
    else:
        slopes = camera.slopes.astype(np.float64)
    z = np.where(depth > 0, depth, np.nan).astype(np.float64)
    return np.stack([slopes[0] * z, slopes[1] * z, z], axis=-1).reshape(-1, 3)


def _cell_size(pixels: Int64Array, spacing: float | None) -> int:
    """Edge of the cells of the image in which points are compared [pixels]."""
    if spacing is None:
        width, height = (pixels.max(axis=0) - pixels.min(axis=0) + 1).tolist()
        spacing = math.sqrt(width * height / len(pixels))
    return int(min(max(math.ceil(spacing), 1), _LARGEST_CELL))


def _hidden(cells: Int64Array, in_camera: Float64Array, in_sensor: Float64Array, angle: float) -> BoolArray:
    """Mask (N,) of points that another point hides.

    ``cells`` (N, 2) are the cells of the points in the image, ``in_camera`` and ``in_sensor`` (N, 3) the points in the
    frames of both; ``angle`` is that of _CELLS_APART [rad].
    """
    z = in_camera[:, 2]
    of_camera, of_sensor = (points / np.linalg.norm(points, axis=1, keepdims=True) for points in (in_camera, in_sensor))
    # One cell of border on each side, so that every cell has eight neighbours.
    columns = int(cells[:, 0].max()) + 3
    keys = (cells[:, 1] + 1) * columns + cells[:, 0] + 1
    nearest = np.full((int(cells[:, 1].max()) + 3) * columns, -1, dtype=np.int64)
    order = np.argsort(-z, kind="stable")
    # Of the points of a cell the last one written, the nearest, remains.
    nearest[keys[order]] = order
    hidden = np.zeros(len(z), dtype=np.bool_)
    for shift in (r * columns + c for r in (-1, 0, 1) for c in (-1, 0, 1)):
        other = nearest[keys + shift]
        # Chords of unit vectors are the angles, which are small.
        from_camera, from_sensor = (np.linalg.norm(rays - rays[other], axis=1) for rays in (of_camera, of_sensor))
        is_apart = from_sensor > angle + _TIMES_APART * from_camera
        hidden |= (other >= 0) & (z[other] < _NEARER * z) & is_apart
    return hidden
