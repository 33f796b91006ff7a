from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from octoreplay.config.resolved import ResolvedRobot, ResolvedRun
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.errors import ConfigError
from octoreplay.records import ClassTable, SemanticClass

SECOND = 1_000_000_000
CLASSES = ClassTable((SemanticClass(1, "tree", (1,), ()),))


def robot(name="a", *, span=(5 * SECOND, 25 * SECOND), **fields):
    known = {"depth_topic": "/depth", "pose_topic": "/odom"}
    return ResolvedRobot(name, (Path(f"{name}.mcap"),), **{**known, **fields}, span_ns=span)


@pytest.mark.parametrize(
    ("fields", "missing"),
    [
        ({}, "depth_topic or cloud_topic"),
        ({"pose_topic": "/odom"}, "depth_topic or cloud_topic"),
        ({"depth_topic": "/depth"}, "pose_topic, pose_file or pose"),
        ({"cloud_topic": "/points"}, "pose_topic, pose_file or pose"),
    ],
)
def test_a_sensor_topic_and_a_pose_source_are_required(fields, missing):
    plain = RobotConfig("a", (Path("a.mcap"),), **fields)
    with pytest.raises(ConfigError, match=f"robot 'a': needs a {missing}"):
        ResolvedRobot.from_config(plain, None)


def test_the_other_checks_of_a_robot_hold_too():
    with pytest.raises(ConfigError, match="depth_unit must be greater than 0"):
        robot(depth_unit=-1.0)


def test_the_sensor_topic_is_the_depth_or_the_cloud_topic():
    assert robot().sensor_topic == "/depth"
    assert (
        robot(depth_topic=None, cloud_topic="/points", pose_topic=None, pose_file=Path("t")).sensor_topic == "/points"
    )


def test_the_span_follows_the_clock_offset():
    moved = dataclasses.replace(robot(), clock_offset=-1.5)
    assert (moved.start_ns, moved.end_ns) == (7 * SECOND // 2, 47 * SECOND // 2)
    assert (robot(span=None).start_ns, robot(span=None).end_ns) == (None, None)


def test_plain_configurations_are_the_same_without_the_span():
    plain = RobotConfig("a", (Path("a.mcap"),), depth_topic="/depth", pose_topic="/odom", clock_offset=2.0)
    assert ResolvedRobot.from_config(plain, (1, 2)).to_config() == plain
    config = RunConfig((plain,), merge_classes=(("plant", ("tree",)),)).with_parameters({"rule": "bayes"})
    run = ResolvedRun.from_config(config, [ResolvedRobot.from_config(plain, (1, 2))], CLASSES)
    effective = {"classes": CLASSES, "merge_classes": (), "sensor": config.effective_sensor}
    assert run.to_config() == dataclasses.replace(config, **effective)
    assert run.effective_sensor.miss == run.to_config().sensor.miss == -19661 * 2.0**-16


def test_parameters_keep_the_resolution():
    run = ResolvedRun((robot(),), CLASSES).with_parameters({"rule": "bayes", "start": 2.0})
    assert isinstance(run, ResolvedRun)
    assert run.robots == (robot(),)
    assert (run.consensus.rule, run.total_ns) == ("bayes", 18 * SECOND)


def test_another_rule_rounds_the_sensor_model_to_its_own_quantum():
    run = ResolvedRun((robot(),), CLASSES)
    assert run.effective_sensor.miss == -19661 * 2.0**-16
    gradient = run.with_parameters({"rule": "gradient"})
    assert gradient.effective_sensor.miss == -307 * 2.0**-10
    assert gradient.with_parameters({"rule": "flood"}).effective_sensor.miss == -0.3
    assert gradient.with_parameters({"rule": "bayes"}).effective_sensor == run.effective_sensor


def test_edits_of_classes_are_refused():
    with pytest.raises(ConfigError, match="merge_classes, ignore_hits: must be empty in a resolved run"):
        ResolvedRun((robot(),), CLASSES, merge_classes=(("plant", ("tree",)),))


@pytest.mark.parametrize(
    ("parameters", "seconds"),
    [
        ({}, 30), ({"start": 4.0}, 26), ({"start": 40.0}, 0), ({"duration": 10.0}, 10), ({"duration": 100.0}, 30),
        ({"start": 25.0, "duration": 10.0}, 5),
    ],
)  # fmt: skip
def test_the_total_length_is_that_of_the_replayed_part(parameters, seconds):
    team = (robot("a"), robot("b", span=(0, 10 * SECOND), clock_offset=25.0), robot("c", span=None))
    run = ResolvedRun(team, CLASSES).with_parameters(parameters)
    assert run.total_ns == seconds * SECOND


def test_the_total_length_is_unknown_where_no_span_is_known():
    assert ResolvedRun((robot(span=None),), CLASSES).total_ns is None
