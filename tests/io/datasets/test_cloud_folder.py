"""Import of folders of point clouds: small ones made here, and real ones where available."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from octoreplay.errors import ConfigError, InputError, OutputError
from octoreplay.io.containers.logs import open_log
from octoreplay.io.datasets.cloud_folder import import_clouds
from octoreplay.io.sensors.clouds import decode_cloud
from octoreplay.records import ClassTable, SemanticClass
from support.recordings import RECORDINGS, needs_recordings
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


# --- clouds, poses and labels -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "expected"), [(None, in_sensor_frame), ("world", in_sensor_frame), ("sensor", finite)]
)
def test_pcd_with_viewpoints(tmp_path, frame, expected):
    output = tmp_path / "left-arm.mcap"
    summary = import_clouds(pcd_folder(tmp_path / "in"), output, rate=8.0, frame=frame)
    assert (summary.layout, summary.poses, summary.frame) == ("PCD", "VIEWPOINT", frame or "world")
    assert (summary.robot_id, summary.num_frames, summary.num_labelled, summary.num_points) == ("left_arm", 3, 3, 9)
    found = clouds(output)
    # Names are sorted by their numbers; a point that is not finite is left out with its label.
    assert [stamp for stamp, *_ in found] == [0, 125_000_000, 250_000_000]
    for index, (_, stored, labels) in enumerate(found):
        np.testing.assert_allclose(stored, expected(index), atol=1e-5)
        assert labels is not None
        assert labels.tolist() == [index, index + 1, index + 3]
    for index, (stamp, T) in enumerate(lidar_poses(output)):
        assert stamp == found[index][0]
        np.testing.assert_allclose(T, pose(index), atol=1e-9)


def test_kitti_with_its_labels_times_and_poses(tmp_path):
    folder = kitti(tmp_path / "00")
    for place in (folder, folder / "velodyne"):
        summary = import_clouds(place, tmp_path / "a.mcap")
        assert (summary.layout, summary.poses, summary.frame) == ("KITTI", "poses.txt (KITTI)", "sensor")
        assert (summary.num_labelled, summary.num_without_pose, summary.duration) == (3, 0, 0.2)
        for index, (stamp, stored, labels) in enumerate(clouds(tmp_path / "a.mcap")):
            assert stamp == index * 100_000_000
            np.testing.assert_array_equal(stored, finite(index))
            assert labels is not None
            assert labels.tolist() == [40 + index, 50 + index, index]
        for index, (_, T) in enumerate(lidar_poses(tmp_path / "a.mcap")):
            np.testing.assert_allclose(T, pose(index), atol=1e-9)
    [(_, message), *_] = read_messages(tmp_path / "a.mcap")["/a/lidar/points"]
    assert [field.name for field in message.fields] == ["x", "y", "z", "intensity", "label"]


def test_the_summary_names_the_conversion_of_kitti_poses(tmp_path):
    folder = kitti(tmp_path / "00")
    (folder / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    summary = import_clouds(folder, tmp_path / "a.mcap")
    assert summary.poses == "poses.txt (KITTI, camera to lidar by calib.txt)"
    # The camera's x is the lidar's -y, its y the lidar's -z, its z the lidar's x.
    np.testing.assert_allclose(lidar_poses(tmp_path / "a.mcap")[2][1][:3, 3], [0.5, -2.0, 2.0], atol=1e-9)


def test_matrices_beside_the_clouds(tmp_path):
    folder = ply_folder(tmp_path / "in", ("frame-0", "frame-1", "frame-2"))
    for index in (0, 2):
        np.savetxt(folder / f"frame-{index}.pose.txt", pose(index))
    summary = import_clouds(folder, tmp_path / "a.mcap", rate=2.0)
    assert (summary.poses, summary.num_frames, summary.num_without_pose) == ("*.pose.txt", 2, 1)
    assert summary.num_labelled == 0
    for (stamp, T), index in zip(lidar_poses(tmp_path / "a.mcap"), (0, 2), strict=True):
        assert stamp == index * 500_000_000
        np.testing.assert_allclose(T, pose(index), atol=1e-9)
    [(_, first), (_, second)] = read_messages(tmp_path / "a.mcap")["/a/lidar/points"]
    assert [field.name for field in second.fields] == ["x", "y", "z", "rgb"]
    assert np.frombuffer(second.data.tobytes(), "<u4").reshape(-1, 4)[:, 3].tolist() == [0x010202] * 3
    assert first.is_dense


def test_tum_poses_are_found_by_the_clouds_times(tmp_path):
    names = ("c_1305031102.000000", "c_1305031102.05", "c_1305031102.100000004", "c_1305031103.0")
    folder = ply_folder(tmp_path / "in", names)
    table = tum_table(tmp_path / "track.txt", ("1305031102.0", "1305031102.1"))
    summary = import_clouds(folder, tmp_path / "a.mcap", poses=table)
    # The last cloud is later than the last pose.
    assert (summary.poses, summary.num_frames, summary.num_without_pose) == ("track.txt (TUM)", 3, 1)
    found = lidar_poses(tmp_path / "a.mcap")
    assert [stamp - 1305031102_000_000_000 for stamp, _ in found] == [0, 50_000_000, 100_000_004]
    np.testing.assert_allclose(found[1][1][:3, 3], (pose(0)[:3, 3] + pose(1)[:3, 3]) / 2, atol=1e-6)
    np.testing.assert_allclose(found[2][1], pose(1), atol=1e-9)
    # With a rate the log has other stamps and the same poses.
    import_clouds(folder, tmp_path / "b.mcap", poses=table, rate=1.0)
    again = lidar_poses(tmp_path / "b.mcap")
    assert [stamp for stamp, _ in again] == [0, 1_000_000_000, 2_000_000_000]
    np.testing.assert_array_equal([T for _, T in again], [T for _, T in found])


def test_tum_rows_belong_to_clouds_without_times_one_by_one(tmp_path):
    folder = ply_folder(tmp_path / "in", ("1", "2", "3"))
    table = tum_table(tmp_path / "track.txt", ("5", "6", "8.5"))
    import_clouds(folder, tmp_path / "a.mcap", poses=table, first=1)
    found = lidar_poses(tmp_path / "a.mcap")
    assert [stamp for stamp, _ in found] == [6_000_000_000, 8_500_000_000]
    np.testing.assert_allclose(found[1][1], pose(2), atol=1e-9)


@pytest.mark.parametrize("order", [("b", "a"), ("a", "b")])
def test_labels_that_only_some_clouds_have(tmp_path, order):
    """Every cloud of a log has a label field or none has, since readers examine the first."""
    folder = kitti(tmp_path / "00", count=2)
    (folder / "labels" / ("000000.label" if order[0] == "b" else "000001.label")).unlink()
    summary = import_clouds(folder, tmp_path / "a.mcap")
    assert summary.num_labelled == 1
    labels = {bool((found == 65535).all()) for _, _, found in clouds(tmp_path / "a.mcap") if found is not None}
    assert labels == {False, True}


def test_labels_of_another_folder_with_their_names(tmp_path):
    folder = kitti(tmp_path / "00")
    (folder / "labels").rename(tmp_path / "other")
    assert import_clouds(folder, tmp_path / "a.mcap").num_labelled == 0
    classes = ClassTable((SemanticClass(1, "road", (9, 9, 9), (40, 41)),))
    summary = import_clouds(folder, tmp_path / "a.mcap", labels=tmp_path / "other", class_table=classes)
    assert summary.num_labelled == 3
    [(_, info)] = read_messages(tmp_path / "a.mcap")["/a/labels/label_info"]
    assert [(c.class_id, c.class_name) for c in info.class_map] == [(40, "road"), (41, "road")]


def test_clouds_without_a_finite_point_are_counted(tmp_path):
    folder = kitti(tmp_path / "00")
    (folder / "velodyne" / "000001.bin").write_bytes(np.full(16, np.nan, "<f4").tobytes())
    (folder / "velodyne" / "000002.bin").write_bytes(b"")
    (folder / "labels" / "000002.label").write_bytes(b"")
    summary = import_clouds(folder, tmp_path / "a.mcap")
    assert (summary.num_frames, summary.num_empty, summary.num_without_pose) == (1, 2, 0)


def test_world_coordinates_far_away_keep_their_digits(tmp_path):
    vertices = np.array([(4_500_000.25, 0.125, 2.0)], dtype=[("x", "f8"), ("y", "f8"), ("z", "f8")])
    (tmp_path / "in").mkdir()
    PlyData([PlyElement.describe(vertices, "vertex")]).write(str(tmp_path / "in" / "1.ply"))
    np.savetxt(tmp_path / "in" / "1.pose.txt", [[1, 0, 0, 4_500_000], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    import_clouds(tmp_path / "in", tmp_path / "a.mcap", rate=1.0, frame="world")
    np.testing.assert_array_equal(clouds(tmp_path / "a.mcap")[0][1], [[0.25, 0.125, 2.0]])


def test_world_points_are_kept_with_a_rounded_matrix(tmp_path):
    far = np.array([(90.0, -60.0, 20.0)], dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
    (tmp_path / "in").mkdir()
    PlyData([PlyElement.describe(far, "vertex")]).write(str(tmp_path / "in" / "1.ply"))
    np.savetxt(tmp_path / "in" / "1.pose.txt", pose(1), fmt="%.2f")
    import_clouds(tmp_path / "in", tmp_path / "a.mcap", rate=1.0, frame="world")
    [(_, T)] = lidar_poses(tmp_path / "a.mcap")
    [(_, [point], _)] = clouds(tmp_path / "a.mcap")
    np.testing.assert_allclose(T[:3, :3] @ point + T[:3, 3], [90, -60, 20], atol=1e-4)


# --- choice and times -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("selection", "expected"),
    [({"first": 1}, [1, 2, 3, 4]), ({"last": 2}, [0, 1, 2]), ({"first": 1, "last": 9, "every": 2}, [1, 3])],
)
def test_a_part_of_the_folder(tmp_path, selection, expected):
    folder = kitti(tmp_path / "00", count=5)
    import_clouds(folder, tmp_path / "a.mcap", **selection)
    assert [round(stamp / 1e8) for stamp, *_ in clouds(tmp_path / "a.mcap")] == expected
    assert [T[0, 3] for _, T in lidar_poses(tmp_path / "a.mcap")] == expected
    assert [stored[1, 2] for _, stored, _ in clouds(tmp_path / "a.mcap")] == expected
    # The table may also hold one line per chosen cloud.
    np.savetxt(tmp_path / "few.txt", [pose(index)[:3].ravel() for index in expected])
    import_clouds(folder, tmp_path / "b.mcap", poses=tmp_path / "few.txt", rate=2.0, **selection)
    assert [T[0, 3] for _, T in lidar_poses(tmp_path / "b.mcap")] == expected
    assert [stamp for stamp, *_ in clouds(tmp_path / "b.mcap")] == [k * 500_000_000 for k in range(len(expected))]


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        (("1305031102", "1305031103"), [1305031102_000_000_000, 1305031103_000_000_000]),
        (("c1305031102175", "c1305031102275"), [1305031102_175_000_000, 1305031102_275_000_000]),
        (("1305031102175304", "1305031102175305"), [1305031102_175_304_000, 1305031102_175_305_000]),
        (("1305031102175304123", "1305031102175304124"), [1305031102_175_304_123, 1305031102_175_304_124]),
        (("3_1305031102_000000004", "4_1305031102_000000005"), [1305031102_000_000_004, 1305031102_000_000_005]),
        # The order by time differs from the order by name.
        (("scan_0.5", "scan_0.25"), [250_000_000, 500_000_000]),
    ],
)
def test_times_in_file_names(tmp_path, names, stamps):
    import_clouds(pcd_folder(tmp_path / "in", names), tmp_path / "a.mcap")
    assert [stamp for stamp, *_ in clouds(tmp_path / "a.mcap")] == stamps


@pytest.mark.parametrize(
    "names",
    [("0000000000", "0000000001"), ("20230115123000", "20230115123001"), ("v1.2_1", "v1.2_2"), ("scan_1", "1305031102"),
     ("1305031102_1305031103", "1305031104_1305031105")],
)  # fmt: skip
def test_numbers_in_file_names_that_are_no_times(tmp_path, names):
    folder = pcd_folder(tmp_path / "in", names)
    with pytest.raises(ConfigError, match="in: the frames have no times; give a rate or a file of times"):
        import_clouds(folder, tmp_path / "a.mcap")
    assert import_clouds(folder, tmp_path / "a.mcap", rate=1.0).num_frames == 2


def test_a_given_file_of_times_has_precedence(tmp_path):
    folder = pcd_folder(tmp_path / "in", ("1305031102", "1305031103"))
    (folder / "times.txt").write_text("3\n4.5\n")
    import_clouds(folder, tmp_path / "a.mcap")
    assert [stamp for stamp, *_ in clouds(tmp_path / "a.mcap")] == [3_000_000_000, 4_500_000_000]
    (tmp_path / "given.txt").write_text("7\n8\n")
    import_clouds(folder, tmp_path / "a.mcap", times=tmp_path / "given.txt")
    assert [stamp for stamp, *_ in clouds(tmp_path / "a.mcap")] == [7_000_000_000, 8_000_000_000]


def test_the_same_folder_gives_the_same_bytes(tmp_path):
    folder = kitti(tmp_path / "00")
    for name in ("x/a.mcap", "y/a.mcap"):
        (tmp_path / name).parent.mkdir()
        import_clouds(folder, tmp_path / name)
    assert (tmp_path / "x/a.mcap").read_bytes() == (tmp_path / "y/a.mcap").read_bytes()


# --- what is wrong ----------------------------------------------------------------------------------------------------


def spoil(name: str, data: str | bytes):
    return lambda folder: (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())


def remove(pattern: str):
    return lambda folder: [path.unlink() for path in folder.glob(pattern)]


@pytest.mark.parametrize(
    ("spoiler", "message"),
    [
        (spoil("velodyne/000001.bin", bytes(40)), r"000001\.bin: 40 bytes are not KITTI's points"),
        (spoil("labels/000001.label", bytes(12)), r"000001\.label: holds 3 labels of 4 bytes, but its cloud has 4"),
        (spoil("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 2), "has 2 poses; the folder has 3 frames, 3 of them chosen"),
        (spoil("poses.txt", "1 0 0 0 0 1 0\n" * 3), r"poses\.txt line 1: expects 8 numbers"),
        (spoil("poses.txt", ""), r"poses\.txt: holds no poses"),
        (spoil("poses.txt", "nan " * 12 + "\n" + "inf " * 12 + "\n" + "nan " * 12),
         r"none of the 3 clouds has a usable pose in poses\.txt \(KITTI\)$"),
        (spoil("poses.txt", "1000 0 0 0 0 0 0 1"), "times are 0.000 to 0.200 s, the poses' 1000.000 to 1000.000 s"),
        (remove("poses.txt"), "no poses found; looked for NAME.pose.txt beside the clouds and poses.txt here and one"),
        (spoil("times.txt", "1\n2\n"), r"times\.txt: has 2 times; the folder has 3 frames"),
        (spoil("times.txt", "1\n2\n3000000000"), r"times\.txt: times must be below 2\^31 s"),
        (spoil("velodyne/map.ply", ""), r"velodyne: holds \.bin and \.ply files; keep clouds of one format in it"),
        (remove("velodyne/*.bin"), r"no clouds found; looked for \.pcd, \.ply, \.bin, also in velodyne/; the fold"),
    ],
)  # fmt: skip
def test_damaged_files_are_named_and_no_log_is_left(tmp_path, spoiler, message):
    folder = kitti(tmp_path / "00")
    spoiler(folder)
    (tmp_path / "out").mkdir()
    with pytest.raises(InputError, match=message):
        import_clouds(folder, tmp_path / "out" / "a.mcap")
    assert list((tmp_path / "out").iterdir()) == []


def test_a_failed_import_leaves_an_older_log_as_it_was(tmp_path):
    folder = kitti(tmp_path / "00")
    import_clouds(folder, tmp_path / "a.mcap")
    before = (tmp_path / "a.mcap").read_bytes()
    spoil("velodyne/000002.bin", bytes(40))(folder)
    with pytest.raises(InputError):
        import_clouds(folder, tmp_path / "a.mcap", rate=2.0)
    assert (tmp_path / "a.mcap").read_bytes() == before
    assert not list(tmp_path.glob("*.partial*"))


def test_unset_viewpoints_are_not_poses(tmp_path):
    folder = pcd_folder(tmp_path / "in")
    for path in folder.glob("*.pcd"):
        save_pcd(path, 0, viewpoint="0 0 0 1 0 0 0")
    with pytest.raises(InputError, match="the VIEWPOINT of every cloud is unset; give a file of poses"):
        import_clouds(folder, tmp_path / "a.mcap", rate=1.0)
    # A single cloud may define the map.
    assert import_clouds(folder, tmp_path / "a.mcap", rate=1.0, last=0).num_frames == 1


def test_labels_that_begin_later_are_refused(tmp_path):
    folder = pcd_folder(tmp_path / "in")
    first = folder / "scan_2.pcd"
    first.write_text(first.read_text().replace("x y z label", "x y z nothing"))
    with pytest.raises(InputError, match=r"scan_9\.pcd: has labels, but the clouds before it have none; choose it as"):
        import_clouds(folder, tmp_path / "a.mcap", rate=1.0)
    assert import_clouds(folder, tmp_path / "a.mcap", rate=1.0, first=1).num_labelled == 2


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"rate": 1.0, "times": Path("t.txt")}, ConfigError, "give one of them, not both"),
        ({"rate": 0.0}, ConfigError, "rate: 0 must be greater than 0"),
        ({"rate": 1e-11}, InputError, r"times must be below 2\^31 s"),
        ({"first": 9}, ConfigError, "no frame between first 9 and last None; the folder has 3"),
        ({"robot_id": "a/b"}, ConfigError, "robot id 'a/b'"),
        ({"times": Path("missing.txt")}, InputError, r"missing\.txt: cannot be read"),
        ({"poses": Path("missing.txt")}, InputError, r"missing\.txt: cannot be read"),
        ({"labels": Path("missing")}, InputError, r"missing: holds no \.label file with the name of a cloud such as"),
    ],
)
def test_options_that_do_not_fit(tmp_path, options, error, message):
    with pytest.raises(error, match=message):
        import_clouds(kitti(tmp_path / "00"), tmp_path / "a.mcap", **options)
    assert not (tmp_path / "a.mcap").exists()


def test_missing_input_and_unwritable_output(tmp_path):
    with pytest.raises(InputError, match="nowhere: is not a folder"):
        import_clouds(tmp_path / "nowhere", tmp_path / "a.mcap")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty: no clouds found; looked for \.pcd, \.ply, \.bin, also in velodyne/$"):
        import_clouds(tmp_path / "empty", tmp_path / "a.mcap")
    with pytest.raises(OutputError, match="cannot be written"):
        import_clouds(kitti(tmp_path / "00"), tmp_path / "none" / "a.mcap")


# --- real folders -----------------------------------------------------------------------------------------------------


def meeting_points(path: Path) -> tuple[int, float]:
    """Share of a log's points in the map that have a point of a cloud from another position within 0.1 m.

    And the share of them whose labels are the same.
    """
    poses = [T for _, T in lidar_poses(path)]
    placed = [stored @ T[:3, :3].T + T[:3, 3] for (_, stored, _), T in zip(clouds(path), poses, strict=True)]
    labels = [found for *_, found in clouds(path)]
    same = []
    for T, cloud, own in zip(poses, placed, labels, strict=True):
        others = [k for k, S in enumerate(poses) if np.linalg.norm(S[:3, 3] - T[:3, 3]) > 1]
        distances, nearest = cKDTree(np.concatenate([placed[k] for k in others])).query(cloud)
        near = distances < 0.1
        same.append(own[near] == np.concatenate([labels[k] for k in others])[nearest[near]])
    found = np.concatenate(same)
    return len(found), float(found.mean())


@needs_recordings
def test_real_labelled_scans_line_up_in_the_assumed_frame(tmp_path):
    summary = import_clouds(BKI, tmp_path / "a.mcap", rate=1.0)
    assert (summary.num_frames, summary.num_labelled, summary.frame) == (12, 12, "world")
    [sentence] = summary.warnings
    assert sentence.endswith(
        "annotated_1.pcd and 11 more: rows have more columns than the header names; "
        "those after the named ones were not read"
    )
    # Scans from four positions overlap in one room, but not when read as in the sensor's frame.
    import_clouds(BKI, tmp_path / "b.mcap", rate=1.0, frame="sensor")
    count, agreement = meeting_points(tmp_path / "a.mcap")
    assert count > 5000
    assert agreement > 0.95
    assert meeting_points(tmp_path / "b.mcap")[0] < 100
    for (_, stored, labels), (_, T) in zip(clouds(tmp_path / "a.mcap"), lidar_poses(tmp_path / "a.mcap"), strict=True):
        assert 0.4 < np.linalg.norm(stored, axis=1).min() < 1.0
        assert set(np.unique(labels)) <= {1, 2, 3}
        # Label 1 is the floor.
        assert np.mean((stored @ T[:3, :3].T + T[:3, 3])[labels == 1, 2] < 0.3) > 0.98


@needs_recordings
def test_a_real_kitti_sequence(tmp_path):
    np.savetxt(tmp_path / "poses.txt", [np.eye(4)[:3].ravel()])
    summary = import_clouds(KITTI, tmp_path / "a.mcap", rate=10.0, poses=tmp_path / "poses.txt")
    assert (summary.layout, summary.num_frames, summary.num_points, summary.num_labelled) == ("KITTI", 1, 50, 1)
    [(_, stored, labels)] = clouds(tmp_path / "a.mcap")
    raw = np.fromfile(KITTI / "velodyne" / "000000.bin", "<f4").reshape(-1, 4)
    np.testing.assert_array_equal(stored, raw[:, :3])
    np.testing.assert_array_equal(labels, np.fromfile(KITTI / "labels" / "000000.label", "<u4") & 0xFFFF)
