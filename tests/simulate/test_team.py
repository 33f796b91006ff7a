"""Tests of a simulated team's logs, team file and ground truth, read from the files."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation, Slerp

from fixtures.make_fixtures import FIXTURES
from octoreplay.config.frames_file import load_frames_file
from octoreplay.config.robot import RobotConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.errors import ConfigError, OutputError
from octoreplay.geodesy import enu_points
from octoreplay.io.datasets.pose_files import read_tum_track
from octoreplay.simulate import team
from octoreplay.simulate.body_poses import midway, pose_errors
from octoreplay.simulate.odometry import FIX_ORIGIN, drift_corrections
from octoreplay.simulate.recorder import START_NS
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team
from octoreplay.simulate.village import make_village
from octoreplay.simulate.world import village_classes
from octoreplay.transforms import transform_of
from support.long_suite import long, one_in
from support.stored_messages import matrix, pixels, read_messages, stamp_ns

COMMITTED = Path(__file__).resolve().parents[1] / "fixtures"
FILES = ("frames.yaml", "husky_1.mcap", "husky_2.mcap", "team.yaml", "truth", "world.npz", "world.ply")
SMALL = SimulationConfig(num_robots=2, duration=3.0, rate=5.0, image=(32, 24), seed=5, world_size=24.0)
CLEAN = dataclasses.replace(SMALL, label_noise=0.0)
EXACT = SimulationConfig(
    num_robots=2, duration=6.0, rate=2.0, image=(80, 60), seed=6, world_size=24.0, label_noise=0.0, depth_noise=0.0
)


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("small") / "team"
    simulate_team(folder, SMALL)
    return folder


@pytest.fixture(scope="module")
def clean(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("clean") / "team"
    simulate_team(folder, CLEAN)
    return folder


@pytest.fixture(scope="module")
def own(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("own") / "team"
    simulate_team(folder, dataclasses.replace(EXACT, own_frames=True))
    return folder


def logged_poses(messages, robot_id: str) -> np.ndarray:
    """Poses (T, 4, 4) of a robot's odometry."""
    poses = [odometry.pose.pose for _, odometry in messages[f"/{robot_id}/odom"]]
    return np.array([matrix(pose.position, pose.orientation) for pose in poses])


def true_poses(folder: Path, robot_id: str) -> np.ndarray:
    """Poses (T, 4, 4) of a robot's TUM file."""
    track = read_tum_track(folder / "truth" / f"{robot_id}.tum")
    return np.array([track.matrix_at(stamp, 0) for stamp in track.stamps_ns.tolist()])


def camera_pose(messages, robot_id: str, stamp: int) -> np.ndarray:
    """Camera pose in the frame of the logged poses, interpolated between two of them."""
    stamps = np.array([t for t, _ in messages[f"/{robot_id}/odom"]])
    k = int(np.searchsorted(stamps, stamp, side="right")) - 1
    first, second = (messages[f"/{robot_id}/odom"][i][1].pose.pose for i in (k, k + 1))
    a, b = matrix(first.position, first.orientation), matrix(second.position, second.orientation)
    share = (stamp - stamps[k]) / (stamps[k + 1] - stamps[k])
    T = np.eye(4)
    T[:3, :3] = Slerp([0, 1], Rotation.from_matrix([a[:3, :3], b[:3, :3]]))(share).as_matrix()
    T[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    [(_, static)] = messages["/tf_static"]
    mount = static.transforms[0].transform
    return T @ matrix(mount.translation, mount.rotation)


def measured_points(messages, robot_id: str, max_range: float = 10.0):
    """World points (P, 3) and raw labels (P,) of all frames, within a range."""
    labels = dict(messages[f"/{robot_id}/camera/labels/image_raw"])
    info = messages[f"/{robot_id}/camera/depth/camera_info"][0][1]
    for stamp, image in messages[f"/{robot_id}/camera/depth/image_raw"]:
        depth = pixels(image) / 1000.0
        v, u = np.nonzero(depth)
        z = depth[v, u]
        points = np.stack([(u - info.k[2]) / info.k[0] * z, (v - info.k[5]) / info.k[4] * z, z], axis=1)
        near = np.linalg.norm(points, axis=1) < max_range
        T = camera_pose(messages, robot_id, stamp)
        yield points[near] @ T[:3, :3].T + T[:3, 3], pixels(labels[stamp])[v, u][near]


def truth_of(folder: Path) -> tuple[dict[tuple[int, ...], int], float]:
    with np.load(folder / "world.npz") as archive:
        keys, class_ids, resolution = archive["keys"].tolist(), archive["class_ids"].tolist(), archive["resolution"]
    return dict(zip(map(tuple, keys), class_ids, strict=True)), float(resolution)


def test_the_folder_has_the_documented_files(small):
    names = sorted(path.name for path in small.iterdir())
    assert names == ["husky_1.mcap", "husky_2.mcap", "team.yaml", "world.npz", "world.ply"]


def test_rosbags_reads_the_logs(small):
    with AnyReader([small / "husky_2.mcap"]) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
    frames = 15
    assert counts == {
        "/husky_2/camera/depth/image_raw": frames,
        "/husky_2/camera/depth/camera_info": frames,
        "/husky_2/camera/labels/image_raw": frames,
        "/husky_2/labels/label_info": 1,
        "/husky_2/odom": 61,
        "/tf": 61,
        "/tf_static": 1,
    }


def test_the_team_file_is_read_back_and_moves_with_its_folder(small):
    config = load_team_file(small / "team.yaml")
    assert [robot.robot_id for robot in config.robots] == ["husky_1", "husky_2"]
    assert [robot.logs for robot in config.robots] == [(small / f"husky_{k}.mcap",) for k in (1, 2)]
    assert config.classes == village_classes()
    assert config.map.resolution == 0.3
    assert str(small) not in (small / "team.yaml").read_text()
    for robot in config.robots:
        topics = read_messages(robot.logs[0])
        named = (
            robot.depth_topic,
            robot.label_topic,
            robot.camera_info_topic,
            robot.pose_topic,
            robot.label_info_topic,
        )
        assert all(topic in topics for topic in named)


def test_stamps_are_fixed_ordered_and_paired(small):
    messages = read_messages(small / "husky_1.mcap")
    odometry = [stamp_ns(m) for _, m in messages["/husky_1/odom"]]
    assert odometry[0] == START_NS
    assert set(np.diff(odometry)) == {50_000_000}
    depth = [stamp_ns(m) for _, m in messages["/husky_1/camera/depth/image_raw"]]
    assert depth == [stamp_ns(m) for _, m in messages["/husky_1/camera/labels/image_raw"]]
    assert set(np.diff(depth)) == {200_000_000}
    assert odometry[0] < depth[0] < depth[-1] < odometry[-1]
    # Images are never at the stamp of a pose, so that poses have to be interpolated.
    assert not set(depth) & set(odometry)
    for found in messages.values():
        assert all(t == stamp_ns(m) for t, m in found if hasattr(m, "header"))


def test_robots_take_images_at_different_times(small):
    stamps = [
        {stamp_ns(m) for _, m in read_messages(small / f"{r}.mcap")[f"/{r}/camera/depth/image_raw"]}
        for r in ("husky_1", "husky_2")
    ]
    assert not stamps[0] & stamps[1]


def test_odometry_and_tf_have_equal_poses_and_the_twist_is_their_derivative(small):
    messages = read_messages(small / "husky_1.mcap")
    poses = []
    for (_, odometry), (_, tf) in zip(messages["/husky_1/odom"], messages["/tf"], strict=True):
        pose, transform = odometry.pose.pose, tf.transforms[0].transform
        poses.append(matrix(pose.position, pose.orientation))
        np.testing.assert_array_equal(poses[-1], matrix(transform.translation, transform.rotation))
    speeds = np.array([m.twist.twist.linear.x for _, m in messages["/husky_1/odom"]])
    moved = np.linalg.norm(np.diff([T[:2, 3] for T in poses], axis=0), axis=1)
    np.testing.assert_allclose(speeds[:-1] * 0.05, moved, atol=1e-9)
    assert speeds.max() > 0.5


@long
def test_pose_errors_are_stationary_and_change_over_ten_seconds():
    errors = pose_errors(0.5, 400_000, 0.05, np.random.default_rng(0))
    np.testing.assert_allclose(errors.std(axis=0), [0.5, 0.5, 0.05], rtol=0.05)
    starts = np.array([pose_errors(0.5, 1, 0.05, np.random.default_rng(seed))[0] for seed in range(1000)])
    np.testing.assert_allclose(starts.std(axis=0), [0.5, 0.5, 0.05], rtol=0.1)
    # Ten seconds are 200 steps, after which the correlation is 1 / e.
    correlation = [np.corrcoef(errors[:-200, axis], errors[200:, axis])[0, 1] for axis in range(3)]
    np.testing.assert_allclose(correlation, np.exp(-1.0), atol=0.05)
    assert not pose_errors(0.0, 100, 0.05, np.random.default_rng(0)).any()


def test_pose_noise_changes_the_recorded_poses_only(small, tmp_path):
    simulate_team(tmp_path / "team", dataclasses.replace(SMALL, pose_noise=0.3))
    exact, noisy = (read_messages(folder / "husky_1.mcap") for folder in (small, tmp_path / "team"))
    for topic in ("/husky_1/camera/depth/image_raw", "/husky_1/camera/labels/image_raw"):
        pairs = zip(exact[topic], noisy[topic], strict=True)
        assert all(np.array_equal(one.data, other.data) for (_, one), (_, other) in pairs)
    pairs = zip(exact["/husky_1/odom"], noisy["/husky_1/odom"], strict=True)
    moved = [abs(one.pose.pose.position.x - other.pose.pose.position.x) for (_, one), (_, other) in pairs]
    assert 0.01 < np.mean(moved) < 1.5
    # The true poses are those of the team without noise.
    np.testing.assert_allclose(logged_poses(exact, "husky_1"), true_poses(tmp_path / "team", "husky_1"), atol=1e-9)
    assert load_frames_file(tmp_path / "team" / "frames.yaml")["husky_1"] == (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def test_fixes_are_at_the_true_positions_each_second(small, tmp_path):
    simulate_team(tmp_path / "team", dataclasses.replace(SMALL, fixes=0.01))
    assert load_team_file(tmp_path / "team" / "team.yaml").robots[1].fix_topic == "/husky_2/fix"
    messages = read_messages(tmp_path / "team" / "husky_2.mcap")
    fixes = messages.pop("/husky_2/fix")
    assert messages.keys() == read_messages(small / "husky_2.mcap").keys()
    geodetic = np.array([(fix.latitude, fix.longitude, fix.altitude) for _, fix in fixes])
    true = logged_poses(messages, "husky_2")[::20, :3, 3]
    np.testing.assert_allclose(enu_points(geodetic, FIX_ORIGIN), true, atol=0.08)
    assert [time for time, _ in fixes] == [START_NS + k * 10**9 for k in range(4)]
    for _, fix in fixes:
        assert fix.header.frame_id == "husky_2/base_link"
        assert fix.position_covariance[::4] == pytest.approx((1e-4, 1e-4, 4e-4))


def test_kinds_divide_every_class_of_images_and_truth(small, tmp_path):
    simulate_team(tmp_path / "team", dataclasses.replace(SMALL, kinds_per_class=4))
    names = load_team_file(tmp_path / "team" / "team.yaml").classes.names
    assert len(names) == 32
    assert names[:5] == ("grass_1", "grass_2", "grass_3", "grass_4", "dirt_road_1")
    (whole, _), (split, _) = truth_of(small), truth_of(tmp_path / "team")
    assert whole.keys() == split.keys()
    # At the border of two kinds the majority in a cell may be another one.
    same = [whole[key] == (split[key] - 1) // 4 + 1 for key in whole]
    assert np.mean(same) > 0.98
    assert len(set(split.values())) > 12


def test_own_frames_start_at_the_robots_first_poses_and_differ_in_yaw(own):
    frames = {robot_id: transform_of(numbers) for robot_id, numbers in load_frames_file(own / "frames.yaml").items()}
    yaws = [np.arctan2(T[1, 0], T[0, 0]) for T in frames.values()]
    assert abs(yaws[0] - yaws[1]) > 0.1
    for robot_id, T_team_map in frames.items():
        messages = read_messages(own / f"{robot_id}.mcap")
        assert {odometry.header.frame_id for _, odometry in messages[f"/{robot_id}/odom"]} == {f"{robot_id}/odom"}
        assert {tf.transforms[0].header.frame_id for _, tf in messages["/tf"]} == {f"{robot_id}/odom"}
        logged, true = logged_poses(messages, robot_id), true_poses(own, robot_id)
        np.testing.assert_allclose(logged[0, :3, 3], 0.0, atol=1e-9)
        assert logged[0, 0, 0] > 0.99
        np.testing.assert_allclose(T_team_map @ logged, true, atol=1e-9)
    config = load_team_file(own / "team.yaml")
    assert all(robot.T_team_map == RobotConfig("a", (Path("a"),)).T_team_map for robot in config.robots)


@pytest.mark.parametrize("own_frames", [False, pytest.param(True, marks=long)])
def test_removing_frame_and_drift_gives_the_true_poses(small, tmp_path, own_frames):
    config = dataclasses.replace(SMALL, odometry_drift=(3.0, 4.0), own_frames=own_frames)
    folder = tmp_path / "team"
    simulate_team(folder, config)
    assert tuple(sorted(path.name for path in folder.iterdir())) == FILES
    frames = load_frames_file(folder / "frames.yaml")
    for index, robot_id in enumerate(config.robot_ids):
        messages, true = read_messages(folder / f"{robot_id}.mcap"), true_poses(folder, robot_id)
        logged = transform_of(frames[robot_id]) @ logged_poses(messages, robot_id)
        drift = drift_corrections(true, 3.0, 4.0, np.random.default_rng([config.seed, 4, index]))
        np.testing.assert_allclose(np.linalg.inv(drift) @ logged, true, atol=1e-9)
        np.testing.assert_allclose(logged[0], true[0], atol=1e-9)
        assert np.abs(logged[-1] - true[-1]).max() > 1e-3
    if not own_frames:
        # Drift changes the recorded poses only, and the frame of the poses is the village's.
        exact = read_messages(small / "husky_1.mcap")
        np.testing.assert_allclose(logged_poses(exact, "husky_1"), true_poses(folder, "husky_1"), atol=1e-9)
        assert frames["husky_1"] == (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        assert (folder / "team.yaml").read_bytes() == (small / "team.yaml").read_bytes()
        images = "/husky_1/camera/depth/image_raw"
        pairs = zip(exact[images], read_messages(folder / "husky_1.mcap")[images], strict=True)
        assert all(np.array_equal(one.data, other.data) for (_, one), (_, other) in pairs)


def test_patchy_noise_has_the_given_share_and_is_the_same_in_every_image(clean, tmp_path):
    simulate_team(tmp_path / "patchy", dataclasses.replace(CLEAN, patchy_noise=0.3))
    wrong: dict[tuple[int, ...], list[bool]] = defaultdict(list)
    images, patchy = (read_messages(folder / "husky_1.mcap") for folder in (clean, tmp_path / "patchy"))
    pairs = zip(measured_points(images, "husky_1"), measured_points(patchy, "husky_1"), strict=True)
    for (points, labels), (same_points, noisy) in pairs:
        np.testing.assert_array_equal(points, same_points)
        for cube, is_wrong in zip(np.floor(points / 2.0).astype(int).tolist(), labels != noisy, strict=True):
            wrong[tuple(cube)].append(bool(is_wrong))
    shares = np.array([np.mean(found) for found in wrong.values()])
    assert len(shares) > 50
    assert 0.15 < (shares > 0.5).mean() < 0.45
    # Depth noise moves some points to a neighbouring cube.
    assert (np.minimum(shares, 1.0 - shares) < 0.25).mean() > 0.8


def test_robots_stand_on_the_ground(small):
    terrain = make_village(SMALL.world_size, SMALL.seed).terrain
    for _, odometry in read_messages(small / "husky_1.mcap")["/husky_1/odom"]:
        T = matrix(odometry.pose.pose.position, odometry.pose.pose.orientation)
        assert T[2, 3] == pytest.approx(terrain.height(T[:2, 3]) + 0.13, abs=1e-9)
        np.testing.assert_allclose(T[:3, 2], terrain.normal(T[:2, 3]), atol=1e-9)


def test_points_of_exact_images_in_the_frames_of_frames_yaml_are_in_the_ground_truth(own):
    truth, resolution = truth_of(own)
    frames = load_frames_file(own / "frames.yaml")
    assert tuple(frames) == EXACT.robot_ids
    total = known = agreed = 0
    for robot_id, numbers in frames.items():
        T_team_map = transform_of(numbers)
        for points, labels in measured_points(read_messages(own / f"{robot_id}.mcap"), robot_id):
            keys = np.floor((points @ T_team_map[:3, :3].T + T_team_map[:3, 3]) / resolution).astype(int).tolist()
            found = np.array([truth.get(tuple(key), 0) for key in keys])
            total += len(found)
            known += int((found > 0).sum())
            agreed += int((found == labels).sum())
    assert total > 20_000
    # Rounding to millimetres moves points at a cell's face into the neighbouring cell.
    assert known / total > 0.99
    assert agreed / known > 0.95


def test_label_noise_has_the_given_share(small, clean):
    topic = "/husky_1/camera/labels/image_raw"
    noisy, true = (
        np.stack([pixels(m) for _, m in read_messages(folder / "husky_1.mcap")[topic]]) for folder in (small, clean)
    )
    np.testing.assert_array_equal(noisy == 255, true == 255)
    measured = true != 255
    assert (noisy != true)[measured].mean() == pytest.approx(0.1, abs=0.015)
    depth = np.stack([pixels(m) for _, m in read_messages(small / "husky_1.mcap")["/husky_1/camera/depth/image_raw"]])
    np.testing.assert_array_equal(depth == 0, noisy == 255)


def test_equal_settings_give_equal_bytes_and_other_seeds_do_not(small, tmp_path):
    simulate_team(tmp_path / "again", SMALL)
    for path in small.iterdir():
        assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes(), path.name
    simulate_team(tmp_path / "other", SimulationConfig(**{**vars(SMALL), "seed": 99}))
    assert (tmp_path / "other" / "husky_1.mcap").read_bytes() != (small / "husky_1.mcap").read_bytes()
    assert (tmp_path / "other" / "world.npz").read_bytes() != (small / "world.npz").read_bytes()


def test_summary_and_progress(tmp_path):
    shares: list[float] = []
    (tmp_path / "empty").mkdir()
    summary = simulate_team(tmp_path / "empty", SMALL, shares.append)
    assert summary.num_frames == 30
    assert summary.team_file == tmp_path / "empty" / "team.yaml"
    assert summary.num_bytes == sum(path.stat().st_size for path in (tmp_path / "empty").iterdir())
    assert summary.num_cells == len(truth_of(tmp_path / "empty")[0])
    assert all(log.is_file() for log in summary.logs)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_a_folder_that_is_not_empty_is_refused_and_kept(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="is not empty; use a new folder"):
        simulate_team(tmp_path, SMALL)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    with pytest.raises(OutputError, match=r"notes\.txt: is a file"):
        simulate_team(tmp_path / "notes.txt", SMALL)
    with pytest.raises(OutputError, match="cannot be written"):
        simulate_team(tmp_path / "notes.txt" / "team", SMALL)


@pytest.mark.parametrize(
    ("error", "exists"), one_in(3, [KeyboardInterrupt, OSError(28, "No space left on device")], [True, False])
)
def test_a_failed_simulation_removes_its_files(tmp_path, monkeypatch, error, exists):
    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr(team, "explore", fail)
    folder = tmp_path / "team"
    if exists:
        folder.mkdir()
    with pytest.raises(KeyboardInterrupt if error is KeyboardInterrupt else OutputError):
        simulate_team(folder, SMALL)
    assert folder.exists() == exists
    assert not list(tmp_path.rglob("*.*"))


@pytest.mark.parametrize(
    "options",
    [{"num_robots": 0}, {"duration": 0.5}, {"rate": 0.0}, {"image": (4, 120)}, {"image": (160, 1)}, {"seed": -1},
     {"resolution": 0.0}, {"label_noise": 1.5}, {"patchy_noise": 1.5}, {"fixes": 0.0}, {"odometry_drift": (101.0, 0.0)},
     {"odometry_drift": (0.0, -1.0)}, {"world_size": 5.0}, {"max_depth": 66.0}, {"duration": float("nan")}],
)  # fmt: skip
def test_options_out_of_range_are_refused_by_name(options):
    name = next(iter(options))
    with pytest.raises(ConfigError, match=rf"{name}.*is not between"):
        SimulationConfig(**options)


def test_the_camera_has_the_documented_intrinsics(small):
    camera = SimulationConfig().camera
    assert (camera.width, camera.height, camera.fx, camera.fy) == (160, 120, 65.25, 65.25)
    assert (camera.cx, camera.cy) == (79.5, 59.5)
    info = read_messages(small / "husky_1.mcap")["/husky_1/camera/depth/camera_info"][0][1]
    np.testing.assert_allclose(info.k, [13.05, 0, 15.5, 0, 13.05, 11.5, 0, 0, 1])


@pytest.mark.parametrize("rate", [0.5, 3.0, 4.0, 30.0])
def test_every_rate_gives_its_number_of_images(tmp_path, rate):
    config = SimulationConfig(num_robots=1, duration=4.0, rate=rate, image=(8, 6), world_size=20.0, resolution=1.0)
    assert abs(simulate_team(tmp_path / "team", config).num_frames - 4.0 * rate) <= 1


def test_midway_is_slerp_at_one_half():
    rng = np.random.default_rng(0)
    for _ in range(20):
        a, b = np.eye(4), np.eye(4)
        first = Rotation.random(random_state=rng.integers(1000))
        second = first * Rotation.from_rotvec(rng.uniform(-1.0, 1.0, 3))
        a[:3, :3], b[:3, :3] = first.as_matrix(), second.as_matrix()
        a[:3, 3], b[:3, 3] = rng.normal(size=(2, 3))
        middle = midway(a, b)
        expected = Slerp([0, 1], Rotation.concatenate([first, second]))(0.5).as_matrix()
        np.testing.assert_allclose(middle[:3, :3], expected, atol=1e-12)
        np.testing.assert_allclose(middle[:3, 3], (a[:3, 3] + b[:3, 3]) / 2)


@pytest.mark.long
def test_no_robot_of_the_default_team_sees_more_than_its_share(tmp_path):
    # Small images, with the default village, team, camera and duration.
    config = SimulationConfig(image=(40, 30), rate=1.0)
    simulate_team(tmp_path / "team", config)
    cells = []
    for robot_id in config.robot_ids:
        messages = read_messages(tmp_path / "team" / f"{robot_id}.mcap")
        points = np.concatenate([points for points, _ in measured_points(messages, robot_id)])
        cells.append({tuple(key) for key in np.unique(np.floor(points / 0.6).astype(int), axis=0).tolist()})
    together = set.union(*cells)
    assert len(together) > 10_000
    assert max(len(own) for own in cells) < 0.4 * len(together)
    assert sum(len(own) for own in cells) > 1.1 * len(together)


@pytest.mark.parametrize("name", sorted(FIXTURES))
def test_the_committed_fixtures_match_their_script(name):
    folder, config = COMMITTED / name, FIXTURES[name]
    stored = load_team_file(folder / "team.yaml")
    assert [robot.robot_id for robot in stored.robots] == list(config.robot_ids)
    assert {path.name for path in folder.iterdir()} == {f"{r}.mcap" for r in config.robot_ids} | {
        "team.yaml",
        "world.npz",
    }
    for path in folder.iterdir():
        assert path.stat().st_size < 200_000
    for robot in stored.robots:
        messages = read_messages(robot.logs[0])
        assert len(messages[robot.depth_topic]) == round(config.duration * config.rate)
        first = messages[robot.depth_topic][0][1]
        assert (first.width, first.height) == config.image
