"""Streams of a log that labels are made from: a robot's sensor, its colour camera, and the transform between them."""

from __future__ import annotations

import dataclasses
import heapq
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from octoreplay.config.robot import RobotConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.containers.log_reader import LogReader, first_whole_message
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import Calibration, Kind, Transforms
from octoreplay.io.robots.log_groups import LogGroup, groups_in
from octoreplay.io.robots.pose_source import load_static_transforms, moving_tf_names, tf_topics
from octoreplay.io.robots.poses import FrameTree
from octoreplay.io.robots.survey import CLOUDS, IMAGES, Survey, TopicSample
from octoreplay.io.robots.topics import find_topics_of_one, nearest_topics
from octoreplay.io.sensors.cameras import camera_model, has_rectified_name
from octoreplay.io.sensors.images import COLOR_IMAGE_ENCODINGS
from octoreplay.labelling.projection import ImageProjection
from octoreplay.records import CameraModel, Float64Array
from octoreplay.transforms import inverse, normalise, transform_of

_POSE_GAP_NS = 1_000_000_000


@dataclass(frozen=True)
class StreamOptions:
    """Options that replace what a log says about its streams; None leaves it to the log.

    ``T_sensor_colour`` are x, y, z [m] and qx, qy, qz, qw of the colour camera's pose in the sensor's frame. With
    ``is_aligned`` the depth image is registered to the colour image. ``colour_intrinsics`` are fx, fy, cx, cy [pixels].
    """

    sensor_topic: str | None = None
    colour_topic: str | None = None
    T_sensor_colour: tuple[float, ...] | None = None
    colour_intrinsics: tuple[float, ...] | None = None
    is_aligned: bool = False

    def __post_init__(self) -> None:
        pose, camera = self.T_sensor_colour, self.colour_intrinsics
        if pose is not None and (not np.isfinite(pose).all() or normalise(pose[3:]) is None):
            raise ConfigError("extrinsics: expects finite numbers and a quaternion whose length is not 0")
        if pose is not None and self.is_aligned:
            raise ConfigError("extrinsics: aligned images have none; give one of --aligned and --extrinsics")
        if camera is not None and (not np.isfinite(camera).all() or min(camera[:2]) <= 0):
            raise ConfigError("colour_intrinsics: expects finite numbers, of which fx and fy are above 0")


@dataclass(frozen=True, eq=False)
class RobotStreams:
    """Streams of one robot.

    ``projection`` and ``T_colour_sensor`` (4, 4) are None where the depth image is registered to the colour image.
    ``depth_camera`` is that of depth images that are not. ``camera_info_topic`` calibrates the depth images; None for
    clouds and where the log has no CameraInfo.
    """

    robot: RobotConfig
    sensor_topic: str
    colour_topic: str
    projection: ImageProjection | None
    T_colour_sensor: Float64Array | None
    depth_camera: CameraModel | None
    camera_info_topic: str | None
    note: str

    @property
    def is_cloud(self) -> bool:
        """True where the sensor gives point clouds or laser scans."""
        return self.robot.depth_topic is None


def find_streams(survey: Survey, options: StreamOptions) -> list[RobotStreams]:
    """Return the streams of each robot in a log.

    Raises InputError where a log has no sensor, no colour images, no calibration or no transform between the cameras,
    ConfigError where several topics fit.
    """
    groups = groups_in([survey])
    if len(groups) > 1 and (options.sensor_topic or options.colour_topic):
        owners = {survey.owners.get(name) for name in (options.sensor_topic, options.colour_topic) if name}
        groups = [group for group in groups if group.namespace in owners] or groups
    return [_streams_of(group, survey, options) for group in groups]


def _streams_of(group: LogGroup, survey: Survey, options: StreamOptions) -> RobotStreams:
    """Streams of one robot."""
    samples = group.samples()
    robot = _robot_with_sensor(group, samples, options)
    topic = str(robot.depth_topic or robot.cloud_topic)
    colour = _colour_topic(group, samples, topic, options)
    sensor, image = samples[topic], samples[colour]
    info_topic = _camera_info_topic(group, colour)
    calibration = _calibration(survey, info_topic, image, options)
    is_cloud = robot.depth_topic is None
    if options.is_aligned and (is_cloud or sensor.size != image.size):
        raise ConfigError(
            f"{survey.path}: '{topic}' and '{colour}' are not images of one size, so that they are not aligned"
        )
    same_frame = sensor.frame_id == image.frame_id and options.T_sensor_colour is None
    if not is_cloud and sensor.size == image.size:
        depth_calibration = None if robot.camera_info_topic is None else _camera_info(survey, robot.camera_info_topic)
        known = calibration is not None and depth_calibration is not None
        if options.is_aligned or (same_frame and (not known or _is_same_camera(calibration, depth_calibration))):
            # The calibration of the colour camera is that of the images that are registered to it.
            info_topic = robot.camera_info_topic or info_topic
            return RobotStreams(robot, topic, colour, None, None, None, info_topic, "registered to the colour image")
    if calibration is None:
        raise InputError(
            f"{survey.path}: there is no CameraInfo for '{colour}'; give --colour-intrinsics FX,FY,CX,CY"
            + ("" if is_cloud else ", or --aligned where the depth image is registered to the colour image")
        )
    where = f"{survey.path}: topic '{colour}'"
    projection = ImageProjection(calibration, where, is_rectified=has_rectified_name(colour))
    if (projection.width, projection.height) != image.size:
        raise InputError(
            f"{where}: the image is {image.size[0]}x{image.size[1]}, but its CameraInfo is for "
            f"{projection.width}x{projection.height}; give --colour-intrinsics FX,FY,CX,CY"
        )
    depth_camera = None if is_cloud else _depth_camera(survey, robot, sensor)
    T_colour_sensor, note = _extrinsics(survey, topic, sensor.frame_id, image.frame_id, options)
    depth_info_topic = None if is_cloud else robot.camera_info_topic
    return RobotStreams(robot, topic, colour, projection, T_colour_sensor, depth_camera, depth_info_topic, note)


def _robot_with_sensor(group: LogGroup, samples: dict[str, TopicSample], options: StreamOptions) -> RobotConfig:
    """The robot with the topics that a run would use."""
    robot = group.blank_robot()
    name = options.sensor_topic
    if name is not None:
        if name not in samples or not (samples[name].kind in CLOUDS or samples[name].is_depth):
            usable = ", ".join(repr(topic) for topic, sample in samples.items() if sample.is_sensor)
            raise InputError(
                f"{group.paths}: topic '{name}' holds no depth images or clouds; there are {usable or 'none'}"
            )
        is_cloud = samples[name].kind in CLOUDS
        robot = dataclasses.replace(
            robot, cloud_topic=name if is_cloud else None, depth_topic=None if is_cloud else name
        )
    problems: list[str] = []
    found = find_topics_of_one(robot, group, problems)
    if found.depth_topic is None and found.cloud_topic is None:
        raise ConfigError(f"{problems[0]}; --sensor-topic names one")
    return found


def _colour_topic(group: LogGroup, samples: dict[str, TopicSample], sensor_topic: str, options: StreamOptions) -> str:
    """Topic of the colour images: the named one, else the one that is nearest to the sensor by name."""
    images = {topic: sample for topic, sample in samples.items() if sample.kind in IMAGES and topic != sensor_topic}
    usable = [topic for topic, sample in images.items() if sample.encoding in COLOR_IMAGE_ENCODINGS]
    name = options.colour_topic
    if name is not None:
        if name not in usable:
            raise InputError(
                f"{group.paths}: topic '{name}' holds no colour images; there are "
                f"{', '.join(map(repr, usable)) or 'none'}"
            )
        return name
    colours = [t for t in usable if images[t].has_colors and not (images[t].is_label or images[t].is_confidence)]
    if not colours:
        raise InputError(
            f"{group.paths}: robot '{group.robot_id}' has no colour images to label "
            f"(image topics: {', '.join(map(repr, images)) or 'none'})"
        )
    nearest = nearest_topics(colours, sensor_topic)
    same_frame = [topic for topic in nearest if images[topic].frame_id == samples[sensor_topic].frame_id]
    nearest = same_frame or nearest
    # A raw stream is preferred to compressed ones of the same images.
    raw = [topic for topic in nearest if not any(topic.startswith(f"{other}/") for other in nearest)]
    if len(raw) > 1:
        lines = "".join(f"\n    --colour-topic {topic}" for topic in raw)
        raise ConfigError(f"{group.paths}: robot '{group.robot_id}' has {len(raw)} colour topics; give one of:{lines}")
    return raw[0]


def _camera_info_topic(group: LogGroup, colour: str) -> str | None:
    """CameraInfo topic of the colour camera, which is beside its images (image_transport); None without one."""
    folder = colour.removesuffix("/compressed").rsplit("/", 1)[0]
    return next((info for info in group.topics_of((Kind.CAMERA_INFO,)) if info.rsplit("/", 1)[0] == folder), None)


def _calibration(
    survey: Survey, info_topic: str | None, image: TopicSample, options: StreamOptions
) -> Calibration | None:
    """Calibration of the colour camera; None without one."""
    if options.colour_intrinsics is not None:
        fx, fy, cx, cy = options.colour_intrinsics
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return Calibration(0, image.frame_id, *image.size, "plumb_bob", np.zeros(0), K, np.zeros((3, 4)))
    return None if info_topic is None else _camera_info(survey, info_topic)


def _camera_info(survey: Survey, topic: str) -> Calibration | None:
    """The first CameraInfo of a topic; None where none can be decoded."""
    message = first_whole_message(survey.log, topic, (Kind.CAMERA_INFO,))
    with suppress(DamagedMessageError):
        found = None if message is None else message.sensor_message()
        return found if isinstance(found, Calibration) else None
    return None


def _is_same_camera(a: Calibration | None, b: Calibration | None) -> bool:
    """True where two calibrations have the same image size, matrix and distortion."""
    if a is None or b is None or (a.width, a.height) != (b.width, b.height):
        return False
    of_a, of_b = (c.D if c.D.any() else np.zeros(1) for c in (a, b))
    return np.allclose(a.K, b.K, rtol=1e-3) and of_a.shape == of_b.shape and np.allclose(of_a, of_b)


def _depth_camera(survey: Survey, robot: RobotConfig, sample: TopicSample) -> CameraModel:
    """Camera of the depth images."""
    topic = robot.camera_info_topic
    calibration = None if topic is None else _camera_info(survey, topic)
    if calibration is None:
        raise InputError(
            f"{survey.path}: there is no CameraInfo for '{robot.depth_topic}', so that its points cannot be projected "
            "into the colour image; give --aligned where it is registered to the colour image"
        )
    where = f"{survey.path}: topic '{topic}'"
    camera = camera_model(calibration, where, is_rectified=has_rectified_name(str(robot.depth_topic)))
    if (camera.width, camera.height) != sample.size:
        raise InputError(
            f"{where}: is for images of {camera.width}x{camera.height} pixels, but those of '{robot.depth_topic}' have "
            f"{sample.size[0]}x{sample.size[1]}; name the right --sensor-topic"
        )
    return camera


def _extrinsics(
    survey: Survey, sensor_topic: str, sensor_frame: str, colour_frame: str, options: StreamOptions
) -> tuple[Float64Array, str]:
    """T_colour_sensor (4, 4), and where it comes from."""
    if options.T_sensor_colour is not None:
        return inverse(transform_of(options.T_sensor_colour)), "projected, extrinsics given"
    if sensor_frame == colour_frame:
        return np.eye(4), "projected, one frame"
    tf = tf_topics(survey.topics, sensor_topic)
    tree = FrameTree(_POSE_GAP_NS)
    load_static_transforms(tree, [survey.log], tf)
    note = "projected, extrinsics from static TF"
    if not tree.is_connected(colour_frame, sensor_frame):
        _read_moving(tree, [survey.log], moving_tf_names(tf), (colour_frame, sensor_frame))
        note = "projected, extrinsics from the first values of TF"
    found = None
    if tree.is_connected(colour_frame, sensor_frame):
        found = tree.T_a_b(colour_frame, sensor_frame, 0, hold=True)
    if found is None:
        raise InputError(
            f"{survey.path}: {tree.why_not_connected(colour_frame, sensor_frame)}; give --extrinsics "
            f"X,Y,Z,QX,QY,QZ,QW, the pose of the colour camera in the frame of '{sensor_topic}'"
        )
    return found, note


def _read_moving(tree: FrameTree, logs: Sequence[LogReader], topics: Sequence[str], link: tuple[str, str]) -> None:
    """Add moving transforms up to the first that joins two frames."""
    streams = (log.messages(topics) for log in logs)
    for message in heapq.merge(*streams, key=lambda message: message.log_time_ns):
        with suppress(DamagedMessageError):
            found = message.sensor_message()
            if isinstance(found, Transforms):
                tree.add_transforms(found, is_static=False)
        if tree.is_connected(*link) and tree.T_a_b(*link, 0, hold=True) is not None:
            return
