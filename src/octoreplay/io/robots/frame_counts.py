"""Counts of a robot's messages before and beside its frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.io.containers.log_reader import LogReader
from octoreplay.io.robots.pose_source import PoseSource
from octoreplay.records import FrameCounts

_LEADING = {"no_pose": "without a pose", "no_label": "without labels", "undecodable": "that could not be read"}
"""Causes for which frames before the first mapped one are left out."""


class LeadingFrames:
    """Numbers of the frames before the first used one, by cause."""

    def __init__(self) -> None:
        self._numbers: Counter[str] = Counter()

    def note(self, counts: FrameCounts, outcome: str, stamp_ns: int) -> None:
        """Count a frame; with the first used one, which ``counts`` has already, describe those before it there."""
        if outcome in _LEADING and counts.used == 0:
            self._numbers[outcome] += 1
        elif outcome == "used" and counts.used == 1 and self._numbers:
            causes = ", ".join(f"{number:,} {_LEADING[cause]}" for cause, number in self._numbers.items())
            first = f"the first one that is mapped has the stamp {stamp_ns / 1e9:.3f} s"
            counts.first_missing["leading"] = f"{causes}; {first}"


def count_topics(
    counts: FrameCounts,
    robot: ResolvedRobot,
    logs: Sequence[LogReader],
    partner_topics: Sequence[str],
    poses: PoseSource,
) -> None:
    """Count the messages in the logs, topic by topic, and those that were read before the frames."""
    info_topic = robot.camera_info_topic
    path_topic = robot.pose_topic if poses.trajectory is not None and robot.pose_file is None else None
    topics = {robot.sensor_topic, *partner_topics, *poses.topics, *poses.static_outcomes}
    for topic in sorted(topics | {topic for topic in (info_topic, path_topic) if topic}):
        infos = [info for log in logs for info in log.topics if info.name == topic]
        counts.messages[topic] = {"in_log": sum(info.num_messages for info in infos), "read": 0}
    for topic, outcomes in poses.static_outcomes.items():
        for outcome, count in outcomes.items():
            counts.settle(topic, "read", count=count)
            counts.settle(topic, outcome, count=count)
    if info_topic and counts.messages[info_topic]["in_log"]:
        # The first one holds for the whole log.
        counts.settle(info_topic, "read")
        counts.settle(info_topic, "used")
    if path_topic is not None:
        num_paths = counts.messages[path_topic]["in_log"]
        counts.settle(path_topic, "read", count=num_paths)
        counts.settle(path_topic, "used")
        counts.settle(path_topic, "superseded", count=num_paths - 1)
