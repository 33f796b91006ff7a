"""Class table of a team from the LabelInfo messages in its logs."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

from octoreplay.config.robot import RobotConfig
from octoreplay.errors import ConfigError
from octoreplay.io.containers.log_reader import first_whole_message
from octoreplay.io.messages.sensor_messages import Kind, LabelNames
from octoreplay.io.robots.log_groups import LogGroup
from octoreplay.io.sensors.labels import OCCUPIED, class_table_from_names
from octoreplay.records import ClassTable


def has_labels(robot: RobotConfig, group: LogGroup) -> bool:
    """True where the robot's logs give labels that are used."""
    if robot.cloud_topic is not None and robot.label_topic is None:
        if robot.label_field is not None:
            return robot.label_field != ""
        sample = group.samples().get(robot.cloud_topic)
        return sample is not None and sample.has_labels
    return bool(robot.label_topic)


def team_class_table(robots: Sequence[RobotConfig], groups: Sequence[LogGroup], labelled: Sequence[bool]) -> ClassTable:
    """Return the class table of the LabelInfo of the robots with labels, or 'occupied' where none has labels.

    Raises ConfigError where there are labels but no LabelInfo.
    """
    if not any(labelled):
        return OCCUPIED
    names: dict[str, Mapping[int, str]] = {}
    for robot, group in itertools.compress(zip(robots, groups, strict=True), labelled):
        found = _label_info(robot, group)
        if found is not None:
            names[robot.robot_id] = found.names
    if not names:
        topics = [str(robot.label_topic or robot.cloud_topic) for robot in itertools.compress(robots, labelled)]
        raise ConfigError(
            f"no LabelInfo names the labels on '{topics[0]}'; give 'classes' in the team file, "
            f"such as classes: [{{name: ground, raw_labels: [1]}}, {{name: tree, raw_labels: [2]}}], or --classes"
        )
    return class_table_from_names(names)


def check_labelled(classes: ClassTable, robots: Sequence[RobotConfig], labelled: Sequence[bool]) -> None:
    """Raise ConfigError where only some robots have labels and there is more than one class."""
    if classes.num_classes > 1 and not all(labelled):
        without = robots[labelled.index(False)].robot_id
        raise ConfigError(
            f"robot '{without}' has no labels, but the team has {classes.num_classes} classes; name its label_topic, "
            f"or map all robots without labels (label_topic: '' and one class)"
        )


def _label_info(robot: RobotConfig, group: LogGroup) -> LabelNames | None:
    """The robot's first LabelInfo message, anywhere in its logs."""
    if robot.label_info_topic is None:
        return None
    for survey in group.surveys:
        message = first_whole_message(survey.log, robot.label_info_topic, (Kind.LABEL_INFO,))
        found = None if message is None else message.sensor_message()
        if isinstance(found, LabelNames):
            return found
    return None
