"""Command that estimates the poses of a robot from its scans: odometry."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from octoreplay.commands.console import prints, terminal
from octoreplay.commands.exit_codes import EXIT_DATA_LOST
from octoreplay.commands.options import check_output, existing_path, force_option, log_place
from octoreplay.commands.progress import progress_bar
from octoreplay.commands.suggestions import Choice
from octoreplay.commands.team_options import is_team_file, save_team_file
from octoreplay.config.file_url import InputFile
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.time import TimeConfig
from octoreplay.errors import ConfigError, suggestion

if TYPE_CHECKING:
    from octoreplay.io.robots.log_groups import LogGroup
    from octoreplay.io.robots.survey import LogSurveys, TopicSample
    from octoreplay.odometry.estimate import OdometryResult

_SENSORS = ("lidar", "rgbd", "depth")


@click.command(short_help="Estimate a robot's poses from its clouds or depth images.")
@click.argument("inputs", nargs=-1, required=True, type=log_place, metavar="LOG... | TEAM.yaml")
@click.option("-o", "--output", type=existing_path, required=True, metavar="LOG.tum",
              help="trajectory file to write, for pose_file in the team file")  # fmt: skip
@click.option("--save-team", type=existing_path, metavar="TEAM.yaml",
              help="write a team file with the robot, its topics and the trajectory")  # fmt: skip
@click.option("--robot", "robot_id", metavar="ID", help="robot, where the logs or the team file have several")
@click.option("--sensor", type=Choice(_SENSORS), help="sensor to use  [default: the first of these that the log has]")
@click.option("--topic", metavar="NAME", help="topic of the clouds, scans or depth images")
@click.option(
    "--color-topic", metavar="NAME", help="topic of the colour images that are registered to the depth images"
)
@click.option("--frame", metavar="NAME", help="frame of the robot that the poses describe  [default: the sensor's]")
@click.option("--guess", metavar="TOPIC|none",
              help="odometry or IMU for the expected motion  [default: the only odometry, else an IMU]")  # fmt: skip
@click.option("--max-range", type=click.FloatRange(min=0, min_open=True), metavar="METRES",
              help="leave out farther points  [default: 100 for clouds, 10 for depth images]")  # fmt: skip
@click.option("--voxel-size", type=click.FloatRange(min=0, min_open=True), metavar="METRES",
              help="voxels of the local map of clouds  [default: from the range of the first cloud]")  # fmt: skip
@click.option("--max-speed", type=float, default=40.0, show_default=True, help="largest speed of the sensor [m/s]")
@click.option("--max-acceleration", type=float, default=40.0, show_default=True,
              help="largest acceleration of the sensor [m/s^2]")  # fmt: skip
@click.option("--start", type=float, default=0.0, show_default=True, help="start, after the sensor's first stamp [s]")
@click.option("--duration", type=float, help="length of the part that is used [s]  [default: to the end]")
@click.option("--every", type=int, default=1, show_default=True, help="use every n-th scan")
@click.option("--clock", type=Choice(("header", "log")), default="header", show_default=True,
              help="source of stamps: message header, or log time")  # fmt: skip
@force_option
@prints
def odometry(
    inputs: tuple[InputFile, ...], output: Path, save_team: Path | None, robot_id: str | None, sensor: str | None,
    topic: str | None, color_topic: str | None, frame: str | None, guess: str | None, max_range: float | None,
    voxel_size: float | None, max_speed: float, max_acceleration: float, start: float, duration: float | None,
    every: int, clock: str,
) -> int:  # fmt: skip
    """Estimate the poses of a robot's sensor from its point clouds, laser scans or depth images.

    The trajectory file is a pose_file of the team file. Scans that cannot be registered have no pose in it: exit code
    3. Nothing is written where less than half of them can (exit code 1).
    """
    from octoreplay.io.robots.survey import LogSurveys
    from octoreplay.odometry.estimate import estimate
    from octoreplay.odometry.quality import Limits
    from octoreplay.odometry.source import SensorKind, find_source
    from octoreplay.report.odometry_tables import quality_table

    check_output(output, ".tum", inputs)
    if save_team is not None:
        check_output(save_team, ".yaml", inputs)
    limits = Limits(max_speed=max_speed, max_acceleration=max_acceleration)
    time = TimeConfig(clock=clock, start=start, duration=duration, every=every)
    here = terminal()
    with LogSurveys() as surveys:
        robot, group = _robot_and_logs(inputs, robot_id, surveys)
        robot = _with_topic(robot, topic, group.samples())
        source = find_source(
            robot, group, kind=None if sensor is None else SensorKind(sensor), color_topic=color_topic, guess=guess
        )
        num_messages = sum(t.num_messages for t in group.topics if t.name == source.robot.sensor_topic)
        with progress_bar("odometry") as update:
            result = estimate(
                source, time, [survey.log for survey in group.surveys], frame=frame, max_range=max_range,
                voxel_size=voxel_size, limits=limits,
                progress=lambda count: update(count / max(num_messages, 1), None, f"{count:,} scans"),
            )  # fmt: skip
    _write(result, output)
    here.show(quality_table(source, result))
    for sentence in _warnings(result):
        here.warn(sentence)
    here.line(f"wrote {output} ({len(result.stamps_ns):,} poses of '{result.frame}')")
    if save_team is not None:
        save_team_file(
            RunConfig(robots=(_with_trajectory(source.robot.to_config(), robot, result, output),)), save_team
        )
        here.line(f"wrote {save_team}")
    here.give(
        trajectory=output, team_file=save_team, sensor=source.kind, topic=source.robot.sensor_topic,
        color_topic=source.color_topic, guess=result.imu_topic if source.wheels is None else source.wheels.pose_topic,
        frame=result.frame, map_begins_at=result.body_frame, is_level=result.is_level, quality=_content(result),
    )  # fmt: skip
    is_whole = result.quality.num_registered == result.quality.num_scans and not result.counts.lost_data
    return 0 if is_whole else EXIT_DATA_LOST


def _robot_and_logs(
    inputs: tuple[InputFile, ...], robot_id: str | None, surveys: LogSurveys
) -> tuple[RobotConfig, LogGroup]:
    """The robot, with what a team file sets, and its logs. Raises ConfigError for an unknown or unnamed robot."""
    from octoreplay.config.team_file import load_team_file
    from octoreplay.io.robots.log_groups import group_of, groups_in

    if is_team_file(inputs):
        if len(inputs) > 1:
            raise click.UsageError("name one team file or the logs of a robot, not both")
        robots = {robot.robot_id: robot for robot in load_team_file(inputs[0]).robots}
        robot = robots[_only(list(robots), robot_id, inputs)]
        return robot, group_of(robot, tuple(surveys.of(path) for path in robot.logs))
    found = [surveys.of(path) for path in inputs]
    if len(found) > 1 and not any(survey.robots for survey in found):
        # Several files are parts of one robot's recording.
        robot = RobotConfig(robot_id or inputs[0].stem, inputs)
        return robot, group_of(robot, tuple(found))
    groups = {group.robot_id: group for group in groups_in(found)}
    group = groups[_only(list(groups), robot_id, inputs)] if len(groups) > 1 else next(iter(groups.values()))
    robot = dataclasses.replace(group.blank_robot(), robot_id=robot_id or group.robot_id)
    return robot, group


def _only(known: list[str], robot_id: str | None, inputs: Sequence[InputFile]) -> str:
    """The named robot, or the only one."""
    if robot_id is None and len(known) == 1:
        return known[0]
    if robot_id not in known:
        wrong = "name a robot with --robot" if robot_id is None else f"there is no robot '{robot_id}'"
        near = "" if robot_id is None else suggestion(robot_id, known)
        raise ConfigError(f"{inputs[0]}: {wrong}; the robots are {', '.join(known)}{near}")
    return robot_id


def _with_topic(robot: RobotConfig, topic: str | None, samples: Mapping[str, TopicSample]) -> RobotConfig:
    """The robot with a sensor topic, by the type of its messages."""
    if topic is None:
        return robot
    sample = samples.get(topic)
    if sample is None or not (sample.is_sensor or sample.kind in ("image", "compressed image")):
        sensors = [name for name, found in samples.items() if found.is_sensor]
        offer = f"; sensor topics: {', '.join(sensors)}" if sensors else ""
        raise ConfigError(f"--topic: '{topic}' holds no clouds, scans or images{offer}{suggestion(topic, sensors)}")
    if sample.kind in ("point cloud", "laser scan"):
        return dataclasses.replace(robot, depth_topic=None, cloud_topic=topic)
    return dataclasses.replace(robot, depth_topic=topic, cloud_topic=None)


def _write(result: OdometryResult, output: Path) -> None:
    """Write the trajectory with comments on its frames."""
    from octoreplay.io.datasets.pose_files import write_tum

    write_tum(
        output, result.stamps_ns, result.poses,
        comments=(
            f"poses of '{result.frame}' by octoreplay odometry",
            f"the map's origin is '{result.body_frame}' at the first scan",
        ),
    )  # fmt: skip


def _with_trajectory(found: RobotConfig, given: RobotConfig, result: OdometryResult, output: Path) -> RobotConfig:
    """The robot of a team file with the trajectory; labels are looked for again."""
    from octoreplay.transforms import numbers_of

    is_of_sensor = result.frame == result.sensor_frame
    mount = None if is_of_sensor else numbers_of(result.T_frame_sensor)
    return dataclasses.replace(
        given, depth_topic=found.depth_topic, cloud_topic=found.cloud_topic, camera_info_topic=found.camera_info_topic,
        sensor_frame=found.sensor_frame, pose=None, pose_topic=None, pose_times=None, pose_file=output.resolve(),
        T_body_sensor=mount,
    )  # fmt: skip


def _warnings(result: OdometryResult) -> Iterator[str]:
    """Sentences on scans without a pose, and on messages that could not be read."""
    quality, counts = result.quality, result.counts
    lost = quality.num_scans - quality.num_registered
    if lost:
        spans = [f"{first / 1e9:.3f} s to {last / 1e9:.3f} s" for first, last in quality.lost_spans[:3]]
        more = ", ..." if len(quality.lost_spans) > 3 else ""
        yield (
            f"{lost:,} of {quality.num_scans:,} scans have no pose (stamps {', '.join(spans)}{more}): "
            f"{quality.num_low_overlap:,} share too few points with earlier ones, {quality.num_unconstrained:,} see a "
            f"scene that leaves a direction of motion open, {quality.num_jumps:,} are beyond --max-speed or "
            f"--max-acceleration"
        )
    if quality.num_breaks:
        yield (
            f"the local map began again {quality.num_breaks:,} times; poses before and after such a break are joined "
            f"by the expected motion alone, so that the map of a run may be doubled"
        )
    for topic, frame in result.unjoined_imus.items():
        yield f"the IMU '{topic}' was not used: no fixed transform in TF joins its frame '{frame}' to the sensor"
    if result.num_unusable_imu:
        yield f"{result.num_unusable_imu:,} messages of '{result.imu_topic}' could not be used"
    if counts.no_label:
        yield f"{counts.no_label:,} depth images without a colour image within --pair-tolerance were left out"
    if counts.undecodable:
        yield f"{counts.undecodable:,} messages of '{counts.sensor_topic}' could not be read"
    if counts.late:
        yield f"{counts.late:,} messages of '{counts.sensor_topic}' were more than a second late and were left out"
    yield from counts.truncated_files


def _content(result: OdometryResult) -> dict[str, object]:
    """Quality for the JSON document."""
    quality = result.quality
    return {
        "num_scans": quality.num_scans,
        "num_registered": quality.num_registered,
        "registered_share": quality.registered_share,
        "num_low_overlap": quality.num_low_overlap,
        "num_unconstrained": quality.num_unconstrained,
        "num_jumps": quality.num_jumps,
        "num_breaks": quality.num_breaks,
        "num_by_wheels": quality.num_by_wheels,
        "num_by_imu": quality.num_by_imu,
        "median_overlap": quality.median_overlap,
        "least_overlap": quality.least_overlap,
        "median_residual": quality.median_residual,
        "largest_residual": quality.largest_residual,
        "length": quality.length,
        "lost_spans_ns": quality.lost_spans,
    }
