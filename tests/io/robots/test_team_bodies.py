from __future__ import annotations

import numpy as np
import pytest

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.time import TimeConfig
from octoreplay.io.robots.team_bodies import TeamBodies
from octoreplay.records import BodyBox, CloudFrame
from support.log_factory import SECOND, robot_entries, write_mcap

START = 100 * SECOND
BOX = (-0.5, -0.4, 0.0, 0.5, 0.4, 0.6)


def robot_of(tmp_path, name, *, poses="odometry", num_frames=40, **fields):
    entries = robot_entries(num_frames=num_frames, poses=poses, labels=False)
    known = {"depth_topic": "/camera/depth/image_raw", "camera_info_topic": "/camera/depth/camera_info"}
    known |= {"pose_topic": "/tf", "map_frame": "map"} if poses == "tf" else {"pose_topic": "/odom"}
    return ResolvedRobot(name, (write_mcap(tmp_path / f"{name}.mcap", entries),), **{**known, **fields})


def others(bodies, index, stamp_ns):
    """The boxes that are added to a robot's frame of a stamp, behind its own."""
    own = BodyBox(np.zeros(3), np.ones(3), np.eye(4), is_own=True)
    frame = CloudFrame("r", stamp_ns, np.zeros((1, 3), np.float32), None, np.eye(4), boxes=(own,))
    first, *added = bodies.add_to(index, frame).boxes
    assert first is own
    return tuple(added)


def inside(box, points):
    local = (box.T_box_team @ np.append(np.array(points), np.ones((len(points), 1)), axis=1).T).T[:, :3]
    return ((local >= box.low) & (local <= box.high)).all(axis=1).tolist()


@pytest.mark.parametrize("poses", ["odometry", "tf"])
def test_boxes_are_where_the_robots_are(tmp_path, poses):
    """The base of robot b is at x = t, 10 m to the left and half a second later than its stamps say."""
    robots = (
        robot_of(tmp_path, "a", body_box=BOX),
        robot_of(
            tmp_path, "b", poses=poses, body_box=BOX, body_frame="base_link" if poses == "tf" else None,
            T_team_map=(0.0, 10.0, 0.0, 0.0, 0.0, 0.0, 1.0), clock_offset=0.5,
        ),
        robot_of(tmp_path, "c"),
    )  # fmt: skip
    with TeamBodies(robots, TimeConfig()) as bodies:
        for second in range(1, 9):
            bodies.advance(START + (second - 1) * SECOND, START + second * SECOND)
            stamp = START + second * SECOND - SECOND // 8
            [box] = others(bodies, 0, stamp)
            assert not box.is_own
            x = second - 0.125 - 0.5
            assert inside(box, [(x, 10, 0.3), (x + 0.49, 10.39, 0.59), (x + 0.51, 10, 0.3), (x, 10, -0.01)]) == [
                True, True, False, False,
            ]  # fmt: skip
            assert len(others(bodies, 2, stamp)) == 2
            [other] = others(bodies, 1, stamp)
            assert inside(other, [(second - 0.125, 0, 0.1), (second + 0.5, 0, 0.1)]) == [True, False]


def test_a_robot_whose_poses_have_ended_has_no_box(tmp_path):
    robots = (robot_of(tmp_path, "a"), robot_of(tmp_path, "b", num_frames=4, body_box=BOX))
    with TeamBodies(robots, TimeConfig()) as bodies:
        bodies.advance(START, START + SECOND // 2)
        assert len(others(bodies, 0, START + SECOND // 4)) == 1
        bodies.advance(START + 5 * SECOND, START + 6 * SECOND)
        assert others(bodies, 0, START + 5 * SECOND + 1) == ()


def test_poses_are_read_only_up_to_the_span(tmp_path):
    robots = (robot_of(tmp_path, "a"), robot_of(tmp_path, "b", num_frames=400, body_box=BOX))
    with TeamBodies(robots, TimeConfig()) as bodies:
        bodies.advance(START, START + SECOND)
        track = bodies._tracks[1]
        assert len(track._poses._track) < 20
        for second in range(1, 60):
            bodies.advance(START + (second - 1) * SECOND, START + second * SECOND)
        assert len(track._poses._track) < 20
