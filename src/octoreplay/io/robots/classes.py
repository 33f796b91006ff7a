"""Class table of a team from the LabelInfo messages in its logs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from octoreplay.config.class_tables.label_rows import UNLABELLED_NAMES
from octoreplay.config.robot import RobotConfig
from octoreplay.errors import ConfigError
from octoreplay.io.containers.log_reader import first_whole_message
from octoreplay.io.messages.sensor_messages import Kind, LabelNames
from octoreplay.io.robots.log_groups import LogGroup
from octoreplay.io.sensors.labels import OCCUPIED, class_table_from_names
from octoreplay.records import ClassTable


class LabelledSensor(NamedTuple):
    """One sensor of a robot, as the robot with this sensor alone; ``is_labelled`` where its labels are used."""

    robot: RobotConfig
    group: LogGroup
    is_labelled: bool


def labelled_sensors(robots: Sequence[RobotConfig], groups: Sequence[LogGroup]) -> list[LabelledSensor]:
    """Return the sensors of a team's robots, in the order of the robots."""
    views = [(view, group) for robot, group in zip(robots, groups, strict=True) for view in robot.views]
    return [LabelledSensor(view, group, _has_labels(view, group)) for view, group in views]


def team_class_table(sensors: Sequence[LabelledSensor]) -> ClassTable:
    """Return the class table of the LabelInfo of the sensors with labels, or 'occupied' where none has labels.

    Raises ConfigError where there are labels but no LabelInfo.
    """
    labelled = [sensor for sensor in sensors if sensor.is_labelled]
    if not labelled:
        return OCCUPIED
    names: dict[str, Mapping[int, str]] = {}
    for robot, group, _ in labelled:
        found = _label_info(robot, group)
        if found is not None:
            names[robot.robot_id] = found.names
    if not names:
        topic = str(labelled[0].robot.label_topic or labelled[0].robot.cloud_topic)
        raise ConfigError(
            f"no LabelInfo names the labels on '{topic}'; give 'classes' in the team file, "
            f"such as classes: [{{name: ground, raw_labels: [1]}}, {{name: tree, raw_labels: [2]}}], or --classes"
        )
    return class_table_from_names(names)


def check_labelled(classes: ClassTable, sensors: Sequence[LabelledSensor]) -> None:
    """Raise ConfigError where only some sensors have labels and there is more than one class."""
    without = next((sensor.robot for sensor in sensors if not sensor.is_labelled), None)
    if classes.num_classes > 1 and without is not None:
        has_others = [sensor.robot.robot_id for sensor in sensors].count(without.robot_id) > 1
        on_topic = f" on '{without.depth_topic or without.cloud_topic}'" if has_others else ""
        raise ConfigError(
            f"robot '{without.robot_id}' has no labels{on_topic}, but the team has {classes.num_classes} classes; name "
            f"its label_topic, or map all robots without labels (label_topic: '' and one class)"
        )


def _has_labels(robot: RobotConfig, group: LogGroup) -> bool:
    """True where the logs of a robot with one sensor give labels that are used."""
    if robot.cloud_topic is not None and robot.label_topic is None:
        if robot.label_field is not None:
            return robot.label_field != ""
        sample = group.samples().get(robot.cloud_topic)
        return sample is not None and sample.has_labels
    return bool(robot.label_topic)


def label_info_warnings(classes: ClassTable, sensors: Sequence[LabelledSensor]) -> tuple[str, ...]:
    """Return a sentence for each sensor with a LabelInfo that a given class table contradicts."""
    found = (_contradiction(classes, robot, _label_info(robot, group)) for robot, group, is_used in sensors if is_used)
    return tuple(dict.fromkeys(sentence for sentence in found if sentence is not None))


def _contradiction(classes: ClassTable, robot: RobotConfig, info: LabelNames | None) -> str | None:
    """Sentence on raw labels that a class table gives to other classes than a LabelInfo; None without any.

    A class may be renamed or merged. A contradiction is a name of the one that has another raw label in the other.
    """
    if info is None:
        return None
    in_table = {raw: item.name for item in classes.classes for raw in item.raw_labels}
    in_log = {raw: name for raw, name in info.names.items() if name.strip().lower() not in UNLABELLED_NAMES}
    of_table, of_log = ({_plain(name) for name in names.values()} for names in (in_table, in_log))
    differing = [raw for raw in sorted(in_log) if raw in in_table and _plain(in_log[raw]) != _plain(in_table[raw])]
    shared = of_table & of_log
    clashing = [raw for raw in differing if {_plain(in_log[raw]), _plain(in_table[raw])} & shared]
    if not clashing and (shared or not differing):
        return None
    raw, *more = clashing or differing
    others = f", and {len(more)} more labels differ" if more else ""
    return (
        f"{robot.robot_id}: the class table contradicts the log's '{robot.label_info_topic}': raw label {raw} is "
        f"'{in_table[raw]}' in the table and '{in_log[raw]}' in the log{others}"
    )


def _plain(name: str) -> str:
    """A class name without differences of case, blanks, hyphens and underscores."""
    return re.sub(r"[\s_-]+", " ", name.strip().lower())


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
