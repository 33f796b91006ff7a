"""Relations between the map frames of a team's robots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.resolved import MapFrame
from octoreplay.config.robot import RobotConfig
from octoreplay.errors import ConfigError
from octoreplay.io.robots.describe import describe
from octoreplay.io.robots.discover import discover, resolve
from octoreplay.io.robots.team_frames import frame_origins, frames_warning
from support.discovered_logs import run_of
from support.log_factory import IDENTITY, Entry, robot_entries, ros2, write_mcap

ORIGIN = (0.0, 0.0, 0.0, *IDENTITY)


def stated(name: str | None) -> MapFrame:
    """Poses that are given in the map frame."""
    return MapFrame(name, name)


def placed(name: str, x: float, pose_frame: str = "odom", *, is_corrected: bool = False) -> MapFrame:
    """Poses below the map frame, ``x`` metres away."""
    T = np.eye(4)
    T[0, 3] = x
    return MapFrame(name, pose_frame, is_corrected, tuple(T.ravel().tolist()))


def corrected(name: str) -> MapFrame:
    """Poses that are corrected."""
    return MapFrame(name, "odom", True)


def in_tree(robot_id: str, *others: str) -> MapFrame:
    """Robot in a TF tree that holds other robots too."""
    tree = frozenset({"map", *(f"{name}/{frame}" for name in (robot_id, *others) for frame in ("odom", "base"))})
    return MapFrame("map", f"{robot_id}/odom", True, None, tree, frozenset({f"{robot_id}/base"}))


def warning_of(*frames: MapFrame, **given: tuple[float, ...]) -> str | None:
    """Warning on robots a, b, ... with these frames in logs of their own; ``given`` are their T_team_map."""
    names = "abcdefgh"[: len(frames)]
    robots = [RobotConfig(name, (Path(name),), pose_topic="/odom", T_team_map=given.get(name)) for name in names]
    return frames_warning(list(zip(robots, frames, strict=True)))


@pytest.mark.parametrize(
    "frames",
    [
        (stated("odom"),),
        (stated("map"), stated("map")),
        (stated("vicon/world"), stated("vicon/world")),
        (stated("World"), stated("World"), placed("World", 3.0)),
        (placed("site", 0.0), placed("site", 3.0), placed("site", 1.0, is_corrected=True)),
        # A placeholder above poses in a common frame.
        (placed("world", 0.0, "map"), placed("world", 0.0, "map"), stated("map")),
        (in_tree("a", "b", "c"), in_tree("b"), in_tree("c", "a")),
    ],
)
def test_frames_that_are_related(frames):
    assert warning_of(*frames) is None


@pytest.mark.parametrize(
    ("frames", "listed"),
    [
        ((stated("odom"), stated("odom")), "a ('odom') and b ('odom')"),
        ((stated("a/map"), stated("b/map"), stated("a/map")), "a, c ('a/map') and b ('b/map')"),
        ((stated("map"), stated("world")), "a ('map') and b ('world')"),
        (
            (corrected("map"), corrected("map"), stated("map")),
            "a ('map': poses in odom, corrected by TF), b ('map': poses in odom, corrected by TF) and c ('map')",
        ),
        (
            (placed("map", 0.0), placed("map", 0.0)),
            "a ('map': poses in odom, placed by TF) and b ('map': poses in odom, placed by TF)",
        ),
        (
            (placed("map", 0.0, is_corrected=True), placed("map", 0.0, is_corrected=True)),
            "a ('map': poses in odom, corrected by TF) and b ('map': poses in odom, corrected by TF)",
        ),
        ((stated(None), stated(None)), "a (poses that name no frame) and b (poses that name no frame)"),
        ((in_tree("a"), in_tree("a")), "a ('map': poses in a/odom, corrected by TF) and b ('map': poses in a/odom, "),
        # Two robots in each of two trees.
        ((in_tree("a", "b"), in_tree("b"), stated("odom")), "a, b ('map': poses in a/odom, corrected by TF) and c ('o"),
    ],
)
def test_frames_that_nothing_relates_are_named(frames, listed):
    found = warning_of(*frames)
    assert found is not None
    assert found.startswith(f"nothing relates the map frames of {listed}")
    assert "find T_team_map with 'octoreplay align', or give it in the team file" in found


def test_a_given_transform_places_a_robot():
    odom = stated("odom")
    assert warning_of(odom, odom, a=ORIGIN, b=ORIGIN) is None
    # The only robot without one defines the team's frame.
    assert warning_of(odom, odom, b=ORIGIN) is None
    found = warning_of(odom, odom, odom, b=ORIGIN)
    assert found is not None
    assert found.startswith("nothing relates the map frames of a ('odom') and c ('odom'), so")


def in_frame(entries: list[Entry], frame_id: str) -> list[Entry]:
    """Entries with the odometry in another frame."""
    for entry in entries:
        if entry.type_name.endswith("Odometry"):
            entry.value.header.frame_id = frame_id
    return entries


def test_logs_with_odometry_frames(tmp_path):
    """The command line, the team file and Python give the same sentence."""
    paths = [write_mcap(tmp_path / f"{name}.mcap", in_frame(robot_entries(), "odom")) for name in "ab"]
    sentence = (
        "nothing relates the map frames of a ('odom') and b ('odom'), so their maps are overlaid as if these were one "
        "frame; find T_team_map with 'octoreplay align', or give it in the team file"
    )
    assert describe(paths).warnings == (sentence,)
    config = run_of(*(robot.to_config() for robot in discover(paths)))
    assert resolve(config).warnings == (sentence,)
    for call in (
        lambda: describe(paths, strict_frames=True),
        lambda: resolve(config.with_parameters({"strict_frames": True})),
    ):
        with pytest.raises(ConfigError) as caught:
            call()
        assert str(caught.value) == f"strict_frames: {sentence}"
    same = [write_mcap(tmp_path / f"{name}.mcap", robot_entries()) for name in "cd"]
    assert describe(same, strict_frames=True).warnings == ()


@pytest.mark.parametrize(("frame_id", "num_warnings"), [("odom", 1), ("world", 0)])
def test_robots_of_one_log(tmp_path, frame_id, num_warnings):
    """Equal names in one log are one frame where TF has it, or where the name is common."""
    entries = [*robot_entries(namespace="a"), *robot_entries(namespace="b")]
    entries = sorted(in_frame(entries, frame_id), key=lambda e: e.log_time_ns)
    path = write_mcap(tmp_path / "team.mcap", entries)
    assert len(describe([path]).warnings) == num_warnings
    stamp = entries[-1].log_time_ns
    joints = [("odom", f"{name}/base_link", stamp, (0, 0, 0), IDENTITY) for name in "ab"]
    entries.append(Entry("/tf", "tf2_msgs/msg/TFMessage", ros2.tf(*joints), stamp))
    assert describe([write_mcap(tmp_path / "tree.mcap", entries)]).warnings == ()


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ((stated("map"), stated("map")), ("frame 'map' of the logs",) * 2),
        ((stated("odom"), stated("odom")), ("assumed: the map frame is taken for the team's frame",) * 2),
        ((None, stated("map")), ("assumed: the map frame is taken for the team's frame",) * 2),
        ((stated("odom"),), ("frame 'odom' of the logs",)),
    ],
)
def test_the_origin_of_a_frame_is_the_logs_or_an_assumption(frames, expected):
    robots = [RobotConfig(name, (Path(name),), pose_topic="/odom") for name in "abc"[: len(frames)]]
    assert tuple(frame_origins(list(zip(robots, frames, strict=True))).values()) == expected


def test_the_origin_of_a_given_frame_is_the_team_file_or_the_command_that_found_it():
    robots = [
        RobotConfig("a", (Path("a"),), T_team_map=ORIGIN),
        RobotConfig("b", (Path("b"),), T_team_map=ORIGIN, T_team_map_from="aligned with a, L 812"),
        RobotConfig("c", (Path("c"),)),
    ]
    assert frame_origins([(robot, stated("map")) for robot in robots]) == {
        "a": "given in the team file",
        "b": "aligned with a, L 812",
        "c": "assumed: the map frame is taken for the team's frame",
    }
