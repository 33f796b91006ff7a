"""Refused folders of point clouds, and real ones where available."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from octoreplay.errors import ConfigError, InputError, OutputError
from octoreplay.io.datasets.cloud_folder import import_clouds
from support.cloud_folders import (
    BKI,
    KITTI,
    clouds,
    kitti,
    lidar_poses,
    pcd_folder,
    save_pcd,
)
from support.recordings import needs_recordings


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
        (remove("poses.txt"), "no poses found; looked for NAME.pose.txt beside the clouds, and poses.txt and"),
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
        ({"first": 9}, ConfigError, "first 9 is beyond the last frame, 2"),
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
