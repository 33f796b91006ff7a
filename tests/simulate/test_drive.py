"""Tests of drives along given paths."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.errors import ConfigError
from octoreplay.simulate.drive import drive_paths
from octoreplay.simulate.exploration import Motion
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team
from octoreplay.simulate.world import BUILDING, GRASS, Terrain, World
from support.command_line import assert_fails, octoreplay
from support.long_suite import examples
from support.stored_messages import read_messages

FLAT = Terrain(np.zeros((1, 2)), np.zeros(1), np.zeros(1))
MOTION = Motion(speed=2.0, turn_rate=0.8)
PERIOD = 0.1


def walled_world(*walls: tuple[float, float, float]) -> World:
    """Flat world of 60 m with walls (x, from y, to y) of a building."""
    sheets = [np.array([[-30.0, -30, 0], [30, -30, 0], [30, 30, 0], [-30, 30, 0]])]
    sheets += [np.array([[x, low, 0.0], [x, high, 0.0], [x, high, 2.0], [x, low, 2.0]]) for x, low, high in walls]
    faces = [np.array([[0, 1, 2], [0, 2, 3]]) + 4 * k for k in range(len(sheets))]
    classes = np.repeat([GRASS] + [BUILDING] * len(walls), 2).astype(np.uint8)
    vertices = np.concatenate(sheets).astype(np.float32)
    return World(60.0, FLAT, vertices, np.concatenate(faces).astype(np.int32), classes)


def reference_drive(path: list[tuple[float, float]], num_steps: int) -> np.ndarray:
    """Reference implementation: a robot that turns and drives in small steps."""
    parts = 20
    x, y = path[0]
    targets = list(path[1:])
    states, heading = [], None
    for step in range(num_steps * parts):
        if step % parts == 0:
            states.append((x, y, heading))
        left = PERIOD / parts
        while targets and left > 0:
            way = math.dist((x, y), targets[0])
            if way < 1e-12:
                targets.pop(0)
                continue
            wanted = math.atan2(targets[0][1] - y, targets[0][0] - x)
            heading = wanted if heading is None else heading
            error = (wanted - heading + math.pi) % (2 * math.pi) - math.pi
            if abs(error) > 1e-9:
                turn = min(abs(error), MOTION.turn_rate * left)
                heading += math.copysign(turn, error)
                left -= turn / MOTION.turn_rate
                continue
            pace = min(way, MOTION.speed * left)
            x, y = x + pace * math.cos(wanted), y + pace * math.sin(wanted)
            left -= pace / MOTION.speed
    return np.array([(x, y, h or 0.0) for x, y, h in states])


places = st.tuples(st.integers(-12, 12), st.integers(-12, 12))


@examples(80)
@given(st.lists(places, min_size=1, max_size=4))
def test_drives_on_open_ground_equal_the_reference(path):
    states = drive_paths(walled_world(), {"husky_1": path}, 60, PERIOD, MOTION)
    assert states.shape == (1, 60, 3)
    expected = reference_drive(path, 60)
    np.testing.assert_allclose(states[0, :, :2], expected[:, :2], atol=1e-6)
    # The first state of the reference has no heading yet; half a turn may be to either side.
    turned = np.diff([math.atan2(b[1] - a[1], b[0] - a[0]) for a, b in itertools.pairwise(path) if a != b])
    if not np.isclose(np.abs(turned) % (2 * np.pi), np.pi).any():
        np.testing.assert_allclose(states[0, 1:, 2], expected[1:, 2], atol=1e-6)


def test_a_leg_leads_around_a_wall_and_keeps_the_clearance():
    world = walled_world((5.0, -6.0, 9.0))
    path = [(0.0, 0.0), (10.0, 0.0), (10.0, -8.0)]
    [states] = drive_paths(world, {"husky_1": path}, 1000, PERIOD, MOTION)
    # One cell of distance is at least half a metre between the robot and the wall.
    beside = np.clip(states[:, 1], -6.0, 9.0)
    assert np.hypot(states[:, 0] - 5.0, states[:, 1] - beside).min() >= 0.5 - 1e-9
    # It goes around the nearer end of the wall, and through both waypoints.
    assert states[:, 1].min() == -8.0
    assert states[:, 1].max() < 0.6
    for point in path:
        assert np.hypot(*(states[:, :2] - point).T).min() <= MOTION.speed * PERIOD
    np.testing.assert_array_equal(states[-1, :2], path[-1])
    moved = np.hypot(*np.diff(states[:, :2], axis=0).T)
    assert moved.max() <= MOTION.speed * PERIOD + 1e-9
    assert np.abs(np.diff(states[:, 2])).max() <= MOTION.turn_rate * PERIOD + 1e-9
    # Around the end of the wall at (5, -6) the way is 7.8 + 7.8 + 8 m long.
    assert moved.sum() < 1.2 * 23.6


def test_a_way_far_around_a_wall_is_found():
    # The only way is 39 m away, beyond the first search.
    world = walled_world((5.0, -30.0, 27.0))
    [states] = drive_paths(world, {"husky_1": [(0, -12), (10, -12)]}, 2000, PERIOD, MOTION)
    np.testing.assert_array_equal(states[-1, :2], (10, -12))
    assert states[:, 1].max() > 27.0


@pytest.mark.parametrize("place", [(5, 0), (9, 0)])
def test_waypoints_at_obstacles_and_in_enclosures_are_refused_with_the_nearest_place(place):
    world = walled_world((5.0, -30.0, 30.0))
    sentence = (
        rf"husky_2: obstacles are at or around waypoint 2 \({place[0]}, 0\); the nearest place .* is \((.*), (.*)\)"
    )
    with pytest.raises(ConfigError, match=sentence) as error:
        drive_paths(world, {"husky_1": [(0, 0)], "husky_2": [(0, 0), place]}, 10, PERIOD, MOTION)
    x, y = map(float, re.search(sentence, str(error.value)).groups())
    assert (x, y) == (4.25, pytest.approx(0.0, abs=0.25))
    drive_paths(world, {"husky_2": [(0, 0), (x, y)]}, 10, PERIOD, MOTION)


def test_paths_that_do_not_fit_the_settings_are_refused():
    with pytest.raises(ConfigError, match="paths: 1 paths do not fit 6 robots; give one for each"):
        SimulationConfig(paths=(((0.0, 0.0),),))
    with pytest.raises(ConfigError, match=r"paths: husky_1: waypoint \(0, -36\) is outside of the village of 70 m"):
        SimulationConfig(num_robots=1, paths=(((0.0, -36.0),),))
    with pytest.raises(ConfigError, match="speed: 0 is not between"):
        SimulationConfig(speed=0.0)


SMALL = SimulationConfig(num_robots=2, duration=4.0, rate=1.0, image=(16, 12), seed=5, world_size=24.0, resolution=1.0)


def test_the_command_drives_the_paths_of_a_file_at_the_given_speed(tmp_path):
    (tmp_path / "paths.yaml").write_text("paths: {husky_1: [[0, 0], [5, 0]], husky_2: [[0, -4]]}")
    small = ("--duration", 4, "--rate", 1, "--image", "16x12", "--seed", 5, "--world-size", 24, "--resolution", 1)
    octoreplay("simulate", "team", "--paths", "paths.yaml", "--speed", 0.5, *small, folder=tmp_path)
    for robot_id, pace, y in (("husky_1", 0.5, 0.0), ("husky_2", 0.0, -4.0)):
        odometry = read_messages(tmp_path / "team" / f"{robot_id}.mcap")[f"/{robot_id}/odom"]
        seconds = np.arange(len(odometry)) / 20.0
        np.testing.assert_allclose([m.pose.pose.position.x for _, m in odometry], pace * seconds, atol=1e-9)
        np.testing.assert_allclose([m.pose.pose.position.y for _, m in odometry], y, atol=1e-9)
        assert odometry[0][1].twist.twist.linear.x == pytest.approx(pace)
    # The same from Python.
    paths = (((0.0, 0.0), (5.0, 0.0)), ((0.0, -4.0),))
    simulate_team(tmp_path / "again", dataclasses.replace(SMALL, speed=0.5, paths=paths))
    for path in (tmp_path / "team").iterdir():
        assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes(), path.name


def test_the_command_refuses_wrong_paths_and_leaves_nothing(tmp_path):
    paths = tmp_path / "paths.yaml"
    paths.write_text("paths: {husky_1: [[0, 0], [50, 0]]}")
    assert_fails(2, r"husky_1: waypoint \(50, 0\) is outside", "simulate", tmp_path / "team", "--paths", paths)
    assert_fails(2, "1 paths do not fit 2 robots", "simulate", tmp_path / "team", "--paths", paths, "--robots", 2)
    paths.write_text("paths: 5")
    assert_fails(2, "paths.yaml: expects the single key", "simulate", tmp_path / "team", "--paths", paths)
    assert [path.name for path in tmp_path.iterdir()] == ["paths.yaml"]
