"""Data sets that are folders: stand-ins with the layouts of the originals, converted to logs and mapped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from octoreplay.config.team_file import load_team_file
from support.command_line import octoreplay
from support.data_set_walls import FORWARD, WALL, depth, mapped, pose, seen
from support.long_suite import long

COUNT = 4
# KITTI's camera looks along the car's x axis, 0.3 m before and 0.1 m below the lidar.
CAMERA_IN_LIDAR = FORWARD @ np.array([[1, 0, 0, 0.0], [0, 1, 0, 0.1], [0, 0, 1, 0.3], [0, 0, 0, 1]])
NED = np.diag([1.0, -1.0, -1.0, 1.0])


def numbers(T: npt.NDArray[np.float64]) -> str:
    return " ".join(f"{value:.9f}" for value in T.ravel())


def kitti(folder: Path, *, labels: bool = True, times: bool = True) -> Path:
    """A sequence whose poses are those of the left camera, as KITTI's, relative to its first pose."""
    place = folder / "sequences" / "08"
    for name in ("velodyne", "labels"):
        (place / name).mkdir(parents=True)
    lines = []
    for k in range(COUNT):
        points = np.column_stack([seen(pose(k)), np.zeros(len(WALL))]).astype("<f4")
        (place / "velodyne" / f"{k:06d}.bin").write_bytes(points.tobytes())
        if labels:
            (place / "labels" / f"{k:06d}.label").write_bytes(np.full(len(WALL), 7 << 16 | 50, "<u4").tobytes())
        lines.append(numbers((np.linalg.inv(pose(0) @ CAMERA_IN_LIDAR) @ pose(k) @ CAMERA_IN_LIDAR)[:3]))
    if not labels:
        (place / "labels").rmdir()
    (place / "poses.txt").write_text("\n".join(lines))
    (place / "calib.txt").write_text(
        "".join(f"P{k}: 1 0 0 0 0 1 0 0 0 0 1 0\n" for k in range(4))
        + f"Tr: {numbers(np.linalg.inv(CAMERA_IN_LIDAR)[:3])}\n"
    )
    if times:
        (place / "times.txt").write_text("\n".join(f"{0.1 * k:.6e}" for k in range(COUNT)))
    return place


def tartanair(folder: Path) -> Path:
    """Two trajectories of one environment: depth along the axis in metres, 10 km in the sky, poses in NED axes."""
    for name, side in (("P000", 0.0), ("P001", 0.3)):
        place = folder / "hospital" / "Easy" / name
        (place / "depth_left").mkdir(parents=True)
        lines = []
        for k in range(COUNT):
            image = depth(pose(k, side) @ FORWARD, (641, 481, 320.0))[:480, :640]
            np.save(place / "depth_left" / f"{k:06d}_left_depth.npy", np.where(image, image, 1e4).astype(np.float32))
            T = NED @ pose(k, side) @ NED
            quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
            lines.append(" ".join(f"{value:.9f}" for value in (*T[:3, 3], *quaternion)))
        (place / "pose_left.txt").write_text("\n".join(lines) + "\n")
    return folder


def replica(folder: Path) -> Path:
    """A scene with depth in 1/6553.5 m and camera to world matrices of an optical frame."""
    place = folder / "Replica" / "room0"
    (place / "results").mkdir(parents=True)
    for k in range(COUNT):
        image = np.round(depth(pose(k) @ FORWARD, (1200, 680, 600.0)) * 6553.5).astype(np.uint16)
        Image.fromarray(image).save(place / "results" / f"depth{k:06d}.png")
    (place / "traj.txt").write_text("\n".join(numbers(pose(k) @ FORWARD) for k in range(COUNT)))
    return folder


def scannet(folder: Path, labels: str = "label-filt") -> Path:
    """A scan of SensReader with label images in ScanNet's own ids, and a frame without a pose."""
    place = folder / "scans" / "scene0000_00"
    for name in ("depth", "pose", "intrinsic", labels):
        (place / name).mkdir(parents=True)
    for k in range(COUNT + 1):
        image = depth(pose(k) @ FORWARD, (160, 120, 100.0))
        Image.fromarray(np.round(image * 1000).astype(np.uint16)).save(place / "depth" / f"{k}.png")
        Image.fromarray(np.where(image, 1163, 0).astype(np.uint16)).save(place / labels / f"{k}.png")
        (place / "pose" / f"{k}.txt").write_text(numbers(pose(k) @ FORWARD if k < COUNT else np.full((4, 4), -np.inf)))
    K = np.array([[100, 0, 79.5, 0], [0, 100, 59.5, 0], [0, 0, 1, 0], [0, 0, 0, 1]], float)
    (place / "intrinsic" / "intrinsic_depth.txt").write_text(numbers(K))
    (folder / "scannetv2-labels.combined.tsv").write_text(
        "id\traw_category\tcategory\tcount\tnyu40id\teigen13id\tnyuClass\tnyu40class\n"
        "1\twall\twall\t8277\t1\t12\twall\twall\n1163\tobject\tobject\t1\t40\t7\tobject\totherprop\n"
    )
    return folder


def wildscenes(folder: Path) -> Path:
    """A sequence with names without leading zeros, poses of the lidar with w first, and dates that are not used."""
    place = folder / "WildScenes3d" / "K-01"
    for name in ("Clouds", "Labels"):
        (place / name).mkdir(parents=True)
    lines = ["datetime ts x y z qw qx qy qz"]
    for k in range(COUNT):
        nanoseconds = 8_000_000 + 100_000_000 * k
        name = f"1623379829.{nanoseconds}"
        (place / "Clouds" / f"{name}.bin").write_bytes(seen(pose(k)).astype("<f4").tobytes())
        labels = np.where(np.arange(len(WALL)) % 9, 13, 255).astype("<i4")
        (place / "Labels" / f"{name}.label").write_bytes(labels.tobytes())
        x, y, z, w = Rotation.from_matrix(pose(k)[:3, :3]).as_quat()
        numbers = " ".join(f"{value:.9f}" for value in (*pose(k)[:3, 3], w, x, y, z))
        lines.append(f'"2021-06-11 02:50:29.{nanoseconds:09d}" 1623379829.{nanoseconds:09d} {numbers}')
    (place / "poses3d.csv").write_text("\n".join(lines) + "\n")
    return folder


def prepared(name: str, folder: Path, output: Path, *options: object, code: int = 0) -> Path:
    done = octoreplay("dataset", name, folder, "-o", output, *options)
    assert done.returncode == code, done.stderr
    return output / "team.yaml"


@pytest.mark.parametrize(("labels", "times"), [(True, True), pytest.param(False, False, marks=long)])
def test_scans_of_kitti_are_mapped_from_the_poses_of_its_camera(tmp_path, labels, times):
    kitti(tmp_path / "dataset", labels=labels, times=times)
    # KITTI's map begins at the first lidar pose.
    team = prepared("kitti", tmp_path / "dataset", tmp_path / "out")
    [robot] = load_team_file(team).robots
    assert robot.robot_id == "sequences_08"
    first = np.linalg.inv(pose(0))
    corners = WALL @ first[:3, :3].T + first[:3, 3]
    names = mapped(team, wall=corners)
    assert names == ({"building"} if labels else {"occupied"})


@long
def test_ned_poses_of_tartanair_are_mapped_with_z_up(tmp_path):
    team = prepared("tartanair", tartanair(tmp_path / "in") / "hospital", tmp_path / "out")
    assert [robot.robot_id for robot in load_team_file(team).robots] == ["Easy_P000", "Easy_P001"]
    mapped(team, "--every", 2, "--max-range", 8)


@long
def test_depth_of_replica_has_its_own_unit(tmp_path):
    mapped(prepared("replica", replica(tmp_path / "in"), tmp_path / "out", "--every", 2))


@pytest.mark.parametrize("labels", ["label-filt", pytest.param("label", marks=long)])
def test_scans_of_scannet_have_the_classes_of_its_table(tmp_path, labels):
    folder = scannet(tmp_path / "in", labels)
    if labels == "label":  # as converted to NYU40 by the authors' tools
        for path in folder.rglob("label/*.png"):
            Image.fromarray(np.where(np.asarray(Image.open(path)), 40, 0).astype(np.uint8)).save(path)
    # The last frame has no pose: exit code 3.
    team = prepared("scannet", folder, tmp_path / "out", code=3)
    assert mapped(team) == {"otherprop"}


def test_scans_of_wildscenes_have_times_without_leading_zeros(tmp_path):
    assert mapped(prepared("wildscenes", wildscenes(tmp_path / "in"), tmp_path / "out")) == {"tree-trunk"}


def test_damaged_scans_of_wildscenes_are_refused(tmp_path):
    place = wildscenes(tmp_path / "in") / "WildScenes3d" / "K-01"
    cloud = place / "Clouds" / "1623379829.8000000.bin"
    cloud.write_bytes(cloud.read_bytes()[:-2])
    assert "are not points of 12 bytes" in refused("wildscenes", place, tmp_path / "out")
    cloud.rename(place / "Clouds" / "first.bin")
    assert "its name is not a time" in refused("wildscenes", place, tmp_path / "out")
    (place / "Clouds" / "first.bin").unlink()
    poses = place / "poses3d.csv"
    lines = poses.read_text().split("\n")
    for text, message in (
        ("\n".join(["a b c", *lines[1:]]), "has no header with the columns x, y, z"),
        ("\n".join([lines[0], lines[1].rsplit(" ", 1)[0]]), "row 2: expects 9 columns"),
        (lines[0], "holds no poses"),
        ("\n".join([lines[0], lines[1].replace(" 1623379829.", " 1523379829.")]), "has no pose at the times"),
    ):
        poses.write_text(text)
        assert message in refused("wildscenes", place, tmp_path / "out")


def refused(name: str, folder: Path, output: Path) -> str:
    done = octoreplay("dataset", name, folder, "-o", output)
    assert (done.returncode, output.exists()) == (1, False)
    assert not list(output.parent.glob(".*"))
    return done.stderr


def test_incomplete_folders_are_refused_with_the_file_and_the_remedy(tmp_path):
    output = tmp_path / "out"
    for name, marker in (
        ("kitti", "velodyne"), ("tartanair", "depth_left"), ("replica", "results"), ("scannet", "depth"),
    ):  # fmt: skip
        (tmp_path / "empty").mkdir(exist_ok=True)
        assert f"no {marker}/" in refused(name, tmp_path / "empty", output)
    place = kitti(tmp_path / "kitti")
    (place / "calib.txt").unlink()
    assert "calib.txt: not found; it has the row Tr" in refused("kitti", tmp_path / "kitti", output)
    (place / "poses.txt").unlink()
    assert "copy poses/NN.txt" in refused("kitti", tmp_path / "kitti", output)
    poses = tartanair(tmp_path / "air") / "hospital" / "Easy" / "P001" / "pose_left.txt"
    poses.write_text(poses.read_text().split("\n", 1)[1])
    assert "has 3 poses for the 4 images in" in refused("tartanair", tmp_path / "air", output)
    image = poses.parent.parent / "P000" / "depth_left" / "000001_left_depth.npy"
    for content in (b"", image.read_bytes()[:500], b"\x93NUMPY\x01\x00\x10\x00{'descr': 'O' }  "):
        image.write_bytes(content)
        assert "000001_left_depth.npy: is damaged" in refused("tartanair", poses.parent.parent / "P000", output)
    np.save(image, np.zeros((480, 640, 3), np.float32))
    assert "must be an array (H, W)" in refused("tartanair", poses.parent.parent / "P000", output)
    folder = scannet(tmp_path / "scannet")
    (folder / "scannetv2-labels.combined.tsv").write_text("id\tname\n1\twall\n")
    assert "is not ScanNet's table of labels" in refused("scannet", folder, output)
    (folder / "scannetv2-labels.combined.tsv").unlink()
    assert "which is not in this folder or above" in refused("scannet", folder, output)
