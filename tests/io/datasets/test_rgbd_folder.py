"""Import of folders of depth images: small ones made here, and real ones where available."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation, Slerp

from octoreplay.errors import ConfigError, InputError, OctoreplayError, OutputError
from octoreplay.io.datasets.rgbd_folder import import_rgbd
from octoreplay.records import ClassTable, SemanticClass
from support.poses import pose
from support.recordings import RECORDINGS, needs_recordings
from support.stored_messages import matrix, pixels, read_messages

K = "4 0 2.5\n0 4.5 1.5\n0 0 1\n"


def depth_values(index: int) -> np.ndarray:
    values = np.arange(24, dtype=np.uint16).reshape(4, 6) * 100 + index
    values[0, :2] = 0, 65535
    return values


def save_png(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)


def seven_scenes(folder: Path, count: int = 3) -> Path:
    folder.mkdir(parents=True)
    for index in range(count):
        save_png(folder / f"frame-{index * 5:06d}.depth.png", depth_values(index))
        np.savetxt(folder / f"frame-{index * 5:06d}.pose.txt", pose(index))
    (folder / "camera-intrinsics.txt").write_text(K)
    return folder


def scannet(folder: Path, numbers: tuple[int, ...] = (0, 9, 10)) -> Path:
    (folder / "pose").mkdir(parents=True)
    (folder / "intrinsic").mkdir()
    (folder / "intrinsic" / "intrinsic_depth.txt").write_text("4 0 2.5 0\n0 4.5 1.5 0\n0 0 1 0\n0 0 0 1\n")
    for number in numbers:
        save_png(folder / "depth" / f"{number}.png", depth_values(number))
        save_png(folder / "label" / f"{number}.png", np.full((4, 6), number, np.uint16))
        np.savetxt(folder / "pose" / f"{number}.txt", pose(number))
    return folder


def tum(folder: Path, stamps: tuple[str, ...] = ("1305031102.000000123", "1305031102.05", "1305031103.0")) -> Path:
    folder.mkdir(parents=True)
    lines = ["# depth maps"]
    for index, stamp in enumerate(stamps):
        save_png(folder / "depth" / f"{stamp}.png", depth_values(index))
        lines.append(f"{stamp} depth/{stamp}.png")
    (folder / "depth.txt").write_text("\n".join(lines))
    rows = ["# timestamp tx ty tz qx qy qz qw"]
    for index in range(2):
        q = Rotation.from_matrix(pose(index)[:3, :3]).as_quat()
        rows.append(" ".join(map(repr, [1305031102.0 + 0.1 * index, *pose(index)[:3, 3].tolist(), *q.tolist()])))
    (folder / "groundtruth.txt").write_text("\n".join(rows))
    return folder


def camera_poses(messages) -> list[tuple[int, np.ndarray]]:
    """Camera poses from the log: odometry and the static transform."""
    [(_, tf)] = next(found for topic, found in messages.items() if topic == "/tf_static")
    static = tf.transforms[0].transform
    T_body_camera = matrix(static.translation, static.rotation)
    [odometry] = [found for topic, found in messages.items() if topic.endswith("/odom")]
    return [(t, matrix(m.pose.pose.position, m.pose.pose.orientation) @ T_body_camera) for t, m in odometry]


def images(messages, name: str) -> list[tuple[int, np.ndarray]]:
    return [(t, pixels(m)) for topic, found in messages.items() if f"/{name}/image" in topic for t, m in found]


def test_seven_scenes_keeps_pixels_poses_and_intrinsics(tmp_path):
    output = tmp_path / "left-arm.mcap"
    summary = import_rgbd(seven_scenes(tmp_path / "in"), output, rate=8.0)
    messages = read_messages(output)
    assert (summary.layout, summary.robot_id, summary.num_frames) == ("7-Scenes", "left_arm", 3)
    stamps = [t for t, _ in images(messages, "depth")]
    assert stamps == [0, 125_000_000, 250_000_000]
    for index, (_, image) in enumerate(images(messages, "depth")):
        expected = depth_values(index)
        expected[0, 1] = 0
        assert image.dtype == np.uint16
        np.testing.assert_array_equal(image, expected)
    for index, (stamp, T) in enumerate(camera_poses(messages)):
        assert stamp == stamps[index]
        np.testing.assert_allclose(T, pose(index), atol=1e-9)
    [info, *_] = [m for _, m in messages["/left_arm/camera/depth/camera_info"]]
    np.testing.assert_array_equal(info.k, [4, 0, 2.5, 0, 4.5, 1.5, 0, 0, 1])


def test_poses_can_be_moved_to_another_map_frame(tmp_path):
    T_map_given = pose(5)
    import_rgbd(seven_scenes(tmp_path / "in"), tmp_path / "a.mcap", rate=8.0, T_map_given=T_map_given)
    for index, (_, T) in enumerate(camera_poses(read_messages(tmp_path / "a.mcap"))):
        np.testing.assert_allclose(T, T_map_given @ pose(index), atol=1e-9)


def test_intrinsics_one_folder_up_and_by_option(tmp_path):
    folder = seven_scenes(tmp_path / "scene" / "seq-01", count=1)
    (folder / "camera-intrinsics.txt").rename(folder.parent / "camera-intrinsics.txt")
    assert import_rgbd(folder, tmp_path / "a.mcap", rate=1.0).camera.fx == 4.0
    given = import_rgbd(folder, tmp_path / "b.mcap", rate=1.0, intrinsics=(5, 6, 2, 1)).camera
    assert (given.fx, given.fy, given.cx, given.cy) == (5.0, 6.0, 2.0, 1.0)


def test_published_intrinsics_are_used_for_their_size_only(tmp_path):
    folder = seven_scenes(tmp_path / "in", count=1)
    (folder / "camera-intrinsics.txt").unlink()
    with pytest.raises(ConfigError, match=r"is 6x4 pixels, and the folder has no intrinsics; give"):
        import_rgbd(folder, tmp_path / "a.mcap", rate=1.0)
    save_png(folder / "frame-000000.depth.png", np.full((480, 640), 1000, np.uint16))
    camera = import_rgbd(folder, tmp_path / "a.mcap", rate=1.0).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (585.0, 585.0, 320.0, 240.0)


@pytest.mark.parametrize(
    ("selection", "expected"),
    [({"first": 1}, [1, 2, 3, 4]), ({"last": 2}, [0, 1, 2]), ({"first": 1, "last": 9, "every": 2}, [1, 3])],
)
def test_a_part_of_the_folder(tmp_path, selection, expected):
    folder = seven_scenes(tmp_path / "in", count=5)
    import_rgbd(folder, tmp_path / "a.mcap", rate=2.0, **selection)
    found = images(read_messages(tmp_path / "a.mcap"), "depth")
    assert [int(image[0, 2]) - 200 for _, image in found] == expected
    assert [t for t, _ in found] == [k * 500_000_000 for k in range(len(expected))]


def test_times_from_a_file(tmp_path):
    folder = seven_scenes(tmp_path / "in", count=4)
    times = tmp_path / "times.txt"
    times.write_text("# seconds\n1.5\n1.600000001\n2\n3\n")
    import_rgbd(folder, tmp_path / "a.mcap", times=times, first=1, last=2)
    assert [t for t, _ in images(read_messages(tmp_path / "a.mcap"), "depth")] == [1_600_000_001, 2_000_000_000]
    times.write_text("7\n8.5\n")
    import_rgbd(folder, tmp_path / "b.mcap", times=times, first=1, last=2)
    assert [t for t, _ in images(read_messages(tmp_path / "b.mcap"), "depth")] == [7_000_000_000, 8_500_000_000]


@pytest.mark.parametrize(
    ("text", "message"),
    [("1\n2\n", "has 2 times; the folder has 3 frames, 3 of them chosen"), ("1\n1\n2\n", "do not ascend"),
     ("1\nsoon\n2\n", "line 2: 'soon' is not a time"), ("1\nnan\n2\n", "line 2: 'nan' is not a time"),
     ("-2\n-1\n2\n", "must not be negative")],
)  # fmt: skip
def test_times_that_do_not_fit(tmp_path, text, message):
    (tmp_path / "times.txt").write_text(text)
    with pytest.raises(InputError, match=message):
        import_rgbd(seven_scenes(tmp_path / "in"), tmp_path / "a.mcap", times=tmp_path / "times.txt")


def test_tum_has_its_own_stamps_and_interpolated_poses(tmp_path):
    summary = import_rgbd(tum(tmp_path / "in"), tmp_path / "a.mcap", intrinsics=(4, 4, 2.5, 1.5))
    messages = read_messages(tmp_path / "a.mcap")
    # The third image is later than the last pose.
    assert (summary.layout, summary.num_frames, summary.num_without_pose) == ("TUM RGB-D", 2, 1)
    assert [t for t, _ in images(messages, "depth")] == [1305031102_000000123, 1305031102_050000000]
    rotations = Rotation.from_matrix([pose(0)[:3, :3], pose(1)[:3, :3]])
    T = camera_poses(messages)[1][1]
    np.testing.assert_allclose(T[:3, :3], Slerp([0, 1], rotations)(0.5).as_matrix(), atol=1e-6)
    np.testing.assert_allclose(T[:3, 3], (pose(0)[:3, 3] + pose(1)[:3, 3]) / 2, atol=1e-6)
    image = images(messages, "depth")[0][1]
    assert image.dtype == np.float32
    assert np.isnan(image[0, :2]).all()
    np.testing.assert_allclose(image[1:], depth_values(0)[1:] / 5000, rtol=1e-6)


def test_tum_with_a_rate_keeps_the_poses_of_the_real_stamps(tmp_path):
    import_rgbd(tum(tmp_path / "in"), tmp_path / "a.mcap", intrinsics=(4, 4, 2.5, 1.5), rate=1.0)
    [first, second] = camera_poses(read_messages(tmp_path / "a.mcap"))
    assert (first[0], second[0]) == (0, 1_000_000_000)
    np.testing.assert_allclose(second[1][0, 3], 0.5, atol=1e-6)


def test_scannet_skips_lost_tracking_and_orders_by_number(tmp_path):
    folder = scannet(tmp_path / "in")
    (folder / "pose" / "9.txt").write_text("-inf -inf -inf -inf\n" * 4)
    summary = import_rgbd(folder, tmp_path / "a.mcap", rate=1.0)
    assert (summary.layout, summary.num_frames, summary.num_labelled, summary.num_without_pose) == ("ScanNet", 2, 2, 1)
    messages = read_messages(tmp_path / "a.mcap")
    assert [(t, int(image[0, 0])) for t, image in images(messages, "labels")] == [(0, 0), (2_000_000_000, 10)]
    assert {image.dtype for _, image in images(messages, "labels")} == {np.dtype(np.uint16)}


def test_labels_from_another_folder_with_their_names(tmp_path):
    folder = seven_scenes(tmp_path / "in")
    save_png(tmp_path / "labels" / "frame-000005.png", np.full((4, 6), 3, np.uint8))
    classes = ClassTable((SemanticClass(1, "chair", (9, 9, 9), (3,)),))
    summary = import_rgbd(folder, tmp_path / "a.mcap", rate=1.0, labels=tmp_path / "labels", class_table=classes)
    messages = read_messages(tmp_path / "a.mcap")
    assert summary.num_labelled == 1
    [(stamp, image)] = images(messages, "labels")
    assert (stamp, int(image[0, 0])) == (1_000_000_000, 3)
    [(_, info)] = messages["/a/labels/label_info"]
    assert [(c.class_id, c.class_name) for c in info.class_map] == [(3, "chair")]


def test_the_same_folder_gives_the_same_bytes(tmp_path):
    folder = seven_scenes(tmp_path / "in")
    for name in ("x/a.mcap", "y/a.mcap"):
        (tmp_path / name).parent.mkdir()
        import_rgbd(folder, tmp_path / name, rate=1.0)
    assert (tmp_path / "x/a.mcap").read_bytes() == (tmp_path / "y/a.mcap").read_bytes()


def damage_picture(folder: Path) -> None:
    path = folder / "frame-000005.depth.png"
    path.write_bytes(path.read_bytes()[:60])


def spoil(name: str, text: str):
    return lambda folder: (folder / name).write_text(text)


def repaint(values: np.ndarray):
    return lambda folder: save_png(folder / "frame-000005.depth.png", values)


@pytest.mark.parametrize(
    ("spoiler", "message"),
    [
        (damage_picture, r"frame-000005\.depth\.png: is damaged"),
        (spoil("frame-000005.depth.png", "text"), r"frame-000005\.depth\.png: is not a PNG image"),
        (repaint(np.zeros((4, 6, 3), np.uint8)), "16-bit grey PNG, this one has 8 bits in 3"),
        (repaint(np.zeros((4, 7), np.uint16)), "is 7x4 pixels, but the depth images are 6x4"),
        (spoil("frame-000005.pose.txt", "1 2 3"), r"frame-000005\.pose\.txt: expects a 4x4 matrix, got 3 numbers"),
        (spoil("frame-000005.pose.txt", "a b c"), r"pose\.txt line 1: expects numbers, got 'a b c'"),
        (spoil("frame-000005.pose.txt", "2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1"), "is not a rotation"),
        (spoil("frame-000005.pose.txt", "-1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1"), "is not a rotation"),
        (spoil("camera-intrinsics.txt", "0 0 0\n0 0 0\n0 0 1"), "is not a camera matrix"),
        (lambda f: [path.unlink() for path in f.glob("*.pose.txt")], "none of the 3 frames has a usable pose"),
        (lambda f: [path.unlink() for path in f.glob("*.png")], "no RGB-D sequence found; looked for"),
    ],
)  # fmt: skip
def test_damaged_files_are_named_and_no_log_is_left(tmp_path, spoiler, message):
    folder = seven_scenes(tmp_path / "in")
    spoiler(folder)
    (tmp_path / "out").mkdir()
    with pytest.raises(InputError, match=message):
        import_rgbd(folder, tmp_path / "out" / "a.mcap", rate=1.0)
    assert list((tmp_path / "out").iterdir()) == []


def test_the_poses_are_in_the_named_frame(tmp_path):
    folder = seven_scenes(tmp_path / "in")
    for options, name in (({}, "map"), ({"map_frame": "odom"}, "odom")):
        import_rgbd(folder, tmp_path / "a.mcap", rate=1.0, **options)
        messages = read_messages(tmp_path / "a.mcap")
        assert {odometry.header.frame_id for _, odometry in messages["/a/odom"]} == {name}


def test_a_failed_import_leaves_an_older_log_as_it_was(tmp_path):
    folder = seven_scenes(tmp_path / "in")
    import_rgbd(folder, tmp_path / "a.mcap", rate=1.0)
    before = (tmp_path / "a.mcap").read_bytes()
    damage_picture(folder)
    with pytest.raises(InputError):
        import_rgbd(folder, tmp_path / "a.mcap", rate=2.0)
    assert (tmp_path / "a.mcap").read_bytes() == before


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({}, ConfigError, "have no times; give a rate or a file of times"),
        ({"rate": 1.0, "times": Path("x")}, ConfigError, "give one of them, not both"),
        ({"rate": 0.0}, ConfigError, "rate: 0 must be greater than 0"),
        ({"rate": float("nan")}, ConfigError, "rate: nan must be"),
        ({"rate": 1.0, "first": 9}, ConfigError, "first 9 is beyond the last frame, 2"),
        ({"rate": 1.0, "first": 2, "last": 1}, ConfigError, "last 1 is before first 2"),
        ({"rate": 1.0, "first": -1}, ConfigError, "first: -1"),
        ({"rate": 1.0, "map_frame": ""}, ConfigError, "map_frame: '' must not be empty"),
        ({"rate": 1.0, "every": 0}, ConfigError, "every: 0"),
        ({"rate": 1.0, "robot_id": "a/b"}, ConfigError, "robot id 'a/b'"),
        ({"rate": 1.0, "intrinsics": (0, 1, 2, 3)}, ConfigError, "intrinsics: expects 4 numbers"),
        ({"rate": 1.0, "depth_unit": 0.0}, ConfigError, "depth_unit: 0 must"),
        ({"times": Path("missing.txt")}, InputError, r"missing\.txt: cannot be read"),
        ({"rate": 1.0, "labels": Path("missing")}, InputError, "missing: is not a folder of label images"),
    ],
)
def test_options_that_do_not_fit(tmp_path, options, error, message):
    with pytest.raises(error, match=message):
        import_rgbd(seven_scenes(tmp_path / "in"), tmp_path / "a.mcap", **options)
    assert not (tmp_path / "a.mcap").exists()


def test_label_images_of_another_size_or_name_are_refused(tmp_path):
    folder = scannet(tmp_path / "in")
    save_png(folder / "label" / "9.png", np.zeros((8, 12), np.uint8))
    with pytest.raises(InputError, match=r"9\.png: is 12x8 pixels, but the depth images are 6x4; resize it"):
        import_rgbd(folder, tmp_path / "a.mcap", rate=1.0)
    save_png(tmp_path / "other" / "x.png", np.zeros((4, 6), np.uint8))
    with pytest.raises(InputError, match=r"other: no label image has the name of"):
        import_rgbd(folder, tmp_path / "a.mcap", rate=1.0, labels=tmp_path / "other")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [("groundtruth.txt", "1.0 2 3\n", "holds positions without rotations"),
     ("groundtruth.txt", "soon 1 2 3 0 0 0 1\n", "'soon' is not a time"),
     ("depth.txt", "1.0\n", "line 1: expects a stamp and a file name"),
     ("depth.txt", "# nothing\n", "lists no depth images"),
     ("depth.txt", "1305031102.05 depth/none.png\n", "none.png: not found")],
)  # fmt: skip
def test_damaged_tum_tables(tmp_path, name, text, message):
    folder = tum(tmp_path / "in")
    (folder / name).write_text(text)
    with pytest.raises(InputError, match=message):
        import_rgbd(folder, tmp_path / "a.mcap", intrinsics=(4, 4, 2.5, 1.5))


def test_missing_input_and_unwritable_output(tmp_path):
    with pytest.raises(InputError, match="nowhere: is not a folder"):
        import_rgbd(tmp_path / "nowhere", tmp_path / "a.mcap", rate=1.0)
    with pytest.raises(OutputError, match="cannot be written"):
        import_rgbd(seven_scenes(tmp_path / "in"), tmp_path / "none" / "a.mcap", rate=1.0)
    assert issubclass(OutputError, OctoreplayError)


@needs_recordings
def test_real_seven_scenes_split_into_overlapping_robots(tmp_path):
    folder = RECORDINGS / "rgbd_seq" / "tsdf_7scenes" / "data"
    left = import_rgbd(folder, tmp_path / "left.mcap", rate=10.0, last=11)
    right = import_rgbd(folder, tmp_path / "right.mcap", rate=10.0, first=8, last=19)
    assert (left.num_frames, right.num_frames) == (12, 12)
    first, second = (read_messages(tmp_path / name) for name in ("left.mcap", "right.mcap"))
    # Frames 8 to 11 are in both, at other times.
    for (_, a), (_, b) in zip(images(first, "depth")[8:], images(second, "depth")[:4], strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.shape == (480, 640)
        assert 0.1 < np.median(a[a > 0]) / 1000 < 5.0
    for (_, a), (_, b) in zip(camera_poses(first)[8:], camera_poses(second)[:4], strict=True):
        np.testing.assert_array_equal(a, b)
    # The rotations of the recording are orthonormal to about 1e-4 only; a quaternion's are exactly.
    stored = np.loadtxt(folder / "frame-000000.pose.txt")
    np.testing.assert_allclose(camera_poses(first)[0][1], stored, atol=2e-4)


@needs_recordings
def test_real_stairs_sequences_have_no_invalid_depth_left(tmp_path):
    folder = RECORDINGS / "rgbd_seq" / "kapture_7scenes_stairs" / "stairs"
    for number in range(1, 5):
        summary = import_rgbd(folder / f"seq-0{number}", tmp_path / f"seq_{number}.mcap", rate=1.0)
        assert (summary.num_frames, summary.num_without_pose, summary.camera.fx) == (3, 0, 585.0)
        found = images(read_messages(tmp_path / f"seq_{number}.mcap"), "depth")
        assert [t for t, _ in found] == [0, 1_000_000_000, 2_000_000_000]
        for index, (_, image) in enumerate(found):
            raw = np.asarray(Image.open(folder / f"seq-0{number}" / f"frame-{index:06d}.depth.png"))
            np.testing.assert_array_equal(image, np.where(raw == 65535, 0, raw))
