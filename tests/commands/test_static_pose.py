"""Sensors that stand still: --static-pose, and the sentence that names it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from octoreplay.config.team_file import load_team_file
from support.command_line import assert_fails, octoreplay
from support.log_factory import robot_entries, write_mcap

POSE = (1.0, -2.0, 0.5, 0.0, 0.0, 0.6, 0.8)
TEXT = ",".join(map(str, POSE))


@pytest.fixture
def still_log(tmp_path: Path) -> Path:
    """A log with depth images and no poses."""
    entries = [e for e in robot_entries(labels=False) if e.topic not in ("/odom", "/tf_static")]
    return write_mcap(tmp_path / "camera.mcap", entries)


def test_the_option_is_named_where_a_log_has_no_poses(still_log: Path, tmp_path: Path) -> None:
    remedy = "pose: [x, y, z, qx, qy, qz, qw] (--static-pose) for a sensor that stands still"
    done = octoreplay("info", still_log, "--json")
    assert done.returncode == 1
    assert remedy in done.stdout
    done = octoreplay("init", still_log, "-o", tmp_path / "team.yaml")
    assert remedy in done.stderr
    assert_fails(1, re.escape(remedy), "run", still_log, "-o", tmp_path / "out.mcap")


def test_the_pose_is_saved_in_the_team_file(still_log: Path, tmp_path: Path) -> None:
    for text in (TEXT, f"camera={TEXT}"):
        done = octoreplay("run", still_log, "--static-pose", text, "--save-team", tmp_path / "team.yaml", "--force")
        assert done.returncode == 0, done.stderr
        [robot] = load_team_file(tmp_path / "team.yaml").robots
        assert (robot.pose, robot.pose_topic) == (POSE, None)


def test_the_pose_replaces_another_source(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "r.mcap", robot_entries(labels=False))
    for name, options in (("a.yaml", ()), ("b.yaml", ("--static-pose", TEXT))):
        done = octoreplay("run", log if name == "a.yaml" else "a.yaml", *options, "--save-team", name, folder=tmp_path)
        assert done.returncode == 0, done.stderr
    [moving], [still] = (load_team_file(tmp_path / name).robots for name in ("a.yaml", "b.yaml"))
    assert (moving.pose_topic, moving.pose) == ("/odom", None)
    assert (still.pose_topic, still.pose) == (None, POSE)


@pytest.mark.parametrize(
    ("poses", "sentence"),
    [
        (["1,2,3"], "static_pose: expects 7 numbers separated by commas, got '1,2,3'"),
        (["0,0,0,0,0,0,0"], "robot 'camera': pose's quaternion must have length 1"),
        (["0,0,nan,0,0,0,1"], "robot 'camera': pose must be finite"),
        ([f"camara={TEXT}"], "static_pose: there is no robot 'camara'; did you mean 'camera'?"),
    ],
)
def test_wrong_poses_are_refused(still_log: Path, tmp_path: Path, poses: list[str], sentence: str) -> None:
    words = [word for pose in poses for word in ("--static-pose", pose)]
    assert_fails(2, re.escape(sentence), "run", still_log, *words, "-o", tmp_path / "out.mcap")


def test_a_team_needs_the_name_of_the_robot(still_log: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    other.write_bytes(still_log.read_bytes())
    sentence = re.escape(f"static_pose: name the robot, one of camera, other: camera={TEXT}")
    assert_fails(2, sentence, "run", still_log, other, "--static-pose", TEXT, "-o", tmp_path / "out.mcap")
