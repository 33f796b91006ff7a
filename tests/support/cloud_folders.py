"""Folders of point clouds, and the clouds and poses of the logs made from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from octoreplay.io.containers.logs import open_log
from octoreplay.io.sensors.clouds import decode_cloud
from support.recordings import RECORDINGS
from support.stored_messages import matrix, read_messages

BKI = RECORDINGS / "semantic_pcd" / "bki_sim"

KITTI = RECORDINGS / "semantic_misc" / "mmdet3d_semantickitti" / "sequences" / "00"


def pose(index: int) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zyx", [0.3 * index + 0.1, 0.1, -0.2]).as_matrix()
    T[:3, 3] = index, -2.0, 0.5
    return T


def points(index: int) -> np.ndarray:
    return np.array([[1.0, 2.0, 3.0], [4.0, -5.0, index], [np.nan, 0.0, 0.0], [7.0, 8.0, 9.0]], np.float32)


def save_pcd(path: Path, index: int, viewpoint: str | None = None) -> None:
    if viewpoint is None:
        T = pose(index)
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        viewpoint = " ".join(map(repr, [*T[:3, 3].tolist(), float(w), float(x), float(y), float(z)]))
    rows = "\n".join(f"{x!r} {y!r} {z!r} {k + index}" for k, (x, y, z) in enumerate(points(index).tolist()))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        "VERSION 0.7\nFIELDS x y z label\nSIZE 4 4 4 2\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 4\nHEIGHT 1\n"
        f"VIEWPOINT {viewpoint}\nPOINTS 4\nDATA ascii\n{rows}\n"
    )


def pcd_folder(folder: Path, names: tuple[str, ...] = ("scan_2", "scan_9", "scan_10")) -> Path:
    for index, name in enumerate(names):
        save_pcd(folder / f"{name}.pcd", index)
    return folder


def kitti(folder: Path, count: int = 3, *, labels: bool = True) -> Path:
    """A sequence's folder: velodyne/, labels/, poses.txt of the lidar, times.txt."""
    for name in ("velodyne", "labels"):
        (folder / name).mkdir(parents=True)
    for index in range(count):
        table = np.column_stack([points(index), np.full(4, 0.25 * index)]).astype("<f4")
        (folder / "velodyne" / f"{index:06d}.bin").write_bytes(table.tobytes())
        if labels:
            stored = np.array([40, 3 << 16 | 50, 1, 0], "<u4") + index
            (folder / "labels" / f"{index:06d}.label").write_bytes(stored.tobytes())
    np.savetxt(folder / "poses.txt", [pose(index)[:3].ravel() for index in range(count)])
    (folder / "times.txt").write_text("\n".join(f"{0.1 * index:.6e}" for index in range(count)))
    return folder


def ply_folder(folder: Path, names: tuple[str, ...]) -> Path:
    folder.mkdir(parents=True)
    for index, name in enumerate(names):
        vertices = np.zeros(4, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
        for axis, field in enumerate("xyz"):
            vertices[field] = points(index)[:, axis]
        vertices["red"], vertices["green"], vertices["blue"] = 1, 2, index
        PlyData([PlyElement.describe(vertices, "vertex")]).write(str(folder / f"{name}.ply"))
    return folder


def tum_table(path: Path, stamps: tuple[str, ...]) -> Path:
    rows = ["# stamp x y z qx qy qz qw"]
    for index, stamp in enumerate(stamps):
        T = pose(index)
        numbers = [*T[:3, 3].tolist(), *Rotation.from_matrix(T[:3, :3]).as_quat().tolist()]
        rows.append(" ".join([stamp, *map(repr, numbers)]))
    path.write_text("\n".join(rows))
    return path


def clouds(path: Path) -> list[tuple[int, np.ndarray, np.ndarray | None]]:
    """(stamp, points, labels) of every cloud of a log, from the reader of a run."""
    with open_log(path) as log:
        [topic] = [topic.name for topic in log.topics if topic.name.endswith("/lidar/points")]
        found = [(message.log_time_ns, message.sensor_message()) for message in log.messages((topic,))]
    decoded = [(stamp, decode_cloud(cloud, "")) for stamp, cloud in found]
    return [(stamp, cloud.points, cloud.labels) for stamp, cloud in decoded]


def lidar_poses(path: Path) -> list[tuple[int, np.ndarray]]:
    messages = read_messages(path)
    [(_, tf)] = messages["/tf_static"]
    np.testing.assert_array_equal(
        matrix(tf.transforms[0].transform.translation, tf.transforms[0].transform.rotation), np.eye(4)
    )
    [odometry] = [found for topic, found in messages.items() if topic.endswith("/odom")]
    return [(stamp, matrix(m.pose.pose.position, m.pose.pose.orientation)) for stamp, m in odometry]


def finite(index: int) -> np.ndarray:
    return points(index)[[0, 1, 3]]


def in_sensor_frame(index: int) -> np.ndarray:
    homogeneous = np.column_stack([finite(index), np.ones(3)])
    return (np.linalg.inv(pose(index)) @ homogeneous.T).T[:, :3]
