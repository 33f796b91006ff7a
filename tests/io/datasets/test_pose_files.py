"""Pose files: TUM, KITTI with and without calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from octoreplay.errors import InputError, OutputError
from octoreplay.io.datasets.pose_files import read_poses, read_tum_track, write_tum
from support.poses import pose


def kitti_row(T: np.ndarray) -> str:
    return " ".join(map(repr, T[:3].ravel().tolist()))


def tum_row(stamp: str, T: np.ndarray) -> str:
    return " ".join([stamp, *map(repr, [*T[:3, 3].tolist(), *Rotation.from_matrix(T[:3, :3]).as_quat().tolist()])])


def save(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines))
    return path


def test_kitti_rows_are_matrices(tmp_path):
    table = read_poses(save(tmp_path / "poses.txt", kitti_row(pose(0)), kitti_row(pose(1)), "nan " * 12))
    assert (table.name, table.stamps) == ("KITTI", None)
    np.testing.assert_allclose(table.poses[1], pose(1), atol=1e-12)
    assert table.poses[2] is None


def test_kitti_camera_poses_become_lidar_poses_with_calib(tmp_path):
    """A lidar point in the first lidar frame, computed through the camera frames."""
    Tr = np.eye(4)
    Tr[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    Tr[:3, 3] = 0.1, -0.2, -0.3
    save(tmp_path / "calib.txt", "P0: " + "1 " * 12, "Tr: " + kitti_row(Tr))
    table = read_poses(save(tmp_path / "poses.txt", kitti_row(np.eye(4)), kitti_row(pose(2))))
    assert table.name == "KITTI, camera to lidar by calib.txt"
    np.testing.assert_allclose(table.poses[0], np.eye(4), atol=1e-12)
    point_lidar = np.array([3.0, 1.0, -0.5, 1.0])
    point_first_camera = pose(2) @ (Tr @ point_lidar)
    np.testing.assert_allclose(Tr @ (table.poses[1] @ point_lidar), point_first_camera, atol=1e-12)
    # The camera's z axis (forward) is the lidar's x axis.
    ahead = np.eye(4)
    ahead[2, 3] = 5.0
    table = read_poses(save(tmp_path / "poses.txt", kitti_row(ahead)))
    np.testing.assert_allclose(table.poses[0][:3, 3], [5, 0, 0], atol=1e-12)


@pytest.mark.parametrize("lines", [("P0: " + "1 " * 12,), ("Tr: " + "nan " * 12,)])
def test_a_calibration_without_the_lidar_is_refused(tmp_path, lines):
    save(tmp_path / "calib.txt", *lines)
    with pytest.raises(InputError, match=r"calib\.txt: has no usable row 'Tr:' \(lidar to camera\); correct it"):
        read_poses(save(tmp_path / "poses.txt", kitti_row(pose(0))))


def test_tum_poses_are_interpolated_and_rounded_stamps_forgiven(tmp_path):
    rows = [tum_row(f"1305031102.{k}", pose(k)) for k in range(3)]
    table = read_poses(save(tmp_path / "poses.txt", "# stamp x y z qx qy qz qw", *rows, tum_row("1305031109", pose(9))))
    start = 1305031102_000_000_000
    assert table.stamps == [start, start + 100_000_000, start + 200_000_000, start + 7_000_000_000]
    T = table.at(start + 50_000_000)
    assert T is not None
    rotations = Rotation.from_matrix([pose(0)[:3, :3], pose(1)[:3, :3]])
    np.testing.assert_allclose(T[:3, :3], Slerp([0, 1], rotations)(0.5).as_matrix(), atol=1e-6)
    np.testing.assert_allclose(T[:3, 3], (pose(0)[:3, 3] + pose(1)[:3, 3]) / 2, atol=1e-6)
    # Within 1 ms of a row the result is that row; otherwise there is none before the first row and in a gap.
    for near in (start - 900_000, start + 7_000_900_000, start + 6_999_100_000):
        assert table.at(near) is not None
    for far in (start - 1_100_000, start + 1_000_000_000, start + 7_001_100_000):
        assert table.at(far) is None
    np.testing.assert_allclose(table.at(start + 7_000_900_000), pose(9), atol=1e-12)


def test_a_tum_row_that_is_not_finite_has_no_pose(tmp_path):
    table = read_poses(save(tmp_path / "a.txt", tum_row("1", pose(0)), "2 0 0 0 0 0 0 0", "3 nan 0 0 0 0 0 1"))
    assert [T is None for T in table.poses] == [False, True, True]
    assert table.at(2_000_000_000) is None


@pytest.mark.parametrize(
    ("lines", "message"),
    [(["# nothing"], r"a\.txt: holds no poses"),
     (["1 2 3 4 5 6 7"], r"a\.txt line 1: expects 8 numbers \(TUM: .*\), 12 \(KITTI: .*\) or 16 .*, got 7"),
     (["1 2 3 0 0 0 1 0", "1 2 3"], r"a\.txt line 2: expects 8 numbers as in the rows before, got 3"),
     ([kitti_row(np.eye(4)), "1 2 3"], r"a\.txt line 2: expects 12 numbers as in the rows before, got 3"),
     ([kitti_row(2 * np.eye(4))], r"a\.txt line 1: its upper left 3x3 part is not a rotation"),
     (["soon 2 3 0 0 0 1 0"], r"a\.txt line 1: 'soon' is not a time"),
     (["1 2 3 a b c d e"], r"a\.txt line 1: expects numbers")],
)  # fmt: skip
def test_other_files_are_refused(tmp_path, lines, message):
    with pytest.raises(InputError, match=message):
        read_poses(save(tmp_path / "a.txt", *lines))


def test_a_written_tum_file_is_read_back(tmp_path):
    stamps = np.array([1_700_000_000_000_000_001, 1_700_000_000_050_000_000, 1_700_000_123_999_999_999])
    poses = np.array([pose(index) for index in range(3)])
    write_tum(tmp_path / "track.tum", stamps, poses)
    track = read_tum_track(tmp_path / "track.tum")
    np.testing.assert_array_equal(track.stamps_ns, stamps)
    np.testing.assert_array_equal(track.positions, poses[:, :3, 3])
    np.testing.assert_allclose([track.matrix_at(stamp, 0) for stamp in stamps.tolist()], poses, atol=1e-12)
    with pytest.raises(OutputError, match=r"track\.tum: cannot be written"):
        write_tum(tmp_path / "none" / "track.tum", stamps, poses)
