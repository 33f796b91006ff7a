"""LiDAR odometry by KISS-ICP: point-to-point registration of each scan to a local map of the last ones.

kiss-icp is an optional dependency: ``pip install 'octoreplay[odometry]'``. Source: Vizzo et al., KISS-ICP: In Defense
of Point-to-Point ICP, RA-L 2023 (https://github.com/PRBonn/kiss-icp).
"""

from __future__ import annotations

import warnings
from collections import deque
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from octoreplay.errors import ConfigError
from octoreplay.odometry.motion import part_of, proper
from octoreplay.odometry.registration import ScanPose, least_information
from octoreplay.odometry.scans import TimedCloud
from octoreplay.records import Float64Array, Frame
from octoreplay.transforms import inverse

# Edges of voxels relative to the range that 95 % of the points have, with bounds [m].
_VOXELS_PER_RANGE, _LEAST_VOXEL, _LARGEST_VOXEL = 10.0, 0.1, 1.0
# Number of scans whose points judge the registration of the next one.
_NUM_RECENT = 6
_NUM_NEIGHBOURS, _MAX_JUDGED = 20, 600
# Edge of the voxels of these points, and largest distance of a counterpart, relative to those of the local map.
_FINE, _NEAR = 0.25, 0.25
# A surface has neighbours within this share of the second largest spread, and is no line.
_FLAT, _NOT_A_LINE = 0.1, 0.03
_MIN_POINTS = 30


@dataclass(frozen=True, eq=False)
class _Scan:
    """Scan that was registered last: its compensated points, its pose and the expected one."""

    points: Float64Array
    T_map_sensor: Float64Array
    T_map_expected: Float64Array


class LidarOdometry:
    """Registration of clouds, with motion compensation where the points have times.

    ``max_range`` and ``voxel_size`` are in metres; without a voxel size it follows from the first scan: a tenth of
    the range that holds 95 % of the points, between 0.1 and 1 m. The compensation moves points to the middle of the
    sweep: there an error of the motion moves the points of both halves in opposite directions and not the pose. The
    motion in the first scan is known only with the second one, which is registered twice. Raises ConfigError without
    kiss-icp.
    """

    def __init__(self, *, max_range: float = 100.0, voxel_size: float | None = None) -> None:
        self._kiss = _import_kiss_icp()
        self._max_range, self.voxel_size = max_range, voxel_size
        self._parts: _Parts | None = None
        self._recent: deque[Float64Array] = deque(maxlen=_NUM_RECENT)
        self._T_map_sensor = np.eye(4)
        self._last: _Scan | None = None
        self._first: TimedCloud | None = None

    def register(self, frame: Frame, motion: Float64Array, seconds: float) -> ScanPose:
        """Return the pose of a cloud (``Odometer.register``); the first one is at the identity."""
        if not isinstance(frame, TimedCloud):
            raise TypeError("a cloud is expected")
        parts = self._parts_for(frame)
        expected = self._T_map_sensor @ motion
        if parts.local_map.empty():
            points = parts.compensated(frame, motion, 0.0)
            self._last, self._first = _Scan(points, expected, expected), frame
            return ScanPose(expected, float(len(points) >= _MIN_POINTS), 0.0, 1.0, frame.middle)
        if self._first is not None and self._first.times is not None:
            T_map_sensor = self._aligned(parts.compensated(frame, motion, seconds), expected, parts)
            motion = inverse(self._T_map_sensor) @ T_map_sensor
            self._begin(parts.compensated(self._first, motion, seconds), parts)
        points = parts.compensated(frame, motion, seconds)
        T_map_sensor = self._aligned(points, expected, parts)
        self._last = _Scan(points, T_map_sensor, expected)
        return ScanPose(T_map_sensor, *self._judge(points, T_map_sensor, parts.voxel_size), frame.middle)

    def keep(self) -> None:
        """Add the last scan to the local map."""
        scan, parts = self._of_last()
        if not parts.local_map.empty():
            parts.threshold.update_model_deviation(inverse(scan.T_map_expected) @ scan.T_map_sensor)
            self._first = None
        self._T_map_sensor = scan.T_map_sensor
        self._add(scan.points, parts)

    def leave_out(self) -> None:
        """Take the expected pose for the last scan."""
        self._T_map_sensor, self._first = self._of_last()[0].T_map_expected, None

    def restart(self) -> None:
        """Begin a new local map with the last scan at its expected pose."""
        scan, parts = self._of_last()
        self._T_map_sensor, self._first = scan.T_map_expected, None
        self._begin(scan.points, parts)

    def _begin(self, points: Float64Array, parts: _Parts) -> None:
        """Begin a new local map with points (n, 3) at the present pose."""
        parts.local_map.clear()
        self._recent.clear()
        self._add(points, parts)

    def _add(self, points: Float64Array, parts: _Parts) -> None:
        """Add points (n, 3) to the local map at the present pose."""
        T = self._T_map_sensor
        parts.local_map.update(parts.coarse(points), T)
        self._recent.append(points @ T[:3, :3].T + T[:3, 3])

    @staticmethod
    def _aligned(points: Float64Array, expected: Float64Array, parts: _Parts) -> Float64Array:
        """T_map_sensor of points (n, 3) in the local map, from the expected pose on."""
        source = parts.sparse(points)
        if len(source) < _MIN_POINTS:
            return expected
        sigma = parts.threshold.get_threshold()
        return proper(
            parts.registration.align_points_to_map(
                points=source, voxel_map=parts.local_map, initial_guess=expected,
                max_correspondance_distance=3.0 * sigma, kernel=sigma,
            )
        )  # fmt: skip

    def _of_last(self) -> tuple[_Scan, _Parts]:
        """The last scan and the parts of the registration, after ``register``."""
        if self._last is None or self._parts is None:
            raise RuntimeError("no scan was registered")
        return self._last, self._parts

    def _judge(self, source: Float64Array, T_map_sensor: Float64Array, voxel: float) -> tuple[float, float, float]:
        """Overlap, residual and constraint of registered points against the points of recent scans."""
        from scipy.spatial import cKDTree

        if not self._recent or len(source) < _MIN_POINTS:
            return 0.0, 0.0, 1.0
        placed = source @ T_map_sensor[:3, :3].T + T_map_sensor[:3, 3]
        recent = np.concatenate(self._recent)
        tree = cKDTree(recent)
        distances, _ = tree.query(placed)
        near = distances <= _NEAR * voxel
        if not near.any():
            return 0.0, 0.0, 1.0
        chosen = placed[near]
        chosen = chosen[:: max(len(chosen) // _MAX_JUDGED, 1)]
        _, neighbours = tree.query(chosen, k=min(_NUM_NEIGHBOURS, len(recent)))
        is_planar = bool(np.abs(source[:, 2]).max() < 1e-6)
        constraint = _constraint(chosen, recent[neighbours], is_planar=is_planar)
        return float(near.mean()), float(np.sqrt(np.square(distances[near]).mean())), constraint

    def _parts_for(self, frame: TimedCloud) -> _Parts:
        """Parts of the registration, made for the first scan."""
        if self._parts is None:
            if self.voxel_size is None:
                ranges = np.linalg.norm(frame.points, axis=1)
                ranges = ranges[ranges <= self._max_range]
                reach = float(np.quantile(ranges, 0.95)) if ranges.size else self._max_range
                self.voxel_size = float(np.clip(reach / _VOXELS_PER_RANGE, _LEAST_VOXEL, _LARGEST_VOXEL))
            self._parts = _Parts(self._kiss, self._max_range, self.voxel_size)
        return self._parts


class _Parts:
    """Parts of KISS-ICP, in one thread so that equal logs give equal poses."""

    def __init__(self, kiss: ModuleType, max_range: float, voxel_size: float) -> None:
        from kiss_icp import mapping, preprocess, registration, threshold, voxelization

        config = kiss.KISSConfig(
            data={"max_range": max_range, "min_range": 0.0, "deskew": True},
            mapping={"voxel_size": voxel_size, "max_points_per_voxel": 20},
            registration={"max_num_iterations": 500, "convergence_criterion": 1e-4, "max_num_threads": 1},
            adaptive_threshold={"initial_threshold": 2.0 * voxel_size, "min_motion_th": 0.1 * voxel_size},
        )
        self.voxel_size = voxel_size
        self._preprocessor = preprocess.get_preprocessor(config)
        self.registration = registration.get_registration(config)
        self.threshold = threshold.get_threshold_estimator(config)
        self.local_map: Any = mapping.get_voxel_hash_map(config)
        self._downsample = voxelization.voxel_down_sample

    def compensated(self, frame: TimedCloud, motion: Float64Array, seconds: float) -> Float64Array:
        """Points (n, 3) of a scan, as seen from the pose in the middle of its sweep.

        ``motion`` (4, 4) is that in the ``seconds`` between two scans; 0 for an unknown motion.
        """
        points = np.ascontiguousarray(frame.points, dtype=np.float64)
        if frame.times is None or seconds <= 0:
            moved = self._preprocessor.preprocess(points, np.empty(0), np.eye(4))
        else:
            first, last = float(frame.times.min()), float(frame.times.max())
            # KISS-ICP spreads a motion over the sweep and moves the points to its end.
            moved = self._preprocessor.preprocess(points, frame.times, part_of(motion, (last - first) / seconds))
            T_middle_end = part_of(motion, (last - first) / (2.0 * seconds))
            moved = moved @ T_middle_end[:3, :3].T + T_middle_end[:3, 3]
        return np.asarray(self._downsample(moved, _FINE * self.voxel_size))

    def coarse(self, points: Float64Array) -> Float64Array:
        """Points (m, 3) of a compensated scan for the local map."""
        return np.asarray(self._downsample(points, 0.5 * self.voxel_size))

    def sparse(self, points: Float64Array) -> Float64Array:
        """Points (m, 3) of a compensated scan that are registered."""
        return np.asarray(self._downsample(self.coarse(points), 1.5 * self.voxel_size))


def _constraint(points: Float64Array, neighbours: Float64Array, *, is_planar: bool) -> float:
    """Least information of points (n, 3), with normals by the principal axes of their neighbours (n, k, 3)."""
    axes = 2 if is_planar else 3
    centred = (neighbours - neighbours.mean(axis=1, keepdims=True))[..., :axes]
    spreads, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
    is_surface = spreads[:, 0] < _FLAT * spreads[:, 1]
    if not is_planar:
        is_surface &= spreads[:, 1] > _NOT_A_LINE * spreads[:, 2]
    return least_information(points[is_surface, :axes], vectors[is_surface, :, 0])


def _import_kiss_icp() -> ModuleType:
    """Import kiss-icp. Raises ConfigError where it is missing."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            import kiss_icp.config
    except ImportError as error:
        raise ConfigError(
            f"odometry of clouds and scans needs kiss-icp ({error}); install it with: pip install "
            f"'octoreplay[odometry]'"
        ) from error
    module: ModuleType = kiss_icp.config
    return module
