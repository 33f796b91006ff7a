"""Odometry of simulated LiDARs and depth cameras: errors against the truth, quality, and scenes without features."""

from __future__ import annotations

import json
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation

from octoreplay.config.team_file import load_team_file
from octoreplay.io.datasets.pose_files import read_tum_track
from octoreplay.io.robots.robot_log_writer import OPTICAL_IN_BODY
from octoreplay.io.robots.trajectories import Trajectory
from octoreplay.records import Float64Array
from octoreplay.result import open_result
from octoreplay.transforms import pose_matrix
from support.command_line import assert_fails, octoreplay
from support.fixture_paths import PAIR
from support.lidar_log import (
    MOUNT,
    START,
    Drive,
    Imu,
    aligned_error,
    base_pose,
    boxes,
    plain,
    room,
    swaying_turn,
    write_drive,
)
from support.log_factory import SECOND, Entry, ros2, write_mcap
from support.long_suite import long

pytestmark = long


def matrices(track: Trajectory) -> Float64Array:
    """Poses (n, 4, 4) of a trajectory."""
    return np.array([pose_matrix(*pose) for pose in zip(track.positions, track.rotations, strict=True)])


def estimated(drive: Drive, *options: object, code: int = 0) -> tuple[Float64Array, dict, str]:
    """Poses of a drive by odometry, the JSON document and the warnings."""
    output = drive.log.with_suffix(".tum")
    done = octoreplay("odometry", drive.log, "-o", output, "--force", "--json", *options)
    assert done.returncode == code, done.stderr
    return matrices(read_tum_track(output)), json.loads(done.stdout), done.stderr


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    return write_drive(tmp_path_factory.mktemp("room") / "husky.mcap", room(), num_scans=60)


def lidar_truth(drive: Drive) -> Float64Array:
    """True poses of the LiDAR."""
    mount = np.eye(4)
    mount[:3, 3] = MOUNT
    return drive.poses @ mount


def test_a_lidar_is_located_within_five_centimetres(drive: Drive) -> None:
    poses, document, _ = estimated(drive)
    assert aligned_error(poses, lidar_truth(drive)) < 0.05
    quality = document["quality"]
    assert quality["num_scans"] == quality["num_registered"] == 60
    assert quality["length"] == pytest.approx(
        np.linalg.norm(np.diff(drive.poses[:, :3, 3], axis=0), axis=1).sum(), rel=0.1
    )
    assert read_tum_track(drive.log.with_suffix(".tum")).stamps_ns.tolist() == drive.stamps_ns
    # The map is the robot's base at the first scan, so that the LiDAR begins at its mount.
    np.testing.assert_allclose(poses[0][:3, 3], MOUNT, atol=1e-9)
    assert (document["frame"], document["map_begins_at"]) == ("lidar", "base_link")


def test_the_same_log_gives_the_same_bytes(drive: Drive) -> None:
    estimated(drive, "--duration", "2")
    first = drive.log.with_suffix(".tum").read_bytes()
    estimated(drive, "--duration", "2")
    assert drive.log.with_suffix(".tum").read_bytes() == first


def fast_turn(seconds: float) -> Float64Array:
    """T_world_base of a robot that turns at 2 rad/s, so that a sweep without compensation is skewed by 11 degrees."""
    T = np.eye(4)
    angle = 2.0 * seconds
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[:3, 3] = 0.5 * seconds, 0.0, 0.0
    return T


def test_times_of_points_undo_the_motion_in_a_sweep(tmp_path: Path) -> None:
    errors = {}
    for times in ("t", "time", "timestamp", None):
        turn = write_drive(tmp_path / f"{times}.mcap", room(), num_scans=25, times=times, pose=fast_turn)
        errors[times] = aligned_error(estimated(turn)[0], lidar_truth(turn))
    assert max(errors["t"], errors["time"], errors["timestamp"]) < 0.05
    assert errors[None] > errors["t"]


def test_wheel_odometry_is_the_expected_motion(tmp_path: Path) -> None:
    wheeled = write_drive(tmp_path / "w.mcap", room(), num_scans=20, wheels=0.05)
    poses, document, _ = estimated(wheeled)
    assert (document["guess"], document["quality"]["num_by_wheels"]) == ("/wheels", 19)
    assert aligned_error(poses, lidar_truth(wheeled)) < 0.05
    assert estimated(wheeled, "--guess", "none")[1]["guess"] is None
    sentence = "'/wheel' is no topic of odometry or of an IMU; did you mean '/wheels'"
    assert_fails(1, sentence, "odometry", wheeled.log, "-o", tmp_path / "x.tum", "--guess", "/wheel")


def test_an_imu_reduces_the_error_of_fast_turns(tmp_path: Path) -> None:
    imu = Imu(bias=(0.0, 0.0, 0.01))
    turning = write_drive(tmp_path / "t.mcap", room(), num_scans=50, pose=swaying_turn, imu=imu)
    poses, document, _ = estimated(turning)
    assert (document["guess"], document["is_level"], document["quality"]["num_by_imu"]) == ("/imu", True, 49)
    without, document, _ = estimated(turning, "--guess", "none")
    assert (document["guess"], document["is_level"]) == (None, False)
    error = aligned_error(poses, lidar_truth(turning))
    assert error < 0.04
    assert error < 0.75 * aligned_error(without, lidar_truth(turning))


def test_a_tilted_mount_without_a_transform_is_levelled(tmp_path: Path) -> None:
    def straight(seconds: float) -> Float64Array:
        """At rest for 1 s, then forward."""
        T = np.eye(4)
        T[0, 3] = 0.5 * max(seconds - 1.0, 0.0)
        return T

    mount = Rotation.from_euler("xy", (10, 15), degrees=True).as_matrix()
    tilted = write_drive(
        tmp_path / "t.mcap", room(), num_scans=30, pose=straight, mount=mount, imu=Imu(), with_tf=False
    )
    for options, is_level in (((), True), (("--guess", "none"), False)):
        poses, document, _ = estimated(tilted, *options)
        up = poses[:, :3, :3] @ mount.T @ (0.0, 0.0, 1.0)
        tilt = np.degrees(np.arccos(np.clip(up[:, 2], -1.0, 1.0)))
        assert document["is_level"] == is_level
        assert (tilt.max() < 1.0) == is_level


def test_an_imu_without_a_transform_is_named_and_not_used(tmp_path: Path) -> None:
    log = write_drive(tmp_path / "i.mcap", room(), num_scans=5, imu=Imu(frame="imu_link"))
    _, document, stderr = estimated(log)
    assert document["guess"] is None
    assert "the IMU '/imu' was not used: no fixed transform in TF joins its frame 'imu_link'" in stderr
    sentence = "joins the frame 'imu_link' of '/imu' to the sensor's frame 'lidar'"
    assert_fails(1, sentence, "odometry", log.log, "-o", tmp_path / "x.tum", "--guess", "/imu")


def test_poses_of_the_base_are_those_of_the_sensor_and_its_mount(drive: Drive) -> None:
    sensor, _, _ = estimated(drive, "--duration", "1")
    base, document, _ = estimated(drive, "--duration", "1", "--frame", "base_link")
    mount = np.eye(4)
    mount[:3, 3] = MOUNT
    np.testing.assert_allclose(base @ mount, sensor, atol=1e-9)
    assert document["frame"] == "base_link"
    np.testing.assert_allclose(base[0], np.eye(4), atol=1e-9)
    assert_fails(1, "no fixed transform in TF joins 'arm' to the sensor's frame 'lidar'", "odometry", drive.log, "-o",
                 drive.log.with_name("x.tum"), "--frame", "arm")  # fmt: skip


@pytest.mark.parametrize("frame", [None, "base_link"])
def test_a_run_with_the_trajectory_gives_the_map_of_the_true_poses(
    drive: Drive, tmp_path: Path, frame: str | None
) -> None:
    from octoreplay.io.datasets.pose_files import write_tum

    team = tmp_path / "team.yaml"
    options = () if frame is None else ("--frame", frame)
    done = octoreplay("odometry", drive.log, "-o", tmp_path / "h.tum", "--save-team", team, *options)
    assert done.returncode == 0, done.stderr
    write_tum(tmp_path / "true.tum", drive.stamps_ns, np.linalg.inv(drive.poses[0]) @ lidar_truth(drive))
    [robot] = load_team_file(team).robots
    true_team = f"robots: [{{id: husky, log: {drive.log}, cloud_topic: /points, pose_file: true.tum}}]"
    (tmp_path / "true.yaml").write_text(true_team)
    occupied = []
    for name in ("team.yaml", "true.yaml"):
        out = tmp_path / f"{name}.mcap"
        done = octoreplay(
            "run", tmp_path / name, "-o", out, "--resolution", "0.4", "--settle", "0", "--max-range", "20"
        )
        assert done.returncode == 0, done.stderr
        with open_result(out) as result:
            leaves = result.map(robot.robot_id).leaves()
            cells = np.floor(leaves.centers[leaves.log_odds.max(axis=1) > 0] / 0.4).astype(int)
            occupied.append({*map(tuple, cells)})
    ours, true = occupied
    near = {(x + i, y + j, z + k) for x, y, z in true for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)}
    assert len(true) > 500
    assert len(ours & near) > 0.97 * len(ours)
    assert len(ours & true) > 0.6 * len(ours | true)


def test_a_laser_scanner_is_located(tmp_path: Path) -> None:
    scanner = write_drive(tmp_path / "s.mcap", room(), num_scans=30, columns=720, is_scan=True)
    poses, document, _ = estimated(scanner)
    assert document["topic"] == "/scan"
    assert aligned_error(poses, lidar_truth(scanner)) < 0.06


def test_a_floor_without_end_gives_no_trajectory(tmp_path: Path) -> None:
    floor = write_drive(tmp_path / "f.mcap", plain(), num_scans=12)
    output = tmp_path / "f.tum"
    sentence = "only 1 of 12 scans of '/points' could be registered; 11 of them leave a direction of motion open"
    assert_fails(1, sentence, "odometry", floor.log, "-o", output)
    assert not output.exists()


def test_scans_without_features_have_no_pose(tmp_path: Path) -> None:
    def leaving(seconds: float) -> Float64Array:
        """Out of the room through its wall, into nothing, for the last scans."""
        T = np.eye(4)
        T[:3, 3] = (0.0, -2.0, 0.0) if seconds < 2.0 else (300.0, 0.0, 0.0)
        return T

    gone = write_drive(tmp_path / "g.mcap", room(), num_scans=24, pose=leaving)
    poses, document, stderr = estimated(gone, code=3)
    assert len(poses) == document["quality"]["num_registered"] == 20
    assert document["quality"]["num_low_overlap"] == 4
    assert "4 of 24 scans have no pose (stamps 102.000 s to 102.300 s)" in stderr


def test_a_long_loss_begins_a_new_local_map(tmp_path: Path) -> None:
    def absent(seconds: float) -> Float64Array:
        """In the room, but outside of every wall for 0.8 s."""
        T = base_pose(seconds)
        T[0, 3] += 300.0 if 0.95 < seconds < 1.75 else 0.0
        return T

    _, document, stderr = estimated(write_drive(tmp_path / "k.mcap", room(), num_scans=30, pose=absent), code=3)
    quality = document["quality"]
    assert (quality["num_registered"], quality["num_low_overlap"], quality["num_breaks"]) == (23, 7, 1)
    assert "the local map began again 1 times" in stderr


def test_a_depth_camera_is_located(tmp_path: Path) -> None:
    """A camera that looks at furniture and corners of the room, 15 images a second with 3 mm of noise."""
    width, height, focal, scene = 160, 120, 100.0, room()
    rng = np.random.default_rng(0)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([(u - width / 2) / focal, (v - height / 2) / focal, np.ones(u.shape)], axis=-1)
    mount = np.eye(4)
    mount[:3, :3], mount[:3, 3] = OPTICAL_IN_BODY, (0.2, 0.0, 0.8)
    entries, true = [], []
    for index in range(45):
        stamp, T = START + index * SECOND // 15, base_pose(1.0 + index / 15) @ mount
        world = np.concatenate([np.broadcast_to(T[:3, 3], rays.shape), rays @ T[:3, :3].T], axis=-1)
        depth = scene.cast_rays(o3d.core.Tensor(world.astype(np.float32)))["t_hit"].numpy()
        depth = np.rint(1000 * depth + 3 * rng.standard_normal(depth.shape)).astype(np.uint16)
        info = ros2.camera_info(stamp, (width, height), k=(focal, 0, width / 2, 0, focal, height / 2, 0, 0, 1))
        image = ros2.image(stamp, depth, "16UC1", frame_id="camera")
        entries.append(Entry("/depth/camera_info", "sensor_msgs/msg/CameraInfo", info, stamp))
        entries.append(Entry("/depth/image", "sensor_msgs/msg/Image", image, stamp))
        true.append(T)
    output = tmp_path / "c.tum"
    done = octoreplay("odometry", write_mcap(tmp_path / "c.mcap", entries), "-o", output, "--max-range", "20", "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["sensor"] == "depth"
    found = read_tum_track(output)
    places = [
        (stamp - START) * 15 // SECOND + ((stamp - START) * 15 % SECOND > 0) for stamp in found.stamps_ns.tolist()
    ]
    assert aligned_error(matrices(found), np.array(true)[places]) < 0.05


def test_one_scan_is_not_enough(tmp_path: Path) -> None:
    single = write_drive(tmp_path / "one.mcap", room(), num_scans=1)
    assert_fails(1, "topic '/points' has 1 usable scan, and odometry needs two", "odometry", single.log, "-o",
                 tmp_path / "one.tum")  # fmt: skip


def test_wrong_use_is_refused(drive: Drive, tmp_path: Path) -> None:
    out = tmp_path / "x.tum"
    assert_fails(1, "there is no depth image|no depth image", "odometry", drive.log, "-o", out, "--sensor", "depth")
    assert_fails(
        2, "'/point' holds no clouds.*did you mean '/points'", "odometry", drive.log, "-o", out, "--topic", "/point"
    )
    assert_fails(
        2, r"x\.txt: the name of the output must end in \.tum", "odometry", drive.log, "-o", tmp_path / "x.txt"
    )
    assert_fails(2, "max_speed: must be greater than 0", "odometry", drive.log, "-o", out, "--max-speed", "0")
    assert_fails(1, "no colour image has the size", "odometry", PAIR / "husky_1.mcap", "-o", out, "--sensor", "rgbd")
    assert not out.exists()


def test_a_missing_package_is_named(drive: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kiss_icp.config", None)
    sentence = re.escape("pip install 'octoreplay[odometry]'")
    assert_fails(2, sentence, "odometry", drive.log, "-o", tmp_path / "x.tum")


def test_a_corridor_is_refused(tmp_path: Path) -> None:
    corridor = write_drive(tmp_path / "c.mcap", boxes(((-100, -6, 0), (100, 6, 4))), num_scans=20)
    assert_fails(1, "leave a direction of motion open", "odometry", corridor.log, "-o", tmp_path / "c.tum")


def test_the_commands_of_the_page_map_a_raw_log(tmp_path: Path) -> None:
    """The first block of docs/odometry.md, on a LiDAR log without poses."""
    write_drive(tmp_path / "raw.mcap", room(), num_scans=20)
    page = (Path(__file__).parents[2] / "docs" / "odometry.md").read_text()
    lines = page.split("```sh\n")[1].split("```")[0].splitlines()
    commands = [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("octoreplay ")]
    assert [words[0] for words in commands] == ["odometry", "run"]
    for words in commands:
        done = octoreplay(*words, folder=tmp_path)
        assert done.returncode == 0, done.stderr
    with open_result(tmp_path / "result.mcap") as result:
        assert len(result.map("raw").leaves()) > 500


def test_info_and_init_name_the_command(tmp_path: Path) -> None:
    log = write_drive(tmp_path / "raw.mcap", room(), num_scans=2).log
    command = f"octoreplay odometry {log} -o raw.tum"
    assert command in octoreplay("info", log, "--json").stdout
    assert command in octoreplay("init", log, "-o", tmp_path / "team.yaml").stderr
    assert command in (tmp_path / "team.yaml").read_text()


def write_wall(path: Path, *, has_color: bool) -> Path:
    """A camera that moves sideways by 2 cm a frame in front of a flat wall with a pattern, 2 m away."""
    width, height, focal = 160, 120, 150.0
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    entries = []
    for index in range(15):
        stamp = START + index * SECOND // 15
        x = 2.0 * (u - width / 2) / focal + 0.02 * index
        y = 2.0 * (v - height / 2) / focal
        grey = 128 + 60 * np.sin(9 * x) * np.cos(7 * y) + 50 * np.sin(4 * x + 5 * y)
        depth = np.full((height, width), 2000, np.uint16)
        info = ros2.camera_info(stamp, (width, height), k=(focal, 0, width / 2, 0, focal, height / 2, 0, 0, 1))
        entries.append(Entry("/depth/camera_info", "sensor_msgs/msg/CameraInfo", info, stamp))
        image = ros2.image(stamp, depth, "16UC1", frame_id="camera")
        entries.append(Entry("/depth/image", "sensor_msgs/msg/Image", image, stamp))
        if has_color:
            colors = np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)
            entries.append(
                Entry(
                    "/color/image", "sensor_msgs/msg/Image", ros2.image(stamp, colors, "rgb8", frame_id="camera"), stamp
                )
            )
    return write_mcap(path, entries)


def test_colours_determine_a_motion_along_a_wall(tmp_path: Path) -> None:
    output = tmp_path / "w.tum"
    done = octoreplay("odometry", write_wall(tmp_path / "w.mcap", has_color=True), "-o", output, "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert (document["sensor"], document["color_topic"]) == ("rgbd", "/color/image")
    poses = matrices(read_tum_track(output))
    # The map's y axis points left and the camera moves to the right.
    np.testing.assert_allclose(poses[-1][:3, 3], (0.0, -0.28, 0.0), atol=0.03)
    blank = write_wall(tmp_path / "d.mcap", has_color=False)
    assert_fails(1, "leave a direction of motion open", "odometry", blank, "-o", tmp_path / "d.tum")
