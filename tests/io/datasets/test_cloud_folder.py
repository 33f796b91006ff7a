"""Import of folders of point clouds: small ones made here, and real ones where available."""

from __future__ import annotations

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from octoreplay.errors import ConfigError, InputError
from octoreplay.io.datasets.cloud_folder import import_clouds
from octoreplay.records import ClassTable, SemanticClass
from support.cloud_folders import (
    clouds,
    finite,
    in_sensor_frame,
    kitti,
    lidar_poses,
    pcd_folder,
    ply_folder,
    pose,
    save_pcd,
    tum_table,
)
from support.stored_messages import read_messages

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


def test_clouds_in_one_frame_need_no_poses(tmp_path):
    for name in ("a", "b"):
        save_pcd(tmp_path / "in" / f"{name}.pcd", 0, "0 0 0 1 0 0 0")
    summary = import_clouds(tmp_path / "in", tmp_path / "a.mcap", identity_poses=True)
    assert (summary.poses, summary.frame, summary.num_frames) == ("the identity", "sensor", 2)
    found = lidar_poses(tmp_path / "a.mcap")
    assert [stamp for stamp, _ in found] == [0, 1_000_000_000]
    np.testing.assert_array_equal([T for _, T in found], [np.eye(4)] * 2)
    with pytest.raises(ConfigError, match="identity_poses and poses: give one of them"):
        import_clouds(tmp_path / "in", tmp_path / "b.mcap", identity_poses=True, poses="poses.txt")


@pytest.mark.parametrize("is_given", [True, False])
def test_a_pose_graph_gives_poses_by_the_numbers_of_the_clouds(tmp_path, is_given):
    """Keys of gtsam are above 2^53."""
    numbers = (97 << 56 | 2, 97 << 56 | 9, 97 << 56 | 10)
    folder = ply_folder(tmp_path / "in", tuple(f"cloud_{number}" for number in numbers))
    rows = ["FIX 0"]
    for index, number in enumerate(numbers[:2]):
        T = pose(index)
        quaternion = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        rows.append(" ".join(["VERTEX_SE3:QUAT", str(number), *map(repr, [*T[:3, 3].tolist(), *quaternion])]))
    rows.append("EDGE_SE3:QUAT 0 1 " + " ".join("0" * 28))
    path = tmp_path / ("slam.g2o" if is_given else "graph.g2o")
    path.write_text("\n".join(rows))
    summary = import_clouds(folder, tmp_path / "a.mcap", rate=1.0, poses=path if is_given else None)
    assert (summary.poses, summary.num_frames, summary.num_without_pose) == (path.name, 2, 1)
    for index, (_, T) in enumerate(lidar_poses(tmp_path / "a.mcap")):
        np.testing.assert_allclose(T, pose(index), atol=1e-9)


def test_keyframes_of_hdl_graph_slam_have_their_own_poses_and_times(tmp_path):
    for index in range(2):
        save_pcd(tmp_path / "in" / f"{index:06d}" / "cloud.pcd", index, "0 0 0 1 0 0 0")
        rows = "\n".join(" ".join(map(repr, row)) for row in pose(index).tolist())
        text = f"stamp 170000000{index} 5\nestimate\n{rows}\nodom\n{rows}\naccum_distance 1\nid {index + 7}\n"
        (tmp_path / "in" / f"{index:06d}" / "data").write_text(text)
    (tmp_path / "in" / "map.txt").write_text("")
    summary = import_clouds(tmp_path / "in", tmp_path / "a.mcap")
    assert (summary.poses, summary.num_frames) == ("keyframes of hdl_graph_slam", 2)
    found = lidar_poses(tmp_path / "a.mcap")
    assert [stamp for stamp, _ in found] == [1_700_000_000_000_000_005, 1_700_000_001_000_000_005]
    for index, (_, T) in enumerate(found):
        np.testing.assert_allclose(T, pose(index), atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stamp 1 2\n", "expects the rows 'stamp' and 'estimate'"),
        ("stamp 1\nestimate\n1 0 0 0\n", "expects 'stamp SECONDS NANOSECONDS', and four rows"),
        ("stamp 1 2\nestimate\n" + "2 0 0 0\n" * 4, "estimate: its upper left 3x3 part is not a rotation"),
    ],
)
def test_damaged_keyframes_are_named(tmp_path, text, message):
    save_pcd(tmp_path / "in" / "000000" / "cloud.pcd", 0, "0 0 0 1 0 0 0")
    (tmp_path / "in" / "000000" / "data").write_text(text)
    with pytest.raises(InputError, match=message):
        import_clouds(tmp_path / "in", tmp_path / "a.mcap")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EDGE_SE3:QUAT 0 1", "holds no row VERTEX_SE3:QUAT"),
        ("VERTEX_SE3:QUAT 1 0 0 0 0 0 0", "line 1: expects an id, a position and a quaternion"),
        ("VERTEX_SE3:QUAT 1.5 0 0 0 0 0 0 1", "line 1: expects an id, a position and a quaternion"),
        ("VERTEX_SE3:QUAT 5 0 0 0 0 0 0 1", "none of its 1 vertices has the number of a cloud such as '1.ply'"),
    ],
)
def test_damaged_pose_graphs_are_named(tmp_path, text, message):
    folder = ply_folder(tmp_path / "in", ("1",))
    (tmp_path / "graph.g2o").write_text(text)
    with pytest.raises(InputError, match=message):
        import_clouds(folder, tmp_path / "a.mcap", rate=1.0)
