"""Configuration of one robot: logs, topics, clock and frames."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from octoreplay.config.fields import LARGEST, help_text, path_problem, transform_problem
from octoreplay.config.file_url import FileUrl, InputFile, input_file
from octoreplay.config.robot_sensor import SENSOR_KEYS, RobotSensor
from octoreplay.errors import ConfigError
from octoreplay.records import CENTRAL

POSE_FORMATS = ("tum", "euroc", "kitti", "matrices", "redwood", "geodetic", "tartanair")
"""Formats of trajectory files."""


@dataclass(frozen=True)
class RobotConfig:
    """Configuration of one robot: log files, topics, clock and frames.

    Topics and frames that are None are found in the logs. Raises ConfigError for values that are out of range or do not
    fit together.

    Attributes
    ----------
    robot_id : str
        Name of the robot in the team.
    logs : tuple of Path or FileUrl
        Log files or folders. All paths and URLs may be given as text, and one log without a tuple.
    depth_topic, label_topic, confidence_topic : str or None
        Image topics.
    cloud_topic : str or None
        Topic of point clouds or laser scans, with labels in ``label_field`` and confidences in ``confidence_field``.
    pose_topic, pose_file, pose_times : str, Path or FileUrl, or None
        Pose source: a topic, or a trajectory file. A file without times goes with ``pose_times``, the time of each
        pose, or has one pose per message of the sensor.
    pose_format : str or None
        Format of ``pose_file``, one of POSE_FORMATS (None: found by its header and its number of columns).
    pose_origin : tuple of 3 float or None
        Origin of the map frame in the coordinates of ``pose_file``: x, y, z [m], or latitude, longitude [degree] and
        height [m]. The same for every robot of a team.
    pose : tuple of 7 float or None
        Pose (x, y, z, qx, qy, qz, qw) [m] of a sensor that stands still, in ``map_frame``, instead of a pose source; of
        the body where T_body_sensor is given.
    fix_topic, tags_topic : str or None
        Topics of position fixes and of detected tags, from which ``align`` takes candidates; '' to use none.
    intrinsics : tuple of 4 float or None
        (fx, fy, cx, cy) [pixels], instead of CameraInfo.
    rectified : bool or None
        True: CameraInfo's P holds. False: K and the distortion hold. None: P where the topic's name contains 'rect'.
    map_frame : str or None
        Frame that TF transforms the poses to (None: the root of TF above them, else the frame that they are given in).
        With ``pose_file`` or ``pose`` it only names the frame of these poses.
    T_team_map, T_body_sensor : tuple of 7 float or None
        Transforms (x, y, z, qx, qy, qz, qw) [m]: from the robot's map frame to the team's frame (None: not given, and
        the identity is assumed), and from the sensor's frame to the frame of the poses (None: from TF).
    T_team_map_sigma : tuple of 6 float or None
        Standard deviations of T_team_map: position along the team's axes [m], rotation about them [rad].
    T_team_map_from : str or None
        Origin of T_team_map where it was computed, such as 'aligned with robot_1, L 812'. ``align`` does not rely on
        such a T_team_map and computes it again.
    body_box : tuple of 6 float or None
        (xmin, ymin, zmin, xmax, ymax, zmax) of the robot's body [m] in ``body_frame``, by default the frame of the
        poses. Points inside are left out.
    min_range, max_range : float or None
        Limits of a measured point's distance [m] (None: those of the team's sensor model). ``max_range`` is at most
        that of the team.
    sensors : tuple of RobotSensor
        Sensors of a robot with several; their fields take the place of the robot's own.
    clock_offset : float
        Seconds that are added to the robot's stamps.
    publish_period, publish_phase : float
        The robot publishes ``publish_phase`` seconds after the multiples of ``publish_period`` (None: the team's).
    """

    robot_id: str
    logs: tuple[InputFile, ...]
    depth_topic: str | None = field(default=None, metadata=help_text("topic of the depth images, raw or compressed"))
    label_topic: str | None = field(
        default=None, metadata=help_text("topic of the label images, ids or colours; '' to map without labels")
    )
    confidence_topic: str | None = field(
        default=None, metadata=help_text("topic of the images with the labels' confidences")
    )
    camera_info_topic: str | None = field(default=None, metadata=help_text("topic of the depth images' CameraInfo"))
    cloud_topic: str | None = field(
        default=None, metadata=help_text("topic of point clouds or laser scans, instead of depth_topic")
    )
    label_field: str | None = field(default=None, metadata=help_text("point field with the labels, such as rgb"))
    confidence_field: str | None = field(default=None, metadata=help_text("point field with the labels' confidences"))
    pose_topic: str | None = field(
        default=None, metadata=help_text("topic of the poses: odometry, stamped poses, a path or TF")
    )
    pose_file: InputFile | None = field(default=None, metadata=help_text("trajectory file, instead of pose_topic"))
    pose_times: InputFile | None = field(
        default=None, metadata=help_text("file with the times of a trajectory without times, one a line [s]")
    )
    pose_format: str | None = field(
        default=None, metadata=help_text(f"format of pose_file: {', '.join(POSE_FORMATS)} (default: by its columns)")
    )
    pose_origin: tuple[float, ...] | None = field(
        default=None, metadata=help_text("origin that is subtracted from the positions of pose_file, such as UTM's")
    )
    pose: tuple[float, ...] | None = field(
        default=None,
        metadata=help_text("pose of a sensor that stands still: x y z [m], quaternion x y z w, instead of pose_topic"),
    )
    label_info_topic: str | None = field(
        default=None, metadata=help_text("topic of the LabelInfo with the classes' names")
    )
    fix_topic: str | None = field(
        default=None, metadata=help_text("topic of position fixes (GPS) for align; '' to use none")
    )
    tags_topic: str | None = field(
        default=None, metadata=help_text("topic of tags with poses (AprilTags), or TF, for align; '' to use none")
    )
    map_frame: str | None = field(
        default=None,
        metadata=help_text("frame that TF transforms the poses to; the poses' own frame leaves corrections in TF out"),
    )
    sensor_frame: str | None = field(
        default=None, metadata=help_text("frame of the sensor (default: frame_id of its messages)")
    )
    intrinsics: tuple[float, ...] | None = field(
        default=None, metadata=help_text("[fx, fy, cx, cy], instead of CameraInfo [pixels]")
    )
    rectified: bool | None = field(
        default=None, metadata=help_text("true: use CameraInfo's P; false: use K and the distortion")
    )
    depth_unit: float | None = field(
        default=None, metadata=help_text("metres per depth value (default: that of the encoding)")
    )
    min_range: float | None = field(
        default=None, metadata=help_text("the sensor's own minimum range of a measured point [m]")
    )
    max_range: float | None = field(
        default=None, metadata=help_text("the sensor's own maximum range, at most the team's [m]")
    )
    sensors: tuple[RobotSensor, ...] = field(
        default=(), metadata=help_text("several sensors, each with the keys above that apply to one sensor")
    )
    clock_offset: float = field(default=0.0, metadata=help_text("offset added to the robot's stamps [s]"))
    T_team_map: tuple[float, ...] | None = field(
        default=None,
        metadata=help_text("transform from map_frame to the team's frame: x y z [m], quaternion x y z w"),
    )
    T_team_map_sigma: tuple[float, ...] | None = field(
        default=None,
        metadata=help_text("standard deviations of T_team_map: x y z [m], rotations about x y z [rad]"),
    )
    T_team_map_from: str | None = field(
        default=None, metadata=help_text("origin of T_team_map where a command computed it")
    )
    T_body_sensor: tuple[float, ...] | None = field(
        default=None,
        metadata=help_text("transform from the sensor to the frame that the poses describe, instead of TF"),
    )
    body_frame: str | None = field(
        default=None, metadata=help_text("frame of body_box (default: the frame that the poses describe)")
    )
    body_box: tuple[float, ...] | None = field(
        default=None, metadata=help_text("box around the robot: XMIN, YMIN, ZMIN, XMAX, YMAX, ZMAX [m]")
    )
    publish_period: float | None = field(default=None, metadata=help_text("the robot's own publish_period [s]"))
    publish_phase: float = field(default=0.0, metadata=help_text("delay after the multiples of publish_period [s]"))

    def __post_init__(self) -> None:
        for name in ("logs", "pose_file", "pose_times"):
            value = getattr(self, name)
            # Paths and URLs may be given as text.
            given = tuple(map(input_file, value)) if isinstance(value, tuple | list) else value and input_file(value)
            is_one = name == "logs" and isinstance(given, Path | FileUrl)
            object.__setattr__(self, name, (given,) if is_one else given)
        if not self.robot_id or "/" in self.robot_id:
            raise ConfigError(f"robot id '{self.robot_id}': every robot needs an id, without '/' in it")
        if self.robot_id == CENTRAL:
            raise ConfigError(f"robot id '{CENTRAL}': is the name of the centralised map; give the robot another")
        for problem in (
            *self._wrong_sensors(), *self._wrong_sources(), *self._wrong_geometry(), *self._wrong_numbers()
        ):  # fmt: skip
            raise ConfigError(f"robot '{self.robot_id}': {problem}")
        if self.sensors:
            # Each view raises the errors of its sensor.
            _ = self.views

    def _wrong_sensors(self) -> Iterator[str]:
        """Problems of several sensors."""
        object.__setattr__(self, "sensors", tuple(self.sensors))
        own = [name for name in SENSOR_KEYS if getattr(self, name) is not None]
        if self.sensors and own:
            yield f"{own[0]}: applies to one sensor; give it in an entry of sensors"
        used: set[str] = set()
        for sensor in self.sensors:
            if not (sensor.depth_topic or sensor.cloud_topic):
                yield "sensors: each needs a depth_topic or cloud_topic"
            source = "pose_file" if self.pose_file is not None else "pose" if self.pose is not None else None
            if source is not None and len(self.sensors) > 1 and sensor.T_body_sensor is None:
                yield f"sensors: with a {source} each needs T_body_sensor, since its poses are those of the body"
            topics = {sensor.depth_topic, sensor.cloud_topic, sensor.label_topic, sensor.confidence_topic} - {None, ""}
            for topic in sorted(map(str, topics & used)):
                yield f"sensors: two of them have the topic '{topic}'"
            used |= {str(topic) for topic in topics}

    def _wrong_sources(self) -> Iterator[str]:
        """Problems of files and topics."""
        for path in self.files:
            problem = path_problem(path) if isinstance(path, Path) else None
            if problem is not None:
                yield f"'{str(path)[:100]}': {problem}"
        if not self.logs:
            yield "needs a log"
        if self.depth_topic and self.cloud_topic:
            yield "give depth_topic or cloud_topic, not both"
        named = [name for name in ("pose_topic", "pose_file", "pose") if getattr(self, name)]
        if len(named) > 1:
            yield f"give {' or '.join(named)}, not {'both' if len(named) == 2 else 'all'}"
        if self.pose_times and not self.pose_file:
            yield "pose_times goes with pose_file"
        for name in ("pose_format", "pose_origin"):
            if getattr(self, name) is not None and not self.pose_file:
                yield f"{name} goes with pose_file"
        if self.pose_format is not None and self.pose_format not in POSE_FORMATS:
            yield f"pose_format '{self.pose_format}' is none of {', '.join(POSE_FORMATS)}"
        if self.pose_origin is not None and len(self.pose_origin) != 3:
            yield "pose_origin expects 3 numbers"

    def _wrong_geometry(self) -> Iterator[str]:
        """Problems of transforms, intrinsics and the body box."""
        for name in ("T_team_map", "T_body_sensor", "pose"):
            value = getattr(self, name)
            problem = None if value is None else transform_problem(name, value)
            if problem is not None:
                yield problem
        sigma = self.T_team_map_sigma
        if sigma is not None and (len(sigma) != 6 or min(sigma) < 0):
            yield "T_team_map_sigma expects 6 standard deviations, none below 0"
        for name in ("T_team_map_sigma", "T_team_map_from"):
            if getattr(self, name) is not None and self.T_team_map is None:
                yield f"{name} goes with T_team_map"
        if self.intrinsics is not None and (len(self.intrinsics) != 4 or min(self.intrinsics[:2]) <= 0):
            yield "intrinsics expects 4 numbers fx, fy, cx, cy"
        box = self.body_box
        if box is not None and (len(box) != 6 or not all(low < high for low, high in zip(box, box[3:], strict=False))):
            yield "body_box expects 6 numbers XMIN, YMIN, ZMIN, XMAX, YMAX, ZMAX, every minimum below its maximum"

    def _wrong_numbers(self) -> Iterator[str]:
        """Problems of numbers."""
        if self.depth_unit is not None and self.depth_unit <= 0:
            yield "depth_unit must be greater than 0"
        if self.publish_period is not None and not 0 < self.publish_period < math.inf:
            yield "publish_period must be greater than 0"
        low, high = self.min_range or 0.0, math.inf if self.max_range is None else self.max_range
        if not 0 <= low < high:
            yield "min_range must not be negative and must be below max_range"
        if not 0 <= self.publish_phase < math.inf:
            yield "publish_phase must not be negative"
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            numbers = [n for n in (value if isinstance(value, tuple) else (value,)) if isinstance(n, float)]
            if not all(math.isfinite(number) for number in numbers):
                yield f"{item.name} must be finite, not {value}"
            if any(abs(number) > LARGEST for number in numbers):
                yield f"{item.name} must not hold numbers above {LARGEST:g}"

    def with_poses(self, **source: Any) -> Self:
        """Return the robot with another source of poses: some of the fields from ``pose_topic`` to ``pose``."""
        names = ("pose_topic", "pose_file", "pose_times", "pose_format", "pose_origin", "pose")
        return dataclasses.replace(self, **{**dict.fromkeys(names), **source})

    @property
    def has_poses(self) -> bool:
        """True where the configuration names a source of poses."""
        return bool(self.pose_topic or self.pose_file or self.pose)

    @property
    def views(self) -> tuple[Self, ...]:
        """The robot with each of its sensors alone, in their order."""
        return tuple(
            dataclasses.replace(self, sensors=(), **{name: getattr(sensor, name) for name in SENSOR_KEYS})
            for sensor in self.sensors
        ) or (self,)

    @property
    def T_team_map_or_identity(self) -> tuple[float, ...]:
        """``T_team_map``, or the identity where it is not given."""
        return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0) if self.T_team_map is None else self.T_team_map

    @property
    def files(self) -> tuple[InputFile, ...]:
        """All files and folders with the robot's data."""
        return (*self.logs, *(path for path in (self.pose_file, self.pose_times) if path is not None))

    def with_paths_from(self, folder: Path) -> Self:
        """This robot as a result in a folder names its files.

        Paths are relative to the folder, which is absolute and has no symbolic links; URLs have no credentials.
        """

        def path_from(path: InputFile) -> InputFile:
            return path.public() if isinstance(path, FileUrl) else Path(os.path.relpath(path.resolve(), folder))

        logs = tuple(map(path_from, self.logs))
        pose_file, pose_times = (None if p is None else path_from(p) for p in (self.pose_file, self.pose_times))
        return dataclasses.replace(self, logs=logs, pose_file=pose_file, pose_times=pose_times)

    def with_absolute_paths(self) -> Self:
        """This robot with paths that hold from everywhere."""
        logs = tuple(log.resolve() for log in self.logs)
        pose_file, pose_times = (None if path is None else path.resolve() for path in (self.pose_file, self.pose_times))
        return dataclasses.replace(self, logs=logs, pose_file=pose_file, pose_times=pose_times)
