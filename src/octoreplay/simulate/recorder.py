"""Writing of one simulated robot's log: poses, images or scans, position fixes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from octoreplay.io.robots.robot_log_writer import RobotLogWriter
from octoreplay.records import Float64Array, Int64Array, UInt8Array
from octoreplay.simulate.body_poses import T_BODY_CAMERA, T_BODY_LIDAR, body_poses, midway, pose_errors
from octoreplay.simulate.camera import LabelPatches, MeshCamera, add_depth_noise, add_label_noise, depth_to_millimetres
from octoreplay.simulate.colour import ColourCamera
from octoreplay.simulate.confidences import LabelErrors, softmax_confidences
from octoreplay.simulate.lidar import MeshLidar, add_range_noise
from octoreplay.simulate.odometry import HEIGHT_FACTOR, drift_corrections, own_frame, position_fixes
from octoreplay.simulate.scene import NO_LABEL
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.world import Terrain, similar_classes
from octoreplay.transforms import inverse

START_NS = 1_700_000_000_000_000_000
"""Stamp of a simulation's first message, constant so that equal settings give equal bytes."""

_ODOMETRY_RATE = 20.0


@dataclass(frozen=True)
class Schedule:
    """Times of poses and of images or scans: the period of poses [ns], poses per image, and the number of poses."""

    pose_period_ns: int
    stride: int
    num_poses: int

    @classmethod
    def of(cls, config: SimulationConfig) -> Schedule:
        """Schedule with about 20 poses a second and a whole number of poses per image."""
        stride = max(1, round(_ODOMETRY_RATE / config.rate))
        pose_period_ns = round(1e9 / config.rate / stride)
        return cls(pose_period_ns, stride, max(2, round(config.duration * 1e9 / pose_period_ns) + 1))

    @property
    def period(self) -> float:
        """Period of poses [s]."""
        return self.pose_period_ns / 1e9

    @property
    def stamps_ns(self) -> Int64Array:
        """Stamps (T,) of the poses."""
        return START_NS + self.pose_period_ns * np.arange(self.num_poses, dtype=np.int64)

    def exposures(self, robot_index: int, num_robots: int) -> range:
        """Indices of the poses after which a robot takes an image; they differ between robots, as for real cameras."""
        return range(robot_index * self.stride // num_robots, self.num_poses - 1, self.stride)


class Recorder:
    """Writer of one robot's poses and of its images or scans.

    ``states`` (T, 3) are x, y [m] and heading [rad] of its drive. ``poses`` (T, 4, 4) are the true poses of the base in
    the village's frame; ``T_map_odom`` (4, 4) transforms from the frame of the recorded poses to the village's.
    """

    def __init__(
        self,
        config: SimulationConfig,
        terrain: Terrain,
        sensor: MeshCamera | MeshLidar,
        states: Float64Array,
        index: int,
        schedule: Schedule,
    ) -> None:
        self._config = config
        self._sensor = sensor
        self._schedule = schedule
        self._states = states
        self.poses = body_poses(terrain, self._states)
        period, rng = schedule.period, np.random.default_rng([config.seed, 3, index])
        errors = pose_errors(config.pose_noise, len(self._states), period, rng)
        recorded = body_poses(terrain, self._states + errors)
        if any(config.odometry_drift):
            rng = np.random.default_rng([config.seed, 4, index])
            recorded = drift_corrections(self.poses, *config.odometry_drift, rng) @ recorded
        self.T_map_odom = np.eye(4)
        if config.own_frames:
            self.T_map_odom = own_frame(self.poses[0], np.random.default_rng([config.seed, 5, index]))
            recorded = inverse(self.T_map_odom) @ recorded
        self._recorded = recorded
        self._fixes: dict[int, Float64Array] = {}
        if config.fixes is not None:
            steps = range(0, schedule.num_poses, max(1, round(1e9 / schedule.pose_period_ns)))
            rng = np.random.default_rng([config.seed, 8, index])
            self._fixes = dict(zip(steps, position_fixes(self.poses[steps, :3, 3], config.fixes, rng), strict=True))
        self._exposures = schedule.exposures(index, config.num_robots)
        self._rng = np.random.default_rng([config.seed, 2, index])
        self._similar = similar_classes(config.kinds_per_class) if config.similar_errors else None
        self._patches: LabelPatches | None = None
        if config.patchy_noise > 0:
            rng = np.random.default_rng([config.seed, 7, index])
            self._patches = LabelPatches(config.patchy_noise, config.class_table.num_classes, rng, self._similar)
        self._errors: LabelErrors | None = None
        if config.confidences is not None:
            rng = np.random.default_rng([config.seed, 9, index])
            self._errors = LabelErrors(config.label_noise, config.num_candidates, rng)
        self._colour: ColourCamera | None = None
        self.T_body_color: Float64Array | None = None
        if config.colour is not None and isinstance(sensor, MeshCamera):
            self._colour = ColourCamera(sensor, config.class_table, config.seed, index)
            if any(config.colour_offset):
                self.T_body_color = T_BODY_CAMERA.copy()
                self.T_body_color[:3, 3] += T_BODY_CAMERA[:3, :3] @ config.colour_offset

    def record(self, log: RobotLogWriter) -> Iterator[int]:
        """Write all poses and images or scans in the order of time; yield each image's stamp."""
        config, period_ns = self._config, self._schedule.pose_period_ns
        for step, (state, T_map_body) in enumerate(zip(self._states, self.poses, strict=True)):
            recorded = self._recorded[step]
            stamp_ns = START_NS + step * period_ns
            following = self._states[min(step + 1, len(self._states) - 1)]
            speed = float(np.hypot(*(following[:2] - state[:2]))) * 1e9 / period_ns
            log.write_pose(stamp_ns, recorded, speed, float(following[2] - state[2]) * 1e9 / period_ns)
            if config.fixes is not None and step in self._fixes:
                log.write_fix(stamp_ns, self._fixes[step].tolist(), config.fixes, HEIGHT_FACTOR * config.fixes)
            if step in self._exposures:
                # Exposed midway between two poses, so that readers have to interpolate.
                T_map_exposed = midway(T_map_body, self.poses[step + 1])
                if isinstance(self._sensor, MeshLidar):
                    self._write_scan(log, self._sensor, stamp_ns + period_ns // 2, T_map_exposed @ T_BODY_LIDAR)
                else:
                    self._write_image(log, self._sensor, stamp_ns + period_ns // 2, T_map_exposed @ T_BODY_CAMERA)
                if self._colour is not None:
                    mount = T_BODY_CAMERA if self.T_body_color is None else self.T_body_color
                    image = self._colour.take(T_map_exposed @ mount)
                    log.write_color(stamp_ns + period_ns // 2, image, str(config.colour))
                yield stamp_ns + period_ns // 2

    def _write_image(self, log: RobotLogWriter, camera: MeshCamera, stamp_ns: int, T_map_camera: Float64Array) -> None:
        """Render and write one image with the noise of a depth camera and of a segmentation network."""
        config = self._config
        true_depth, labels = camera.take(T_map_camera, config.max_depth)
        depth = true_depth
        if config.depth_noise > 0:
            depth = add_depth_noise(depth, self._rng, config.depth_noise)
        labels, confidences = self._with_errors(labels, lambda: camera.points(true_depth, T_map_camera))
        log.write_frame(stamp_ns, depth_to_millimetres(depth), labels if config.has_labels else None, confidences)

    def _write_scan(self, log: RobotLogWriter, lidar: MeshLidar, stamp_ns: int, T_map_lidar: Float64Array) -> None:
        """Measure and write one scan with the noise of a LiDAR and of a segmentation network."""
        config = self._config
        true_ranges, labels = lidar.take(T_map_lidar, config.scan_range)
        ranges = true_ranges
        if config.depth_noise > 0:
            ranges = add_range_noise(ranges, self._rng, config.depth_noise)
        R, position = T_map_lidar[:3, :3], T_map_lidar[:3, 3]
        labels, confidences = self._with_errors(labels, lambda: lidar.points(true_ranges) @ R.T + position)
        measured = ranges > 0
        log.write_cloud(
            stamp_ns,
            lidar.points(ranges)[measured],
            labels=labels[measured].astype(np.uint16) if config.has_labels else None,
            confidences=None if confidences is None else confidences[measured],
        )

    def _with_errors(
        self, labels: UInt8Array, points: Callable[[], Float64Array]
    ) -> tuple[UInt8Array, UInt8Array | None]:
        """Labels (H, W) with the errors of a segmentation network, and their confidences, None for logs without.

        ``points`` gives the points (H, W, 3) in the map.
        """
        config = self._config
        errors = None if self._errors is None else self._errors.probabilities(points(), self._rng)
        if self._patches is not None:
            labels = self._patches.apply(labels, points())
        if config.label_noise > 0:
            share = config.label_noise if errors is None else errors
            labels = add_label_noise(labels, share, config.class_table.num_classes, self._rng, self._similar)
        if errors is None or config.confidences is None:
            return labels, None
        confidences = softmax_confidences(errors, config.num_candidates, config.confidences)
        return labels, np.where(labels == NO_LABEL, np.uint8(0), confidences)
