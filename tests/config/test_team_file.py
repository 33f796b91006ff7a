from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from octoreplay.config.class_file import class_table
from octoreplay.config.network import ScheduleEntry
from octoreplay.config.parameters import PARAMETERS
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import _TEAM_KEYS, dump_team, parse_team
from octoreplay.config.team_template import team_template
from octoreplay.errors import ConfigError

CLASSES = class_table(
    [
        {"name": "ground: 'soft' #1", "raw_labels": [1, 2]},
        {"name": "no", "raw_labels": [3], "color": [1, 2, 3], "raw_colors": []},
    ],
    [0],
)
ROBOT = RobotConfig(
    "yes", (Path("/logs/a b.mcap"), Path("/logs/2.mcap")), depth_topic="/depth", label_topic="",
    pose_file=Path("/logs/poses.txt"), pose_times=Path("/elsewhere/times.txt"), rectified=False,
    intrinsics=(1.5, 2.0, 3.0, 4.0), T_body_sensor=(0.0, 1.0, 2.0, 0.0, 0.0, 0.0, 1.0), clock_offset=-0.25,
    body_box=(-1.0, -1.0, -1.0, 1.0, 1.0, 1.0), body_frame="base",
)  # fmt: skip
PLAIN = RobotConfig("r2", (Path("/logs/r2.bag"),), cloud_topic="/points", label_field="rgb", confidence_field="prob")


@pytest.mark.parametrize("write", [dump_team, lambda config, folder: team_template(config, {}, folder)])
@pytest.mark.parametrize(
    "values",
    [{}, {"resolution": 0.35, "no_return_depth": (float("inf"), 1.0), "rule": "flood", "duration": 3.0, "hash": True}],
)
def test_a_written_team_file_gives_the_same_configuration(write, values):
    config = RunConfig((ROBOT, PLAIN), classes=CLASSES).with_parameters(values)
    config = dataclasses.replace(config, link_overrides=(("yes", "r2", (("loss", 0.5),)),))
    network = dataclasses.replace(
        config.network, topology="edges", edges=(("yes", "r2", None),), one_way=(("r2", "yes"),),
        schedule=(ScheduleEntry(start=1.0, end=2.5, robots_off=("yes",), forget=True),),
    )  # fmt: skip
    config = dataclasses.replace(config, network=network)
    assert parse_team(write(config, Path("/logs")), name="team.yaml", folder=Path("/logs")) == config


def test_the_template_has_every_key_and_names_missing_data():
    text = team_template(RunConfig((PLAIN,)), {"r2": ["no poses", "two depth images:\n    depth_topic: /a"]})
    keys = {item.name for item in dataclasses.fields(RobotConfig)} - {"robot_id", "logs"}
    for key in (*keys, *PARAMETERS, *_TEAM_KEYS):
        assert re.search(rf"^ *(# )?{key}:", text, flags=re.MULTILINE), key
    assert "    # missing: no poses\n    # missing: two depth images:\n    # depth_topic: /a\n" in text


def test_commented_defaults_of_the_template_are_the_defaults():
    config = RunConfig((PLAIN,), classes=CLASSES)
    text = team_template(config, {})
    names = "|".join([*PARAMETERS, "clock_offset", "publish_phase"])
    uncommented, count = re.subn(rf"^( *)# ((?:{names}): .*)$", r"\1\2", text, flags=re.MULTILINE)
    assert count > 40
    assert parse_team(uncommented, name="team.yaml", folder=Path()) == config


def test_every_choice_of_a_parameter_is_in_its_help():
    for parameter in PARAMETERS.values():
        for choice in parameter.choices or ():
            assert re.search(rf"\b{choice}\b", parameter.help), (parameter.name, choice)


def test_a_pose_file_is_relative_to_the_team_file():
    text = "robots: [{id: a, log: a.mcap, cloud_topic: /p, pose_file: poses.txt, pose_times: t/times.txt}]"
    robot = parse_team(text, name="team.yaml", folder=Path("/team")).robots[0]
    assert (robot.pose_file, robot.pose_times) == (Path("/team/poses.txt"), Path("/team/t/times.txt"))
    assert robot.files == (Path("/team/a.mcap"), Path("/team/poses.txt"), Path("/team/t/times.txt"))


@pytest.mark.parametrize("write", [dump_team, lambda config: team_template(config, {})])
def test_edits_of_the_logs_own_classes_are_written_and_read(write):
    config = RunConfig((PLAIN,), merge_classes=(("a", ("b", "c")),), ignore_hits=("d",))
    assert parse_team(write(config), name="team.yaml", folder=Path()) == config


def test_a_misspelt_key_is_named_before_the_key_that_it_replaces():
    with pytest.raises(ConfigError, match=r"^team\.yaml: robtos: unknown key; did you mean 'robots'\?$"):
        parse_team("robtos: []\n", name="team.yaml", folder=Path())
