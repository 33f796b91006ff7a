"""Data sets that are logs: stand-ins with the names, types and conventions of the originals, prepared and mapped."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octoreplay.config.team_file import load_team_file
from octoreplay.io.datasets.pose_files import write_tum
from support.command_line import octoreplay
from support.data_set_walls import FORWARD, WALL, depth, mapped, pose, seen
from support.log_factory import SECOND, Entry, Factory, write_bag, write_rosbag2
from support.long_suite import long

START = 1_700_000_000 * SECOND
STAMPS = [START + k * SECOND // 4 for k in range(5)]
CAMERA = (64, 48, 40.0)
UTM = (477_146.0, 4_428_491.0, 1_630.0)
CLOUD, IMAGE, INFO = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
ODOMETRY = "nav_msgs/msg/Odometry"
ros1, ros2 = Factory(ros1=True), Factory()


def clouds(factory: Factory, topic: str, side: float, frame_id: str, **columns: Any) -> list[Entry]:
    found = []
    for k, stamp in enumerate(STAMPS):
        x, y, z = seen(pose(k, side)).T
        value = factory.cloud(stamp, {"x": x, "y": y, "z": z, **columns}, frame_id=frame_id)
        found.append(Entry(topic, CLOUD, value, stamp))
    return found


def csv(path: Path, header: str, order: str, side: float, offset: tuple[float, ...] = (0, 0, 0), *, ns: bool) -> None:
    """Poses from before the first stamp to after the last, as linear as the interpolation."""
    rows = [header]
    for k, stamp in enumerate(STAMPS):
        quaternion = dict(zip("xyzw", Rotation.from_matrix(pose(k, side)[:3, :3]).as_quat(), strict=True))
        time = str(stamp) if ns else f"{stamp / 1e9:.9f}"
        position = pose(k, side)[:3, 3] + offset
        rows.append(",".join([time, *(f"{v:.9f}" for v in position), *(f"{quaternion[axis]:.12f}" for axis in order)]))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(rows) + "\n")


def kimera_multi(folder: Path) -> None:
    """Bags of two Jackals, with odometry that is not used, and ground truth at nanoseconds with w first."""
    folder.mkdir()
    for name, side in (("acl_jackal", 0.0), ("sparkal1", 0.3)):
        entries = []
        for k, stamp in enumerate(STAMPS):
            image = np.round(depth(pose(k, side) @ FORWARD, CAMERA) * 1000).astype(np.uint16)
            info = ros1.camera_info(stamp, CAMERA[:2], k=(40, 0, 31.5, 0, 40, 23.5, 0, 0, 1),
                                    p=(40, 0, 31.5, 0, 0, 40, 23.5, 0, 0, 0, 1, 0))  # fmt: skip
            optical = f"{name}/forward_depth_optical_frame"
            entries += [
                Entry(f"/{name}/forward/depth/image_rect_raw", IMAGE,
                      ros1.image(stamp, image, "16UC1", frame_id=optical), stamp),
                Entry(f"/{name}/forward/depth/camera_info", INFO, info, stamp),
                Entry(f"/{name}/jackal_velocity_controller/odom", ODOMETRY,
                      ros1.odometry(stamp, (99.0, k, 0.0), frame_id="odom"), stamp),
            ]  # fmt: skip
        write_bag(folder / f"10_14_{name}.bag", entries)
        truth = folder / "ground_truth" / "1014" / f"{name}_gt_odom.csv"
        csv(truth, "#timestamp_kf,x,y,z,qw,qx,qy,qz", "wxyz", side, ns=True)


def cu_multi(folder: Path, *, is_labelled: bool = True) -> None:
    """Two robots with topics without a leading slash and poses in UTM coordinates."""
    for name, side in (("robot1", 0.0), ("robot2", 0.3)):
        place = folder / "main_campus" / name
        csv(place / f"{name}_gt_utm_poses.csv", "# timestamp, x, y, z, qx, qy, qz, qw", "xyzw", side, UTM, ns=False)
        columns = {"label_id": np.where(np.arange(len(WALL)) % 2, 45, 50).astype(np.uint16)} if is_labelled else {}
        entries = clouds(ros2, f"{name}/ouster/points", side, f"{name}_os_sensor", **columns)
        write_rosbag2(place / f"{name}-main_campus_lidar", entries)


def s3e(folder: Path) -> None:
    """One bag of three robots, and ground truth of UTM positions with identity rotations."""
    folder.mkdir()
    entries = []
    for name, side in (("Alpha", 0.0), ("Bob", 0.3), ("Carol", -0.3)):
        entries += clouds(ros2, f"/{name}/velodyne_points", side, "velodyne")
        (folder / f"{name.lower()}_gt.txt").write_text("1700000000.25 744073.32 2553112.02 0.19 0 0 0 1\n")
    write_rosbag2(folder / "S3E_Square_1", sorted(entries, key=lambda entry: entry.log_time_ns))


def graco(folder: Path) -> None:
    """A ROS 2 bag of a ground sequence."""
    folder.mkdir()
    write_rosbag2(folder / "ground-01", clouds(ros2, "/velodyne/points", 0.0, "velodyne"))


def ntu_viral(folder: Path) -> None:
    """A bag of a flight, with positions of the prism."""
    folder.mkdir()
    entries = clouds(ros1, "/os1_cloud_node1/points", 0.0, "sensor1/os_sensor")
    entries += [Entry("/leica/pose/relative", "geometry_msgs/msg/PoseStamped",
                      ros1.pose_stamped(stamp, (0.0, k, 0.0), (0.0, 0.0, 0.0, 0.0)), stamp)
                for k, stamp in enumerate(STAMPS)]  # fmt: skip
    write_bag(folder / "eee_01.bag", sorted(entries, key=lambda entry: entry.log_time_ns))


def coped(folder: Path) -> None:
    """A bag of a ground robot with a lidar."""
    folder.mkdir()
    write_bag(folder / "wanda.bag", clouds(ros1, "/lidar_points", 0.0, "velodyne"))


def test_kimera_multi_is_prepared_and_mapped_in_the_frame_of_its_ground_truth(tmp_path):
    kimera_multi(tmp_path / "in")
    done = octoreplay("dataset", "kimera-multi", tmp_path / "in", "-o", tmp_path / "out")
    assert (done.returncode, "missing" in done.stderr) == (0, False), done.stderr
    assert "acl_jackal, sparkal1" in done.stdout
    config = load_team_file(tmp_path / "out" / "team.yaml")
    assert [robot.depth_topic for robot in config.robots] == [
        "/acl_jackal/forward/depth/image_rect_raw", "/sparkal1/forward/depth/image_rect_raw"
    ]  # fmt: skip
    assert config.sensor.max_range == 8.0
    mapped(tmp_path / "out" / "team.yaml")


@pytest.mark.parametrize("is_labelled", [True, pytest.param(False, marks=long)])
def test_cu_multi_is_mapped_near_the_origin_of_its_utm_coordinates(tmp_path, is_labelled):
    cu_multi(tmp_path / "in", is_labelled=is_labelled)
    done = octoreplay("dataset", "cu-multi", tmp_path / "in", "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    config = load_team_file(tmp_path / "out" / "team.yaml")
    assert {robot.pose_origin for robot in config.robots} == {(477_000.0, 4_428_000.0, 1_631.0)}
    names = mapped(tmp_path / "out" / "team.yaml", moved=(146.0, 491.0, -1.0))
    assert names == ({"building"} if is_labelled else {"occupied"})


@pytest.mark.parametrize(
    ("name", "make", "sides"),
    [
        ("s3e", s3e, {"Alpha": 0.0, "Bob": 0.3, "Carol": -0.3}),
        pytest.param("graco", graco, {"ground_01": 0.0}, marks=long),
        pytest.param("ntu-viral", ntu_viral, {"eee_01": 0.0}, marks=long),
        pytest.param("coped", coped, {"wanda": 0.0}, marks=long),
    ],
)
def test_a_data_set_without_usable_poses_names_the_file_for_computed_ones(
    tmp_path: Path, name: str, make: Callable[[Path], None], sides: dict[str, float]
) -> None:
    make(tmp_path / "in")
    done = octoreplay("dataset", name, tmp_path / "in", "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    for robot, side in sides.items():
        assert f"missing for a run: robot '{robot}': poses: the " in done.stderr
        assert f"store them as {tmp_path / 'out' / f'{robot}.tum'}" in done.stderr
        write_tum(tmp_path / "out" / f"{robot}.tum", STAMPS, np.array([pose(k, side) for k in range(5)]))
    config = load_team_file(tmp_path / "out" / "team.yaml")
    assert [robot.robot_id for robot in config.robots] == list(sides)
    mapped(tmp_path / "out" / "team.yaml")


def refused(name: str, folder: Path, output: Path) -> str:
    done = octoreplay("dataset", name, folder, "-o", output)
    assert (done.returncode, output.exists()) == (1, False)
    assert not list(output.parent.glob(".*"))
    return done.stderr


def test_other_folders_are_refused_with_the_file_or_the_topic_that_was_expected(tmp_path):
    output = tmp_path / "out"
    (tmp_path / "empty").mkdir()
    assert "no log found" in refused("kimera-multi", tmp_path / "empty", output)
    assert "is not a folder" in refused("kimera-multi", tmp_path / "none", output)
    graco(tmp_path / "graco")
    error = refused("ntu-viral", tmp_path / "graco", output)
    assert "a topic such as '/os1_cloud_node1/points'" in error
    assert "their topics of that kind: '/velodyne/points'" in error
    cu_multi(tmp_path / "cu", is_labelled=False)
    file = tmp_path / "cu" / "main_campus" / "robot2" / "robot2_gt_utm_poses.csv"
    (tmp_path / "cu" / "copy").mkdir()
    (tmp_path / "cu" / "copy" / file.name).write_bytes(file.read_bytes())
    assert "holds 'robot2_gt_utm_poses.csv' 2 times" in refused("cu-multi", tmp_path / "cu", output)
    (tmp_path / "cu" / "copy" / file.name).unlink()
    file.write_text("1 2 3 4\n")
    assert "holds positions without rotations" in refused("cu-multi", tmp_path / "cu", output)
    file.unlink()
    assert "'robot2_gt_utm_poses.csv' not found" in refused("cu-multi", tmp_path / "cu", output)


def test_aerial_robots_of_coped_are_refused_because_they_have_stereo_cameras_only(tmp_path):
    (tmp_path / "in").mkdir()
    image = ros1.image(START, np.zeros((4, 6), np.uint8), "mono8", frame_id="cam1")
    write_bag(tmp_path / "in" / "race1.bag", [Entry("/main_camera/image_raw", IMAGE, image, START)])
    error = refused("coped", tmp_path / "in", tmp_path / "out")
    assert "a topic such as '/lidar_points'" in error
    assert "aerial robots with stereo cameras only, from which octoreplay computes no depth" in error


def test_data_sets_without_a_readable_sensor_are_refused_with_the_reason(tmp_path):
    assert "the extra velodyne" in refused("subt-mrs", tmp_path, tmp_path / "out")


def test_names_are_listed_and_the_nearest_one_is_named(tmp_path):
    done = octoreplay("dataset", "--list")
    assert (done.returncode, done.stdout.count("\n")) == (0, len(done.stdout.splitlines()))
    assert "cu-multi" in done.stdout
    done = octoreplay("dataset", "cu_multi", tmp_path, "-o", tmp_path / "out")
    assert done.returncode == 2
    assert "did you mean 'cu-multi'" in done.stderr


def test_an_output_folder_with_files_is_refused_and_replaced_by_force(tmp_path):
    graco(tmp_path / "in")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").write_text("mine")
    done = octoreplay("dataset", "graco", tmp_path / "in", "-o", tmp_path / "out")
    assert (done.returncode, "already exists" in done.stderr) == (1, True)
    assert octoreplay("dataset", "graco", tmp_path / "in", "-o", tmp_path / "out", "--force").returncode == 0
    assert (tmp_path / "out" / "team.yaml").is_file()
