import dataclasses
import io
import math
import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import RenderableType

from octoreplay.config.resolved import MapFrame
from octoreplay.config.robot import RobotConfig
from octoreplay.io.robots.describe import LogDescription, LogSummary, RobotSummary, TopicSummary
from octoreplay.report import log_tables, query_tables, tables
from octoreplay.run_metrics import FramePlace, RobotMetrics
from octoreplay.stored_map import PointQuery
from support.result_factory import CLASSES, SECOND, START, leaf_table, summary, team, tick_metrics


def rendered(*parts: RenderableType, width: int = 80) -> str:
    text = io.StringIO()
    tables.show(tables.terminal(file=text, width=width), *parts)
    lines = [line.rstrip() for line in text.getvalue().splitlines()]
    assert all(len(line) <= width for line in lines)
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (1234567.8, "1,234,568"), (0.12345, "0.123"), (1e-9, "1e-09"), (999.6, "1,000"), (math.nan, "-"),
     (1e12, "1e+12"), (12.34, "12.3")],
)  # fmt: skip
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert tables.number(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0 B"), (999, "999 B"), (1000, "1 kB"), (35213, "35.2 kB"), (999_600, "1 MB"), (12_345_678, "12.3 MB"),
     (5e9, "5 GB"), (math.nan, "-")],
)  # fmt: skip
def test_sizes_have_units(value: float, text: str) -> None:
    assert tables.size(value) == text


def test_durations_and_times() -> None:
    assert tables.seconds(119.9) == "119.9 s"
    assert tables.seconds(119.96) == "2 min 00 s"
    assert tables.seconds(3 * 60 + 7.2) == "3 min 07 s"
    assert tables.seconds(179.7) == "3 min 00 s"


def test_results_show_the_team_the_robots_and_the_frames() -> None:
    text = rendered(tables.results(summary([tick_metrics(1), tick_metrics(2, settling=True)])))
    assert "12.5 s" in text
    assert "3.2 s (3.8 times real time)" in text
    assert "1, and 1 settling" in text
    assert "it was over" in text
    assert "90.00 % of all cells, 79.67 % of occupied cells" in text
    assert "6 kB as uniform grid (sent: 2.51 % of it)" in text
    assert "alpha" in text
    assert "no pose" in text
    assert "no label" not in text


def test_results_fit_a_large_team_and_leave_out_an_unknown_wall_time() -> None:
    names = [f"a_long_robot_name_{index}" for index in range(12)]
    robot = tick_metrics(500).robots[0]
    big = {"num_leaves": 1_234_567, "observed_volume": 123_456.0, "agreement": 1.0, "agreement_occupied": 1.0}
    robots: tuple[RobotMetrics, ...] = tuple(dataclasses.replace(robot, robot_id=name, **big) for name in names)
    last = dataclasses.replace(tick_metrics(500), robots=robots)
    text = rendered(tables.results(dataclasses.replace(summary([last]), wall_seconds=math.nan)), width=100)
    assert "wall time" not in text
    assert "all 12" in text
    assert "The robots' maps agree" in text
    text = rendered(tables.results(summary([last]), is_verbose=True), width=100)
    assert all(name in text for name in names)


def test_a_row_of_equal_robots_has_the_ranges_of_their_other_numbers() -> None:
    first = tick_metrics(500).robots[0]
    second = dataclasses.replace(first, robot_id="beta", num_leaves=first.num_leaves + 1)
    row = rendered(tables.results(summary([dataclasses.replace(tick_metrics(500), robots=(first, second))])))
    assert f"{first.num_leaves} -" in row
    assert re.search(rf"^ +{second.num_leaves}$", row, re.M)
    other = dataclasses.replace(second, agreement=first.agreement - 0.001)
    text = rendered(tables.results(summary([dataclasses.replace(tick_metrics(500), robots=(first, other))])))
    assert re.search("^beta ", text, re.M)


def test_the_verdict_says_whether_the_team_agrees() -> None:
    last = tick_metrics(5)
    text = rendered(tables.results(summary([last]), num_warnings=2))
    assert text.startswith("Verdict\nagreed    no: 25.00 % of the known cells have different labels\n")
    assert "doubtful: 5.00 % clear contradiction, worst pair alpha and beta" in text
    assert "40 B/s sent by each robot, mean; 10 kB in total" in text
    accurate = dataclasses.replace(
        last, pairs=tuple(dataclasses.replace(pair, clear_contradiction=0.03) for pair in last.pairs)
    )
    text_of_plausible = rendered(tables.results(summary([accurate])))
    assert "plausible: 3.00 % clear contradiction, worst pair alpha and beta" in text_of_plausible
    assert "not contradicted" not in text_of_plausible
    settled = rendered(tables.results(summary([last, tick_metrics(9, settling=True)])))
    assert "40 B/s sent by each robot" in settled
    assert "2, at the end, with remedies" in text
    agreed = dataclasses.replace(last, label_disagreement=0.0009, pairs=())
    text = rendered(tables.results(summary([agreed])))
    assert "yes: 0.09 % of the known cells have different labels" in text
    assert "not known: no two robots share 500 occupied cells" in text
    assert re.search("^warnings  none$", text, re.M)
    places = tuple(FramePlace(robot.robot_id, f"{robot.robot_id}/map", (0.0,) * 6 + (1.0,)) for robot in last.robots)
    text = rendered(tables.results(summary([dataclasses.replace(agreed, places=places)])))
    assert "no: the robots are in 2 frames" in text
    alone = dataclasses.replace(agreed, robots=last.robots[:1])
    assert "one robot: nothing to compare" in rendered(tables.results(summary([alone])))


def test_a_missing_share_is_a_dash() -> None:
    last = tick_metrics(1)
    robots = tuple(dataclasses.replace(robot, agreement=math.nan, agreement_occupied=math.nan) for robot in last.robots)
    text = rendered(tables.results(summary([dataclasses.replace(last, robots=robots)])))
    assert "- of all cells, - of occupied cells" in text


def test_inputs_and_classes_are_shown(tmp_path: Path) -> None:
    config = team(tmp_path)
    text = rendered(log_tables.chosen_inputs(config), log_tables.class_list(CLASSES))
    assert "alpha.bag" in text
    assert "depth         /depth" in text
    assert "\u25a0 ground  \u25a0 tree" in text


def test_point_answers_show_occupied_free_and_the_classes() -> None:
    answer = PointQuery(
        log_odds=np.array([[3.0, 1.0], [0.0, 0.0]], dtype=np.float32),
        probabilities=np.array([[0.042, 0.844, 0.114], [1 / 3, 1 / 3, 1 / 3]], dtype=np.float32),
        labels=np.array([1, 0], dtype=np.uint8),
        known=np.array([True, False]),
        sizes=np.array([0.4, 0.0]),
    )
    lines = rendered(
        query_tables.point_answers(("free", "ground", "tree"), [(1.0, 2.5, -3.0), (9, 9, 9)], answer)
    ).splitlines()
    assert "1, 2.5, -3" in lines[2]
    assert "95.80 %   4.20 %  ground 84.40 %  tree 11.40 %  0.4 m" in lines[2]
    assert lines[3].split() == ["9,", "9,", "9", "unknown"]


def test_box_answers_show_volumes() -> None:
    text = rendered(query_tables.box_answer(("free", "ground", "tree"), leaf_table()))
    rows = {line.split()[0]: line.split()[1:3] for line in text.splitlines()[2:]}
    assert rows == {"free": ["1", "0.008"], "ground": ["2", "0.016"], "tree": ["1", "0.064"]}


def test_descriptions_of_logs_list_missing_inputs() -> None:
    topics = (
        TopicSummary("/camera/depth", "sensor_msgs/msg/Image", "cdr", 1200, 29.97, "16UC1 640x480"),
        TopicSummary("/status", "acme_msgs/msg/Status", "protobuf", 1, None, ""),
    )
    log = LogSummary(Path("robot.mcap"), START, START + 40 * SECOND, 1201, topics, "it ends in the middle of a chunk")
    robot = RobotConfig("robot", (Path("robot.mcap"),), depth_topic="/camera/depth", map_frame="map")
    found = RobotSummary(robot, MapFrame("map", "odom", True), (START, START + 40 * SECOND), ("no pose",))
    text = rendered(
        log_tables.description(LogDescription((log,), (found,), (START, START + SECOND), CLASSES, ("a table",)))
    )
    assert "2023-11-14T22:13:20Z, 40.0 s, 1,201 messages" in text
    assert "/camera/depth  sensor_msgs/Image" in text
    assert "30 Hz" in text
    assert "map (poses in odom, corrected by TF)" in text
    assert "acme_msgs/Status (protobuf)" in text
    assert "damaged: it ends in the middle of a chunk" in text
    assert "missing for a run: robot: no pose" in text
    assert "missing for a run: a table" in text
    assert "nothing is missing" not in text


def test_robots_without_a_common_time_are_named() -> None:
    spans = {"a": (0, 10), "b": (5, 30), "c": (25, 40)}
    robots = tuple(
        RobotSummary(RobotConfig(name, (Path(f"{name}.mcap"),)), None, (start * SECOND, end * SECOND), ())
        for name, (start, end) in spans.items()
    )
    text = rendered(log_tables.description(LogDescription((), robots, None, None, ())), width=100)
    assert "common time of all robots: none: the log of a ends 15.0 s before that of c begins" in text


def test_long_topics_leave_room_for_the_content() -> None:
    name = "/husky_1/camera/depth/camera_info"
    topics = (TopicSummary(name, "sensor_msgs/msg/CompressedImage", "cdr", 1200, 29.97, "16UC1 640x480"),)
    log = LogSummary(Path("robot.mcap"), START, START + 40 * SECOND, 1200, topics, None)
    text = rendered(log_tables.description(LogDescription((log,), (), None, None, ())))
    assert re.search(r"rate +content$", text, re.M)


def test_description_of_an_empty_log() -> None:
    log = LogSummary(Path("robot.mcap"), None, None, 0, (), None)
    text = rendered(log_tables.description(LogDescription((log,), (), None, None, ())))
    assert "robot.mcap\nempty, 0 messages" in text


def test_brackets_in_names_are_not_markup() -> None:
    robot = RobotConfig("r[bold]1", (Path("a[red].mcap"),), depth_topic="/[/]depth")
    text = rendered(
        log_tables.description(LogDescription((), (RobotSummary(robot, None, (0, 1), ()),), None, None, ()))
    )
    assert "r[bold]1" in text
    assert "/[/]depth" in text
