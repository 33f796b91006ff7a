"""Signs that the clocks of a team's robots differ."""

from __future__ import annotations

import pytest

from octoreplay.config.robot import RobotConfig
from octoreplay.errors import ConfigError
from octoreplay.io.robots.describe import describe
from octoreplay.io.robots.discover import discover, resolve
from octoreplay.io.robots.team_clocks import RobotClock, clock_warning, instant
from support.discovered_logs import DEPTH, run_of
from support.log_factory import SECOND, robot_entries, write_mcap

DATE = 1_700_000_000


def clock(start: float, length: float, *, delay: float | None = 0.0, offset: float = 0.0) -> RobotClock:
    """Clock of a robot whose log has a span [s] in log time."""
    span = (round(start * SECOND), round((start + length) * SECOND))
    return RobotClock(span, None if delay is None else round(delay * SECOND), round(offset * SECOND))


def test_a_stamp_is_a_date_or_a_time():
    assert instant(DATE * SECOND) == "2023-11-14T22:13:20Z"
    assert instant(12_500_000_000) == "12.500 s"


@pytest.mark.parametrize(
    "clocks",
    [
        {"a": clock(DATE, 60)},
        # Robots that join late, leave early or meet one after the other.
        {"a": clock(DATE, 600), "b": clock(DATE + 300, 300)},
        {"a": clock(DATE, 600), "b": clock(DATE + 100, 60)},
        {"a": clock(0, 60), "b": clock(50, 200), "c": clock(240, 300)},
        {"a": clock(0, 60), "b": clock(59, 60)},
        # Simulation time, and logs that were recorded again on another day.
        {"a": clock(DATE, 60, delay=-DATE), "b": clock(DATE + 30, 60, delay=-DATE - 25)},
        {"a": clock(DATE, 60), "b": clock(DATE + 9e5, 60, delay=-9e5)},
        # A clock that is 300 s ahead, corrected.
        {"a": clock(DATE, 60), "b": clock(DATE, 60, delay=300, offset=-300)},
    ],
)
def test_clocks_that_may_agree(clocks):
    assert clock_warning(clocks) is None


@pytest.mark.parametrize(
    ("clocks", "sentence"),
    [
        (
            {"a": clock(1_326_898_728, 17.7), "b": clock(0, 60), "c": clock(1, 60)},
            (
                "the clocks of the robots have different epochs: the stamps of a (2012-01-18T14:58:48Z, 17.7 s) are"
                " dates, those of b and c (0.000 s, 61.0 s) are times since some start; give clock_offset in the "
                "team file, or use --clock log if the logs were recorded at the same time"
            ),
        ),
        (
            {"a": clock(DATE, 60), "b": clock(DATE, 60, delay=-DATE)},
            (
                "the clocks of the robots have different epochs: the stamps of a (2023-11-14T22:13:20Z, 60.0 s) are"
                " dates, those of b (0.000 s, 60.0 s) are times since some start; give clock_offset in the team file,"
                " or use --clock log if the logs were recorded at the same time"
            ),
        ),
        (
            {"a": clock(100, 60), "b": clock(0, 60), "c": clock(159, 60)},
            (
                "the logs share no time: b (0.000 s, 60.0 s); a and c (100.000 s, 119.0 s); if they were recorded "
                "at the same time, give clock_offset in the team file"
            ),
        ),
        (
            {"a": clock(DATE, 600), "b": clock(DATE, 300, delay=-125), "c": clock(DATE, 600, delay=2)},
            (
                "the clocks of the robots differ: the stamps of b (-125.0 s) differ from the times of recording, "
                "those of a and c do not; give clock_offset in the team file, or use --clock log"
            ),
        ),
        (
            {"a": clock(0, 600), "b": clock(75, 601.5), "c": clock(1, 300), "d": clock(3, 599)},
            (
                "the clocks of the robots may differ: the log of b begins 75.0 s and ends 76.5 s after that of a; "
                "if they were recorded at the same time, give clock_offset in the team file"
            ),
        ),
        (
            {"a": clock(300, 600), "b": clock(0, 600), "c": clock(1, 600)},
            (
                "the clocks of the robots may differ: the log of a begins 300.0 s and ends 300.0 s after that of b;"
                " if they were recorded at the same time, give clock_offset in the team file"
            ),
        ),
    ],
)
def test_clocks_that_differ(clocks, sentence):
    found = clock_warning(clocks)
    assert found == sentence


def test_info_and_run_judge_alike_and_by_the_stamps(tmp_path):
    """Log times agree, stamps do not: the stamps of b are those of a simulation."""
    first = write_mcap(tmp_path / "a.mcap", robot_entries(start_ns=DATE * SECOND))
    moved = [e._replace(log_time_ns=e.log_time_ns + DATE * SECOND) for e in robot_entries(start_ns=0)[1:]]
    second = write_mcap(tmp_path / "b.mcap", moved)
    (sentence,) = describe([first, second]).warnings
    assert "different epochs: the stamps of a (2023-11-14T22:13:20Z, 1.2 s) are dates, those of b (" in sentence
    config = run_of(*(robot.to_config() for robot in discover([first, second])))
    assert resolve(config).warnings == (sentence,)
    assert resolve(config.with_parameters({"clock": "log"})).warnings == ()
    (again,) = resolve(run_of(*(RobotConfig(i, (second,), DEPTH, pose_topic="/odom") for i in "cd"))).warnings
    assert again == f"c and d map the same messages of {second}, which count twice; leave one of them out"


def test_strict_frames_leave_clocks_a_warning(tmp_path):
    first = write_mcap(tmp_path / "a.mcap", robot_entries())
    second = write_mcap(tmp_path / "b.mcap", robot_entries(start_ns=900 * SECOND))
    (sentence,) = describe([first, second], strict_frames=True).warnings
    assert sentence.startswith("the logs share no time: a (100.000 s, 1.2 s); b (900.000 s, 1.2 s)")
    with pytest.raises(ConfigError, match="no logs given"):
        discover([])
