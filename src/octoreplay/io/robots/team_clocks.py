"""Clocks of a team: the spans of the robots' logs on one clock, and signs that their clocks differ."""

from __future__ import annotations

import datetime
import statistics
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice

from octoreplay.config.robot import RobotConfig
from octoreplay.errors import InputError
from octoreplay.io.messages.sensor_messages import Kind, kind_of
from octoreplay.io.robots.log_groups import LogGroup

# Earlier stamps are not dates but times since some start of a clock.
_YEAR_2000_NS = 946_684_800_000_000_000
# Clocks of a team that differ by more than this are reported.
_LARGEST_DIFFERENCE_NS = 60_000_000_000
# Difference in length up to which two logs are taken as recordings of the same time.
_SAME_LENGTH_NS = 10_000_000_000
# Delay of a message that is recorded as it is sent.
_LIVE_DELAY_NS = 10_000_000_000
# Number of first messages whose delays are compared.
_NUM_FIRST = 8
_STAMPED_KINDS = (
    Kind.IMAGE, Kind.COMPRESSED_IMAGE, Kind.CLOUD, Kind.SCAN, Kind.ODOMETRY, Kind.POSE, Kind.PATH
)  # fmt: skip


@dataclass(frozen=True)
class RobotClock:
    """Clock of one robot's stamps.

    ``log_span_ns`` holds the log times of the first and the last message of any topic. ``delay_ns`` is the stamp less
    the log time of the sensor's first messages (None: the stamps are log times, or unknown). ``offset_ns`` is the
    robot's clock offset, which these two do not contain.
    """

    log_span_ns: tuple[int, int]
    delay_ns: int | None
    offset_ns: int

    @property
    def stamp_span_ns(self) -> tuple[int, int]:
        """Stamps of the first and the last message, estimated from the log times and the delay."""
        start, end = self.log_span_ns
        return start + (self.delay_ns or 0), end + (self.delay_ns or 0)

    @property
    def span_ns(self) -> tuple[int, int]:
        """The same stamps with the clock offset, on the team's clock."""
        start, end = self.stamp_span_ns
        return start + self.offset_ns, end + self.offset_ns

    @property
    def has_dates(self) -> bool:
        """True where the stamps are dates, not times since some start."""
        return self.span_ns[0] >= _YEAR_2000_NS


def clock_of(robot: RobotConfig, group: LogGroup, *, use_log_time: bool) -> RobotClock | None:
    """Return the clock of a robot's stamps; None without messages."""
    if group.log_span_ns is None:
        return None
    return RobotClock(
        group.log_span_ns, None if use_log_time else _delay(robot, group), round(robot.clock_offset * 1e9)
    )


def clock_warning(clocks: Mapping[str, RobotClock]) -> str | None:
    """Return a sentence on robots whose clocks differ, by robot_id; None where nothing tells them apart.

    The first sign that is found is reported:

    1. The stamps of some robots are dates, those of others are times since some start.
    2. Some robots share no time with any other, or the team falls into groups that share no time.
    3. The stamps of one robot differ from the times of recording by a minute more than those of another, which was
       recorded at the same time.
    4. Two logs of the same length within 10 s begin and end more than a minute apart.
    """
    if len(clocks) < 2:
        return None
    signs = (_different_epochs, _no_common_time, _different_delays, _shifted_spans)
    return next((sentence for sign in signs if (sentence := sign(clocks)) is not None), None)


def _delay(robot: RobotConfig, group: LogGroup) -> int | None:
    """Median of stamp less log time of the first messages of a robot's sensor, or of its poses without a sensor."""
    topic = robot.depth_topic or robot.cloud_topic or robot.pose_topic
    delays = []
    for survey in group.surveys if topic else ():
        for message in islice(survey.log.messages((str(topic),)), _NUM_FIRST):
            if kind_of(message.type_name) not in _STAMPED_KINDS:
                continue
            with suppress(InputError):
                stamp_ns = message.header_stamp_ns()
                # A stamp of 0 was never set.
                if stamp_ns != 0 or message.log_time_ns == 0:
                    delays.append(stamp_ns - message.log_time_ns)
        if delays:
            return statistics.median_low(delays)
    return None


def _different_epochs(clocks: Mapping[str, RobotClock]) -> str | None:
    """Sign 1."""
    dated = [robot_id for robot_id, clock in clocks.items() if clock.has_dates]
    others = [robot_id for robot_id in clocks if robot_id not in dated]
    if not dated or not others:
        return None
    return (
        f"the clocks of the robots have different epochs: the stamps of {_spans(dated, clocks)} are dates, those of "
        f"{_spans(others, clocks)} are times since some start; give clock_offset in the team file, or "
        f"use --clock log if the logs were recorded at the same time"
    )


def _no_common_time(clocks: Mapping[str, RobotClock]) -> str | None:
    """Sign 2."""
    groups: list[list[str]] = []
    end_ns = 0
    for robot_id in sorted(clocks, key=lambda name: clocks[name].span_ns):
        start, end = clocks[robot_id].span_ns
        if groups and start <= end_ns:
            groups[-1].append(robot_id)
            end_ns = max(end_ns, end)
        else:
            groups.append([robot_id])
            end_ns = end
    if len(groups) == 1:
        return None
    parts = [_spans(group, clocks) for group in groups]
    return (
        f"the logs share no time: {'; '.join(parts)}; if they were recorded at the same time, give clock_offset in the"
        " team file"
    )


def _different_delays(clocks: Mapping[str, RobotClock]) -> str | None:
    """Sign 3."""
    delays = {name: clock.delay_ns + clock.offset_ns for name, clock in clocks.items() if clock.delay_ns is not None}
    live = [name for name, delay in delays.items() if abs(delay) <= _LIVE_DELAY_NS]
    # A log that was recorded again later keeps its stamps, so only logs of the same time of recording are compared.
    parts = [
        f"{name} ({delay / 1e9:+.1f} s)"
        for name, delay in delays.items()
        if abs(delay) > _LARGEST_DIFFERENCE_NS + _LIVE_DELAY_NS
        and any(_share_time(clocks[name].log_span_ns, clocks[other].log_span_ns) for other in live)
    ]
    if not parts:
        return None
    return (
        f"the clocks of the robots differ: the stamps of {_listed(parts)} differ from the times of recording, those of "
        f"{_listed(live)} do not; give clock_offset in the team file, or use --clock log"
    )


def _share_time(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """True where two spans overlap."""
    return one[0] <= other[1] and other[0] <= one[1]


def _shifted_spans(clocks: Mapping[str, RobotClock]) -> str | None:
    """Sign 4."""
    shifted = {name: _shifted_from(name, clocks) for name in clocks}
    # One clock that is off differs from all others, and each of them only from this one.
    reference = min((name for name in clocks if shifted[name]), key=lambda name: len(shifted[name]), default=None)
    if reference is None:
        return None
    parts = []
    for robot_id, shifts in shifted[reference].items():
        side = "after" if shifts[0] > 0 else "before"
        first, last = (abs(shift) / 1e9 for shift in shifts)
        parts.append(f"the log of {robot_id} begins {first:.1f} s and ends {last:.1f} s {side} that of {reference}")
    return (
        f"the clocks of the robots may differ: {_listed(parts)}; if they were recorded at the same time, give "
        f"clock_offset in the team file"
    )


def _shifted_from(reference: str, clocks: Mapping[str, RobotClock]) -> dict[str, tuple[int, int]]:
    """Robots whose logs have the length of a robot's log and begin and end elsewhere, with both differences [ns]."""
    start, end = clocks[reference].span_ns
    shifts = {name: (clock.span_ns[0] - start, clock.span_ns[1] - end) for name, clock in clocks.items()}
    return {
        name: (first, last)
        for name, (first, last) in shifts.items()
        if abs(last - first) <= _SAME_LENGTH_NS and min(abs(first), abs(last)) > _LARGEST_DIFFERENCE_NS
    }


def _spans(names: list[str], clocks: Mapping[str, RobotClock]) -> str:
    """Names of robots with the common span of their logs."""
    start = min(clocks[name].span_ns[0] for name in names)
    end = max(clocks[name].span_ns[1] for name in names)
    return f"{_listed(names)} ({instant(start)}, {(end - start) / 1e9:.1f} s)"


def _listed(parts: list[str]) -> str:
    """Texts joined by commas and 'and'."""
    return " and ".join([*[", ".join(parts[:-1])][: len(parts) > 1], parts[-1]])


def instant(stamp_ns: int) -> str:
    """Return a stamp as an RFC 3339 date, or in seconds where it is not a date."""
    if stamp_ns < _YEAR_2000_NS:
        return f"{stamp_ns / 1e9:.3f} s"
    return datetime.datetime.fromtimestamp(stamp_ns // 1_000_000_000, datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
