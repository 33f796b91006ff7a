"""Data sets that are logs: the robots are found by their sensor's topics."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from octoreplay.config.class_file import with_classes
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import first_whole_message
from octoreplay.io.containers.logs import open_log
from octoreplay.io.datasets.catalogue.data_set import ODOMETRY_FIRST, DataSet, Team, Work
from octoreplay.io.datasets.frames_folder import check_folder, robot_name
from octoreplay.io.messages.sensor_messages import Cloud, Kind, kind_of
from octoreplay.io.robots.trajectories import proposed_origin, read_rows
from octoreplay.records import ClassTable

_SUFFIXES = (".bag", ".mcap", ".db3")
_KINDS = {"cloud_topic": (Kind.CLOUD,), "depth_topic": (Kind.IMAGE, Kind.COMPRESSED_IMAGE)}


@dataclass(frozen=True, kw_only=True)
class Bags(DataSet):
    """A data set of logs.

    - ``topic`` is the pattern of the sensor's topic, of the kind ``role``; its group 'robot', if it has one, is the
      robot's name, else each log is a robot. ``example`` is such a topic.
    - ``camera_info`` is the camera's topic, with {robot} for the robot's name.
    - ``pose_file`` is the name of a robot's trajectory, anywhere in the folder; '' where the data set has no usable
      poses, for the reason ``no_poses``. ``T_body_sensor`` goes from the sensor to the frame of these poses. With
      ``is_utm`` their positions are UTM coordinates.
    - ``classes`` are the classes of the point field ``label_field``, which not every version of the data set has;
      ``added_labels`` are further labels of these classes.
    """

    topic: str
    example: str
    role: str = "cloud_topic"
    camera_info: str | None = None
    pose_file: str = ""
    pose_format: str | None = None
    no_poses: str = ""
    map_frame: str | None = None
    T_body_sensor: tuple[float, ...] | None = None
    is_utm: bool = False
    classes: str | None = None
    label_field: str | None = None
    added_labels: Mapping[int, str] = field(default_factory=lambda: MappingProxyType({}))

    def team(self, work: Work) -> Team:
        """Return the team of a folder with logs. Raises InputError where it holds other logs, or a trajectory lacks."""
        check_folder(work.folder)
        found = self._robots(work.folder)
        files = {name: self._trajectory(work, name) for name, _, _ in found}
        first = next(iter(files.values()))
        origin = proposed_origin(first, self.pose_format) if self.is_utm else None
        if self.pose_file:
            for path in files.values():
                read_rows(path, self.pose_format, origin)
        robots, missing = [], {}
        is_labelled = self.classes is not None and all(self._has_labels(logs[0], topic) for _, topic, logs in found)
        for name, topic, logs in found:
            robot_id = robot_name(None, Path(f"{name}.mcap"))
            robots.append(
                RobotConfig(
                    robot_id,
                    tuple(log.resolve() for log in logs),
                    **{self.role: topic},  # type: ignore[arg-type]  # a topic by the name of its field
                    camera_info_topic=self.camera_info and self.camera_info.format(robot=name),
                    label_field=self.label_field if is_labelled else None,
                    pose_file=files[name],
                    pose_format=self.pose_format,
                    pose_origin=origin,
                    map_frame=self.map_frame,
                    T_body_sensor=self.T_body_sensor,
                )
            )
            if self.no_poses:
                missing[robot_id] = (ODOMETRY_FIRST.format(reason=self.no_poses, file=files[name]),)
        return Team(tuple(robots), self._class_table(robots) if is_labelled else None, missing)

    def _class_table(self, robots: Sequence[RobotConfig]) -> ClassTable | None:
        """Classes of the labels."""
        table = None if self.classes is None else with_classes(RunConfig(tuple(robots)), self.classes).classes
        if table is None:
            return None
        added = {c.name: [raw for raw, name in self.added_labels.items() if name == c.name] for c in table.classes}
        classes = [dataclasses.replace(c, raw_labels=(*c.raw_labels, *added[c.name])) for c in table.classes]
        return dataclasses.replace(table, classes=tuple(classes))

    def _robots(self, folder: Path) -> list[tuple[str, str, list[Path]]]:
        """Name, sensor's topic and logs of each robot."""
        logs = logs_in(folder)
        if not logs:
            raise InputError(f"{folder}: no log found (.bag, .mcap, .db3); {self.title} has {self.holds}")
        robots: dict[str, tuple[str, list[Path]]] = {}
        others: list[str] = []
        for path in logs:
            with open_log(path) as log:
                names = [t.name for t in log.topics if kind_of(t.type_name) in _KINDS[self.role] and t.num_messages]
            for name in names:
                match = re.fullmatch(self.topic, name)
                if match is None:
                    others.append(f"'{name}'")
                    continue
                robot = match.groupdict().get("robot") or _stem(path)
                topic, of_robot = robots.setdefault(robot, (name, []))
                if topic == name:
                    of_robot.append(path)
        if not robots:
            raise InputError(
                f"{folder}: none of its {len(logs)} logs has a topic such as '{self.example}'; their topics of that "
                f"kind: {', '.join(sorted(set(others))[:6]) or 'none'}; {self.title} has {self.holds}"
            )
        return [(robot, topic, paths) for robot, (topic, paths) in sorted(robots.items())]

    def _trajectory(self, work: Work, robot: str) -> Path:
        """Trajectory of a robot: a file of the data set, or the place where the user stores the computed one."""
        if not self.pose_file:
            return work.output.resolve() / f"{robot_name(None, Path(f'{robot}.mcap'))}.tum"
        name = self.pose_file.format(robot=robot)
        found = sorted(work.folder.rglob(name))
        if not found:
            raise InputError(f"{work.folder}: '{name}' not found, the trajectory of '{robot}' in {self.title}")
        if len(found) > 1:
            raise InputError(
                f"{work.folder}: holds '{name}' {len(found)} times; give the folder of one recording with its poses"
            )
        return found[0].resolve()

    def _has_labels(self, path: Path, topic: str) -> bool:
        """True where the first cloud of a topic has the field of labels."""
        with open_log(path) as log:
            message = first_whole_message(log, topic, (Kind.CLOUD,))
            cloud = None if message is None else message.sensor_message()
        return isinstance(cloud, Cloud) and self.label_field in [field.name for field in cloud.fields]


def logs_in(folder: Path) -> list[Path]:
    """Return the logs below a folder: files, and the folders of rosbag2 in place of their files, sorted."""
    found = []
    for path, folders, files in os.walk(folder):
        if "metadata.yaml" in files:
            found.append(Path(path))
            folders.clear()
            continue
        found += [Path(path) / name for name in files if Path(name).suffix.lower() in _SUFFIXES]
    return sorted(found)


def _stem(path: Path) -> str:
    """Name of a log without its suffix."""
    return path.stem if path.suffix.lower() in _SUFFIXES else path.name
