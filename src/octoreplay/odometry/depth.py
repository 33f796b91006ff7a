"""Odometry of depth images, with or without colours, by Open3D: each image is registered to the last key frame.

Source: Park, Zhou and Koltun, Colored Point Cloud Registration Revisited, ICCV 2017, for images with colours;
point-to-plane distance otherwise (https://www.open3d.org/docs/release/python_api/open3d.t.pipelines.odometry.html).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from octoreplay.errors import InputError
from octoreplay.odometry.motion import proper
from octoreplay.odometry.registration import ScanPose, least_information
from octoreplay.odometry.scans import ColoredDepth
from octoreplay.records import CameraModel, Float32Array, Float64Array, Frame
from octoreplay.transforms import inverse

# A new key frame begins beyond this distance [m], rotation [rad], or below this overlap.
_KEY_DISTANCE, _KEY_ROTATION, _KEY_OVERLAP = 0.2, 0.3, 0.6
_ITERATIONS = (10, 5, 3)
# Pixels between two points of the judgement, and half the base line of their normals.
_STEP, _HALF_BASE = 8, 4
_MIN_MEASURED = 0.02


@dataclass(frozen=True, eq=False)
class _Image:
    """Image of Open3D with its pose, its expected pose, and the number of measured pixels."""

    rgbd: Any
    T_map_sensor: Float64Array
    T_map_expected: Float64Array
    overlap: float


class DepthOdometry:
    """Registration of depth images to key frames.

    Images with ``colors`` are registered by depth and brightness, others by depth. Pixels beyond ``max_range`` [m]
    are not used. Raises InputError if Open3D or one of its shared libraries is missing.
    """

    def __init__(self, *, max_range: float = 10.0) -> None:
        try:
            import open3d
        except (ImportError, OSError) as error:
            raise InputError(f"odometry of depth images needs Open3D, which cannot be loaded ({error})") from error
        self._open3d: Any = open3d
        self._max_range = max_range
        self._key: _Image | None = None
        self._last: _Image | None = None
        self._T_map_sensor = np.eye(4)

    def register(self, frame: Frame, motion: Float64Array, seconds: float) -> ScanPose:  # noqa: ARG002 - an Odometer
        """Return the pose of a depth image (``Odometer.register``); the first one is at the identity."""
        if not isinstance(frame, ColoredDepth):
            raise TypeError("a depth image is expected")
        depth = (frame.depth_image * np.float32(frame.depth_unit)).astype(np.float32)
        depth[~(depth <= self._max_range)] = 0.0
        measured = float((depth > 0).mean())
        expected = self._T_map_sensor @ motion
        rgbd = self._image(depth, frame)
        self._last = _Image(rgbd, expected, expected, 0.0)
        if measured < _MIN_MEASURED:
            return ScanPose(expected, 0.0, 0.0, 1.0)
        if self._key is None:
            self._last = _Image(rgbd, expected, expected, 1.0)
            return ScanPose(expected, 1.0, 0.0, 1.0)
        found = self._registered(rgbd, frame, inverse(self._key.T_map_sensor) @ expected)
        # Texture can determine what the geometry leaves open.
        constraint = 1.0 if frame.colors is not None else _constraint(depth, frame.camera)
        if found is None:
            return ScanPose(expected, 0.0, 0.0, constraint)
        T_key_sensor, fitness, residual = found
        T_map_sensor = proper(self._key.T_map_sensor @ T_key_sensor)
        overlap = min(fitness / measured, 1.0)
        self._last = _Image(rgbd, T_map_sensor, expected, overlap)
        return ScanPose(T_map_sensor, overlap, residual, constraint)

    def keep(self) -> None:
        """Take the pose of the last image, and make the image the key frame where it is far from the present one."""
        image = self._of_last()
        self._T_map_sensor = image.T_map_sensor
        if self._key is None or image.overlap < _KEY_OVERLAP or _is_far(self._key.T_map_sensor, image.T_map_sensor):
            self._key = image

    def leave_out(self) -> None:
        """Take the expected pose for the last image."""
        self._T_map_sensor = self._of_last().T_map_expected

    def restart(self) -> None:
        """Make the last image the key frame at its expected pose."""
        image = self._of_last()
        self._T_map_sensor = image.T_map_expected
        self._key = _Image(image.rgbd, image.T_map_expected, image.T_map_expected, 1.0)

    def _of_last(self) -> _Image:
        """The last image, after ``register``."""
        if self._last is None:
            raise RuntimeError("no image was registered")
        return self._last

    def _image(self, depth: Float32Array, frame: ColoredDepth) -> Any:
        """Image of Open3D, black without colours."""
        geometry, tensor = self._open3d.t.geometry, self._open3d.core.Tensor
        colors = np.zeros((*depth.shape, 3), np.uint8) if frame.colors is None else frame.colors
        return geometry.RGBDImage(geometry.Image(tensor(colors)), geometry.Image(tensor(depth)), True)

    def _registered(
        self, rgbd: Any, frame: ColoredDepth, guess: Float64Array
    ) -> tuple[Float64Array, float, float] | None:
        """T_key_sensor, the share of pixels with a counterpart and their residual [m]; None without a solution."""
        odometry, tensor = self._open3d.t.pipelines.odometry, self._open3d.core.Tensor
        camera = frame.camera
        matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        method = odometry.Method.PointToPlane if frame.colors is None else odometry.Method.Hybrid
        key = self._key
        if key is None:
            return None
        try:
            found = odometry.rgbd_odometry_multi_scale(
                rgbd, key.rgbd, tensor(matrix), tensor(guess), 1.0, self._max_range,
                [odometry.OdometryConvergenceCriteria(count) for count in _ITERATIONS], method,
            )  # fmt: skip
        except RuntimeError:
            # Open3D raises it for a singular system of equations.
            return None
        T_key_sensor = found.transformation.numpy()
        if not np.isfinite(T_key_sensor).all() or not found.fitness > 0:
            return None
        return T_key_sensor, float(found.fitness), math.sqrt(max(float(found.inlier_rmse), 0.0))


def _is_far(one: Float64Array, other: Float64Array) -> bool:
    """True where two poses are further apart than those of a key frame and its images."""
    between = inverse(one) @ other
    cosine = (np.trace(between[:3, :3]) - 1.0) / 2.0
    return bool(np.linalg.norm(between[:3, 3]) > _KEY_DISTANCE or cosine < math.cos(_KEY_ROTATION))


def _constraint(depth: Float32Array, camera: CameraModel) -> float:
    """Least information of a depth image, with normals by differences between pixels."""
    v, u = np.meshgrid(np.arange(depth.shape[0]), np.arange(depth.shape[1]), indexing="ij")
    z = np.where(depth > 0, depth, np.nan).astype(np.float64)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
    inner = (
        slice(_HALF_BASE, depth.shape[0] - _HALF_BASE, _STEP),
        slice(_HALF_BASE, depth.shape[1] - _HALF_BASE, _STEP),
    )
    rows, columns = (np.arange(size)[part] for size, part in zip(depth.shape, inner, strict=True))
    if not rows.size or not columns.size:
        return 0.0
    grid = np.ix_(rows, columns)
    across = points[np.ix_(rows, columns + _HALF_BASE)] - points[np.ix_(rows, columns - _HALF_BASE)]
    down = points[np.ix_(rows + _HALF_BASE, columns)] - points[np.ix_(rows - _HALF_BASE, columns)]
    normals = np.cross(across, down).reshape(-1, 3)
    lengths = np.linalg.norm(normals, axis=1)
    chosen = points[grid].reshape(-1, 3)
    # Differences across an edge are no normals.
    is_smooth = np.maximum(np.abs(across[..., 2]), np.abs(down[..., 2])).reshape(-1) < 0.1 * chosen[:, 2]
    usable = np.isfinite(lengths) & (lengths > 0) & np.isfinite(chosen).all(axis=1) & is_smooth
    return least_information(chosen[usable], normals[usable] / lengths[usable, None])
