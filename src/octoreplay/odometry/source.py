"""Choice of the sensor, the colour camera, the wheel odometry and the IMUs that a robot's logs offer."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from enum import StrEnum

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.robot import RobotConfig
from octoreplay.errors import ConfigError, InputError, OctoreplayError, suggestion
from octoreplay.io.messages.sensor_messages import Kind
from octoreplay.io.robots.log_groups import LogGroup
from octoreplay.io.robots.topics import find_topics_of_one, without_packets

_ORIGIN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)

NO_GUESS = "none"
"""Name of the initial guess that uses the last motion alone."""


class SensorKind(StrEnum):
    """Measurements that odometry can use."""

    LIDAR = "lidar"
    RGBD = "rgbd"
    DEPTH = "depth"


@dataclass(frozen=True)
class OdometrySource:
    """Sensor of a robot for odometry.

    Attributes
    ----------
    kind : SensorKind
    robot : ResolvedRobot
        The robot with its sensor topic, at rest in the origin.
    color_topic : str or None
        Colour images that are registered to the depth images.
    wheels : ResolvedRobot or None
        The robot with the wheel odometry that gives the initial guess.
    imus : tuple of str
        Topics of IMUs, of which the first that TF joins to the sensor is used; empty with wheel odometry.
    needs_imu : bool
        True where the IMU was named, so that it must be joined.
    """

    kind: SensorKind
    robot: ResolvedRobot
    color_topic: str | None = None
    wheels: ResolvedRobot | None = None
    imus: tuple[str, ...] = ()
    needs_imu: bool = False


def find_source(
    robot: RobotConfig,
    group: LogGroup,
    *,
    kind: SensorKind | None = None,
    color_topic: str | None = None,
    guess: str | None = None,
) -> OdometrySource:
    """Return the source of a robot's odometry: the kind that is given, else LiDAR, depth and colour, or depth alone.

    Clouds in the frame of a depth camera are taken for clouds of this camera. ``guess`` names a topic of wheel
    odometry or of an IMU, or 'none'; by default the only odometry topic whose frames TF joins to the sensor is used,
    else an IMU. Raises ConfigError where several topics fit, InputError where a topic is missing or the logs have no
    such sensor.
    """
    if not (robot.depth_topic or robot.cloud_topic):
        robot = dataclasses.replace(robot, cloud_topic=_cloud_topic(group, kind))
    still = dataclasses.replace(
        robot.with_poses(pose=_ORIGIN), T_body_sensor=None, label_topic="", label_field=None, confidence_topic=None,
        body_box=None, T_team_map=None, T_team_map_sigma=None, T_team_map_from=None,
    )  # fmt: skip
    resolved = ResolvedRobot.from_config(find_topics_of_one(still, group), None)
    imus = [topic for topic in group.topics_of((Kind.IMU,)) if guess in (None, topic)]
    needs_imu = guess is not None and bool(imus)
    wheels = None if needs_imu else _wheels(robot, resolved, group, guess)
    inertial = () if wheels is not None else tuple(imus)
    if resolved.cloud_topic is not None:
        if kind not in (None, SensorKind.LIDAR):
            raise group.no_sensor(f"there is no depth image for '--sensor {kind}'")
        return OdometrySource(SensorKind.LIDAR, resolved, None, wheels, inertial, needs_imu)
    color = None if kind is SensorKind.DEPTH else color_topic or _color_topic(resolved, group)
    if kind is SensorKind.RGBD and color is None:
        raise InputError(
            f"{group.paths}: no colour image has the size and the frame of '{resolved.depth_topic}'; name one that is "
            f"registered to it with --color-topic, or use --sensor depth"
        )
    found = SensorKind.DEPTH if color is None else SensorKind.RGBD
    return OdometrySource(found, resolved, color, wheels, inertial, needs_imu)


def _cloud_topic(group: LogGroup, kind: SensorKind | None) -> str | None:
    """Topic of clouds or scans; None where the sensor that a map is made from by default is the right one."""
    samples = group.samples()
    depth_frames = {sample.frame_id for sample in samples.values() if sample.is_depth}
    clouds = [topic for topic, sample in samples.items() if sample.kind is Kind.CLOUD]
    if kind is None:
        clouds = [topic for topic in clouds if samples[topic].frame_id not in depth_frames]
    clouds = without_packets(clouds, samples)
    scans = [topic for topic, sample in samples.items() if sample.kind is Kind.SCAN]
    if kind is SensorKind.LIDAR and not clouds + scans:
        raise group.no_sensor("no point cloud or laser scan for '--sensor lidar'")
    if kind in (None, SensorKind.LIDAR) and (len(clouds) == 1 or (kind and not clouds and len(scans) == 1)):
        return (clouds or scans)[0]
    if kind is SensorKind.LIDAR:
        lines = "".join(f"\n    --topic {topic}" for topic in clouds or scans)
        raise ConfigError(f"{group.paths}: has several clouds; name one of them:{lines}")
    return None


def _color_topic(robot: ResolvedRobot, group: LogGroup) -> str | None:
    """Colour image with the size and the frame of the depth image; None where there is none or several."""
    samples = group.samples()
    depth = samples.get(str(robot.depth_topic))
    found = [
        topic
        for topic, sample in samples.items()
        if depth is not None and sample.is_color and not sample.is_label
        and (sample.size, sample.frame_id) == (depth.size, depth.frame_id)
    ]  # fmt: skip
    return found[0] if len(found) == 1 else None


def _wheels(robot: RobotConfig, resolved: ResolvedRobot, group: LogGroup, guess: str | None) -> ResolvedRobot | None:
    """The robot with wheel odometry as its poses; None without a usable topic."""
    if guess == NO_GUESS:
        return None
    topics = group.topics_of((Kind.ODOMETRY,))
    if guess is not None and guess not in topics:
        known = [*topics, *group.topics_of((Kind.IMU,))]
        raise InputError(f"{group.paths}: '{guess}' is no topic of odometry or of an IMU{suggestion(guess, known)}")
    if guess is None and len(topics) != 1:
        return None
    moving = dataclasses.replace(
        resolved.to_config(), pose=None, pose_topic=guess or topics[0], T_body_sensor=robot.T_body_sensor
    )
    try:
        found = find_topics_of_one(moving, group)
    except OctoreplayError:
        if guess is not None:
            raise
        return None
    # The correction of a localisation jumps, so the poses stay in the frame of the odometry.
    return ResolvedRobot.from_config(dataclasses.replace(found, map_frame=None), None)
