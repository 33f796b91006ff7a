"""Logs grouped by robot: one robot per log, or several robots per log by namespace."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from octoreplay.config.file_url import InputFile
from octoreplay.config.robot import RobotConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.containers.log_reader import TopicInfo
from octoreplay.io.messages.decoders import ENCODINGS
from octoreplay.io.messages.sensor_messages import Kind, kind_of
from octoreplay.io.robots.survey import Survey, TopicSample

LABELLED_SUFFIX = ".labelled"
"""End of the stem of a log that 'octoreplay label' has written: its robot has the name that it had before."""

_DRIVERS = {
    "ouster_ros/msg/PacketMsg": "ouster-ros",
    "ouster_msgs/msg/PacketMsg": "ouster-ros",
    "ouster_sensor_msgs/msg/PacketMsg": "ouster-ros",
}
"""Drivers that turn the raw packets of a lidar into point clouds, by the type of the packets."""


@dataclass(frozen=True)
class LogGroup:
    """Logs of one robot.

    ``namespace`` is the owner of the robot's topics (``Survey.owners``) where a log holds several robots, else None.
    """

    robot_id: str
    surveys: tuple[Survey, ...]
    namespace: str | None

    def blank_robot(self) -> RobotConfig:
        """Return the robot with its logs alone, without topics and frames."""
        return RobotConfig(self.robot_id, tuple(survey.path for survey in self.surveys))

    @property
    def log_span_ns(self) -> tuple[int, int] | None:
        """Log times of the first and the last message, without the clock offset; None without messages."""
        starts = [survey.start_ns for survey in self.surveys if survey.start_ns is not None]
        ends = [survey.end_ns for survey in self.surveys if survey.end_ns is not None]
        return (min(starts), max(ends)) if starts and ends else None

    @property
    def paths(self) -> str:
        """Paths of the logs, as an error begins."""
        return ", ".join(str(survey.path) for survey in self.surveys)

    @property
    def topics(self) -> list[TopicInfo]:
        """Topics of all the logs, also those of other robots."""
        return [topic for survey in self.surveys for topic in survey.topics]

    def samples(self) -> dict[str, TopicSample]:
        """Return the robot's sensor topics, sorted by name, with the sample of each."""
        samples = {topic: sample for survey in reversed(self.surveys) for topic, sample in survey.samples.items()}
        return {topic: samples[topic] for topic in sorted(samples) if self._is_own(topic)}

    def topics_of(self, kinds: Collection[Kind]) -> list[str]:
        """Return the names of the robot's topics of some kinds with messages that can be decoded, sorted."""
        return sorted({topic.name for topic in _readable(self.topics, kinds) if self._is_own(topic.name)})

    def unowned_topics(self, kind: Kind) -> list[str]:
        """Return the names of topics of a kind that belong to none of the robots that share the logs, sorted."""
        names = [
            topic.name
            for survey in self.surveys
            for topic in _readable(survey.topics, (kind,))
            if topic.name not in survey.owners
        ]
        return sorted(set(names))

    def contents(self) -> str:
        """Return the types of the messages in the logs, as a clause of an error."""
        topics = [topic for topic in self.topics if topic.num_messages]
        if not topics:
            return "the log holds no messages"
        encodings = {topic.encoding for topic in topics}
        if encodings.isdisjoint(ENCODINGS):
            return f"its messages are encoded as {', '.join(sorted(encodings))}; {', '.join(ENCODINGS)} can be read"
        for topic in topics:
            if topic.type_name in _DRIVERS:
                return (
                    f"'{topic.name}' holds the raw packets of a lidar ({topic.type_name}); play the log into the "
                    f"driver {_DRIVERS[topic.type_name]}, and record its point clouds together with the other topics"
                )
        names = sorted({topic.type_name for topic in topics})
        return f"its messages are {', '.join(names[:8])}{', ...' if len(names) > 8 else ''}"

    def no_sensor(self, missing: str) -> InputError | ConfigError:
        """Return the error about a missing sensor: with the first cause where sensor topics cannot be decoded.

        It is a ConfigError where this cause is a missing package.
        """
        causes = {name: cause for s in reversed(self.surveys) for name, cause in s.unreadable.items()}
        names = sorted(name for name in causes if self._is_own(name))
        if not names:
            return InputError(f"{self.paths}: {missing}; {self.contents()}")
        cause = causes[names[0]]
        kind = ConfigError if isinstance(cause, ConfigError) else InputError
        listed = f"{', '.join(repr(name) for name in names[:8])}{', ...' if len(names) > 8 else ''}"
        return kind(f"{self.paths}: {missing}; no message of {listed} can be decoded: {cause}")

    def _is_own(self, topic: str) -> bool:
        """True where a topic belongs to the robot, or the robot has the logs to itself."""
        return self.namespace is None or any(s.owners.get(topic) == self.namespace for s in self.surveys)


def groups_in(surveys: Sequence[Survey]) -> list[LogGroup]:
    """Return the robots in some logs: by namespace where a log holds several, else one per file.

    Raises ConfigError without logs and where two files would give robots the same name.
    """
    if not surveys:
        raise ConfigError("no logs given")
    shared: dict[str, list[Survey]] = {}
    groups: list[LogGroup] = []
    names = _names_of_files([survey.path for survey in surveys if not survey.robots])
    for survey in surveys:
        namespaces = survey.robots
        for namespace in namespaces:
            shared.setdefault(namespace, []).append(survey)
        if not namespaces:
            groups.append(LogGroup(names[survey.path], (survey,), None))
    groups += [LogGroup(name, tuple(found), name) for name, found in shared.items()]
    return groups


def group_of(robot: RobotConfig, surveys: tuple[Survey, ...]) -> LogGroup:
    """Return the part of a configured robot's logs in which its missing topics are looked for.

    Raises ConfigError where the logs hold several robots and none of them has the configured one's id.
    """
    namespaces = set(itertools.chain(*(survey.robots for survey in surveys)))
    first = robot.views[0]
    named = first.depth_topic or first.cloud_topic
    owners = {topic: owner for survey in surveys for topic, owner in survey.owners.items()}
    if named and named not in owners:
        # The named sensor belongs to none of the robots, so the robot's other topics must be named too.
        return LogGroup(robot.robot_id, surveys, None)
    namespace = owners[named] if named else robot.robot_id
    if namespaces and namespace not in namespaces:
        raise ConfigError(
            f"robot '{robot.robot_id}': {surveys[0].path} holds the robots {', '.join(sorted(namespaces))}; "
            f"use one of these names as id, or give its depth_topic"
        )
    return LogGroup(robot.robot_id, surveys, namespace if namespaces else None)


def _names_of_files(paths: Sequence[InputFile]) -> dict[InputFile, str]:
    """Robot name for each file: its stem without '.labelled', or its folder's name where stems repeat."""
    for names in (
        [path.stem.removesuffix(LABELLED_SUFFIX) for path in paths],
        [path.resolve().parent.name for path in paths],
    ):
        if len(set(names)) == len(names) and all(names):
            return dict(zip(paths, names, strict=True))
    repeated = next(path for path in paths if [p.stem for p in paths].count(path.stem) > 1)
    raise ConfigError(f"{repeated}: two logs would both be robot '{repeated.stem}'; name the robots in a team file")


def _readable(topics: Collection[TopicInfo], kinds: Collection[Kind]) -> list[TopicInfo]:
    """Topics of some kinds with messages that can be decoded."""
    return [t for t in topics if kind_of(t.type_name) in kinds and t.num_messages > 0 and t.encoding in ENCODINGS]
