"""Tests of simulated LiDAR scans, and of the logs of a team with LiDARs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.team_file import load_team_file
from octoreplay.errors import ConfigError
from octoreplay.evaluate.evaluation import evaluate_result
from octoreplay.geodesy import enu_points
from octoreplay.simulate.lidar import RANGE_SIGMA, LidarModel, MeshLidar, add_range_noise
from octoreplay.simulate.odometry import FIX_ORIGIN
from octoreplay.simulate.scene import NO_LABEL
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team
from octoreplay.simulate.world import BUILDING, CAR, Terrain, World, village_classes
from support.command_line import assert_fails, octoreplay
from support.long_suite import long
from support.stored_messages import matrix, read_messages

MODEL = LidarModel(rings=9, columns=24, low=-0.5, high=0.3)
EXACT = SimulationConfig(
    num_robots=2, duration=4.0, rate=2.0, sensor="lidar", scan=(16, 128), seed=6, world_size=24.0, label_noise=0.0,
    depth_noise=0.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def exact(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("exact") / "team"
    simulate_team(folder, EXACT)
    return folder


def two_walls() -> World:
    """World of two walls across x: a car's at x = 5 in front of y > 0, and a building's at x = -9."""
    points, faces = [], []
    for x, low in ((5.0, 0.0), (-9.0, -20.0)):
        points += [(x, low, -20.0), (x, 20.0, -20.0), (x, 20.0, 20.0), (x, low, 20.0)]
        first = len(points) - 4
        faces += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
    flat = Terrain(np.zeros((1, 2)), np.zeros(1), np.zeros(1))
    classes = np.array([CAR, CAR, BUILDING, BUILDING], np.uint8)
    return World(60.0, flat, np.array(points, np.float32), np.array(faces, np.int32), classes)


def reference_scan(T: np.ndarray, max_range: float) -> tuple[np.ndarray, np.ndarray]:
    """Reference implementation: analytic intersection of every ray with both walls."""
    ranges, labels = np.zeros((MODEL.rings, MODEL.columns)), np.full((MODEL.rings, MODEL.columns), NO_LABEL)
    for ring in range(MODEL.rings):
        elevation = MODEL.low + (MODEL.high - MODEL.low) * ring / (MODEL.rings - 1)
        for column in range(MODEL.columns):
            azimuth = 2 * np.pi * column / MODEL.columns
            flat = np.cos(elevation)
            ray = T[:3, :3] @ [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)]
            best = max_range
            for x, low, class_id in ((5.0, 0.0, CAR), (-9.0, -20.0, BUILDING)):
                t = (x - T[0, 3]) / ray[0] if ray[0] else np.inf
                y, z = T[1:3, 3] + t * ray[1:]
                if 0 < t <= best and low < y < 20.0 and abs(z) < 20.0:
                    best = ranges[ring, column] = t
                    labels[ring, column] = class_id
    return ranges, labels


@pytest.mark.parametrize("max_range", [100.0, 9.5])
@pytest.mark.parametrize(("x", "yaw"), [(0.03, 0.01), (-2.0, 0.7), (-1.0, -2.3)])
def test_scans_equal_the_reference(x, yaw, max_range):
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = x, 0.02, 0.1
    lidar = MeshLidar(two_walls(), MODEL)
    ranges, labels = lidar.take(T, max_range)
    expected_ranges, expected_labels = reference_scan(T, max_range)
    assert set(np.unique(expected_labels)) == {BUILDING, CAR, NO_LABEL}
    assert (ranges.dtype, labels.dtype) == (np.float32, np.uint8)
    np.testing.assert_array_equal(labels, expected_labels)
    np.testing.assert_allclose(ranges, expected_ranges, rtol=1e-4)
    hit = labels == CAR
    points = lidar.points(ranges)[hit] @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(points[:, 0], 5.0, atol=1e-3)


def test_range_noise_has_its_standard_deviation_at_every_range():
    ranges = np.broadcast_to(np.array([0.0, 1.0, 50.0], np.float32)[:, None], (3, 40_000))
    noisy = add_range_noise(ranges, np.random.default_rng(0), 2.0)
    assert (noisy[0] == 0).all()
    np.testing.assert_allclose((noisy - ranges)[1:].std(axis=1), 2.0 * RANGE_SIGMA, rtol=0.03)
    assert (add_range_noise(np.full((10, 10), 0.01, np.float32), np.random.default_rng(1), 9.0) > 0).all()


def clouds(folder: Path, robot_id: str):
    """Points (P, 3) in the map, by the poses of the log, and labels (P,) of each scan."""
    messages = read_messages(folder / f"{robot_id}.mcap")
    odometry = dict(messages[f"/{robot_id}/odom"])
    stamps = np.array(sorted(odometry))
    [(_, static)] = messages["/tf_static"]
    mount = static.transforms[0].transform
    for stamp, cloud in messages[f"/{robot_id}/lidar/points"]:
        assert [field.name for field in cloud.fields] == ["x", "y", "z", "label"]
        table = np.frombuffer(cloud.data, [("xyz", "<f4", 3), ("label", "<u2")])
        k = int(np.searchsorted(stamps, stamp))
        # Scans are taken midway between two poses, which hardly differ in rotation.
        before, after = (odometry[t].pose.pose for t in (stamps[k - 1], stamps[k]))
        T = (matrix(before.position, before.orientation) + matrix(after.position, after.orientation)) / 2
        T = T @ matrix(mount.translation, mount.rotation)
        yield table["xyz"] @ T[:3, :3].T + T[:3, 3], table["label"]


def test_points_are_on_the_surfaces_of_the_ground_truth(exact):
    with np.load(exact / "world.npz") as archive:
        truth = dict(zip(map(tuple, archive["keys"].tolist()), archive["class_ids"].tolist(), strict=True))
        resolution = float(archive["resolution"])
    points, labels = (np.concatenate(parts) for parts in zip(*clouds(exact, "husky_2"), strict=True))
    near = np.linalg.norm(points - points.mean(axis=0), axis=1) < 15.0
    found = [truth.get(tuple(key), 0) for key in np.floor(points[near] / resolution).astype(int).tolist()]
    known = np.array(found) > 0
    assert len(known) > 3000
    assert known.mean() > 0.98
    assert (np.array(found)[known] == labels[near][known]).mean() > 0.95


def test_the_log_of_a_lidar_has_no_images_and_the_team_file_names_the_clouds(exact):
    topics = {"/husky_1/lidar/points", "/husky_1/labels/label_info", "/husky_1/odom", "/tf", "/tf_static"}
    assert set(read_messages(exact / "husky_1.mcap")) == topics
    config = load_team_file(exact / "team.yaml")
    assert config.classes == village_classes()
    assert [(robot.cloud_topic, robot.depth_topic) for robot in config.robots] == [
        (f"/{robot_id}/lidar/points", None) for robot_id in ("husky_1", "husky_2")
    ]


def test_noise_of_labels_and_ranges_and_fixes_reach_the_log(exact, tmp_path):
    config = dataclasses.replace(EXACT, label_noise=0.2, depth_noise=1.0, patchy_noise=0.01, fixes=0.01)
    simulate_team(tmp_path / "team", config)
    for (points, labels), (noisy, wrong) in zip(
        clouds(exact, "husky_1"), clouds(tmp_path / "team", "husky_1"), strict=True
    ):
        assert (labels != wrong).mean() == pytest.approx(0.2, abs=0.06)
        assert np.linalg.norm(points - noisy, axis=1).std() == pytest.approx(0.6 * RANGE_SIGMA, rel=0.1)
    messages = read_messages(tmp_path / "team" / "husky_1.mcap")
    geodetic = np.array([(fix.latitude, fix.longitude, fix.altitude) for _, fix in messages["/husky_1/fix"]])
    assert np.abs(enu_points(geodetic, FIX_ORIGIN)[:, :2]).max() < config.world_size


def test_a_log_without_labels_has_points_alone(tmp_path):
    simulate_team(tmp_path / "team", dataclasses.replace(EXACT, has_labels=False, duration=1.0))
    [(_, first), *_] = read_messages(tmp_path / "team" / "husky_1.mcap")["/husky_1/lidar/points"]
    assert [field.name for field in first.fields] == ["x", "y", "z"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sensor": "radar"}, "sensor: 'radar' is not one of camera, lidar"),
        ({"sensor": "lidar", "colour": "raw"}, "colour: a LiDAR takes no images"),
        ({"scan": (0, 1024)}, "rings of scan: 0 is not between"),
        ({"scan": (64, 2)}, "columns of scan: 2 is not between"),
        ({"scan_view": (10.0, 10.0)}, "scan_view: the lowest ring must be below"),
        ({"scan_view": (-91.0, 10.0)}, "scan_view: -91 is not between"),
        ({"scan_range": 0.0}, "scan_range: 0 is not between"),
    ],
)
def test_options_that_do_not_fit_are_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        SimulationConfig(**options)


def test_wrong_options_of_the_command_are_refused(tmp_path):
    assert_fails(2, "scan: expects RINGSxCOLUMNS such as 64x1024, got '64'", "simulate", tmp_path / "a", "--scan", "64")
    assert_fails(2, "scan_view: expects 2 numbers", "simulate", tmp_path / "a", "--scan-view", "5")


@long
def test_a_run_of_the_logs_needs_no_option_and_agrees_with_the_truth(tmp_path):
    size = ("--robots", 2, "--duration", 6, "--world-size", 40, "--seed", 1)
    done = octoreplay("simulate", "team", "--sensor", "lidar", *size, folder=tmp_path)
    assert "simulated 2 robots: 48 scans" in done.stdout
    octoreplay("run", "team/team.yaml", "-o", "result.mcap", folder=tmp_path)
    [*_, last] = evaluate_result(tmp_path / "result.mcap", truth=tmp_path / "team", over_time=False).ticks
    for scores in last.maps:
        assert scores.truth is not None
        assert scores.truth.mean_iou_known > 0.6
        assert scores.truth.occupied_accuracy > 0.7
