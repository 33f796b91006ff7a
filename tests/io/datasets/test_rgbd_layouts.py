"""Layouts of folders of depth images, each as its authors describe it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from octoreplay.errors import ConfigError, InputError
from octoreplay.io.datasets.rgbd_folder import import_rgbd
from octoreplay.io.datasets.rgbd_layouts import find_sequences
from support.poses import pose
from support.stored_messages import matrix, pixels, read_messages

K = "4 0 2.5\n0 4.5 1.5\n0 0 1\n"
COUNT = 3


def depth(index: int) -> np.ndarray:
    """Depth image in millimetres."""
    values = np.arange(24, dtype=np.uint16).reshape(4, 6) * 100 + 50 + index
    values[0, 0] = 0
    return values


def save(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)


def matrices(indices: range = range(COUNT), num_rows: int = 4, T: np.ndarray | None = None) -> str:
    """Text with one matrix in each line."""
    left = np.eye(4) if T is None else T
    return "\n".join(" ".join(map(repr, (left @ pose(k) @ left)[:num_rows].ravel().tolist())) for k in indices)


def redwood_log(indices: range = range(COUNT)) -> str:
    rows = []
    for k in indices:
        rows += [f"{k} {k} {k + 1}", *(" ".join(map(repr, row)) for row in pose(k).tolist())]
    return "\n".join(rows)


def redwood(folder: Path) -> None:
    for k in range(COUNT):
        save(folder / "depth" / f"{k + 1:05d}-{k * 33369:012d}.png", depth(k))
    (folder / "trajectory.log").write_text(redwood_log())
    camera = {"width": 6, "height": 4, "intrinsic_matrix": [4, 0, 0, 0, 4.5, 0, 2.5, 1.5, 1]}
    (folder / "camera_intrinsic.json").write_text(json.dumps(camera))


def sun3d(folder: Path) -> None:
    """Four colour images for three depth images; the values are rotated by three bits."""
    for k in range(COUNT):
        values = depth(k)
        save(folder / "depth" / f"{k:07d}-{k * 33369 + 5:012d}.png", (values << 3) | (values >> 13))
    for k in range(COUNT + 1):
        save(folder / "image" / f"{k:07d}-{k * 33369:012d}.jpg", np.zeros((4, 6, 3), np.uint8))
    (folder / "extrinsics").mkdir()
    (folder / "extrinsics" / "20130101000000.txt").write_text("not the last version")
    lines = matrices(range(COUNT + 1), num_rows=3).split()
    rows = [" ".join(lines[k : k + 4]) for k in range(0, len(lines), 4)]
    (folder / "extrinsics" / "20140101000000.txt").write_text("\n".join(rows))
    (folder / "intrinsics.txt").write_text(K)


def replica(folder: Path) -> None:
    for k in range(COUNT):
        save(folder / "results" / f"depth{k:06d}.png", depth(k))
    (folder / "traj.txt").write_text(matrices())
    camera = {"camera": {"w": 6, "h": 4, "fx": 4.0, "fy": 4.5, "cx": 2.5, "cy": 1.5, "scale": 1000.0}}
    (folder.parent / "cam_params.json").write_text(json.dumps(camera))


def matrix_table(folder: Path) -> None:
    for k in range(COUNT):
        save(folder / "depth" / f"{k}.png", depth(k))
    (folder / "poses.txt").write_text(matrices(num_rows=3))
    (folder / "intrinsics.txt").write_text(K)


def habitat(folder: Path) -> None:
    """NumPy files in metres, and poses of a camera that looks along -z."""
    (folder / "depth").mkdir(parents=True)
    for k in range(COUNT):
        np.save(folder / "depth" / f"{k}.npy", depth(k)[..., None] / np.float32(1000))
    opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    rows = [(pose(k) @ opengl)[:3].ravel().tolist() for k in range(COUNT)]
    (folder / "poses.txt").write_text("\n".join(" ".join(map(repr, row)) for row in rows))
    (folder / "intrinsics.txt").write_text(K)


LAYOUTS = {
    "Redwood": (redwood, {}), "SUN3D": (sun3d, {}), "Replica": (replica, {"rate": 1.0}),
    "depth/ with poses": (matrix_table, {"rate": 1.0}),
}  # fmt: skip


def written(path: Path) -> tuple[list[np.ndarray], list[np.ndarray], list[int]]:
    """Depth images in metres, camera poses and stamps of a log."""
    messages = read_messages(path)
    [(_, tf)] = next(found for topic, found in messages.items() if topic == "/tf_static")
    T_body_camera = matrix(tf.transforms[0].transform.translation, tf.transforms[0].transform.rotation)
    [odometry] = [found for topic, found in messages.items() if topic.endswith("/odom")]
    poses = [matrix(m.pose.pose.position, m.pose.pose.orientation) @ T_body_camera for _, m in odometry]
    [found] = [found for topic, found in messages.items() if "/depth/image" in topic]
    images = [pixels(message) for _, message in found]
    metres = [np.nan_to_num(i) if i.dtype == np.float32 else i / np.float32(1000) for i in images]
    return metres, poses, [stamp for stamp, _ in found]


def check(path: Path, count: int = COUNT) -> list[int]:
    """Compare a log with the images and poses; return its stamps."""
    images, poses, stamps = written(path)
    assert len(images) == count
    for k, (image, T) in enumerate(zip(images, poses, strict=True)):
        np.testing.assert_allclose(image, depth(k) / 1000, atol=1e-6)
        np.testing.assert_allclose(T, pose(k), atol=1e-9)
    return stamps


@pytest.mark.parametrize("name", LAYOUTS)
def test_images_poses_and_camera(tmp_path: Path, name: str) -> None:
    make, options = LAYOUTS[name]
    make(tmp_path / "in")
    summary = import_rgbd(tmp_path / "in", tmp_path / "a.mcap", **options)
    assert (summary.layout, summary.num_frames, summary.num_without_pose) == (name, COUNT, 0)
    camera = summary.camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (6, 4, 4.0, 4.5, 2.5, 1.5)
    stamps = check(tmp_path / "a.mcap")
    first = {"SUN3D": [5_000, 33_374_000, 66_743_000], "Redwood": [0, 33_369_000, 66_738_000]}
    assert stamps == first.get(name, [0, 10**9, 2 * 10**9])


def test_habitat_looks_backward_along_z(tmp_path: Path) -> None:
    habitat(tmp_path / "in")
    summary = import_rgbd(tmp_path / "in", tmp_path / "a.mcap", rate=1.0, camera_axes="opengl")
    assert summary.layout == "depth/ with poses"
    check(tmp_path / "a.mcap")
    with pytest.raises(ConfigError, match="camera_axes: 'ned' is not one of optical, opengl"):
        import_rgbd(tmp_path / "in", tmp_path / "b.mcap", rate=1.0, camera_axes="ned")


def test_replica_for_semantic_nerf_has_labels_of_the_same_number(tmp_path: Path) -> None:
    for k in (2, 10, 9):
        save(tmp_path / "in" / "depth" / f"depth_{k}.png", np.full((480, 640), k, np.uint16))
        save(tmp_path / "in" / "semantic_class" / f"semantic_class_{k}.png", np.full((480, 640), k, np.uint8))
        save(tmp_path / "in" / "semantic_class" / f"vis_sem_class_{k}.png", np.zeros((480, 640, 3), np.uint8))
    (tmp_path / "in" / "traj_w_c.txt").write_text(matrices())
    summary = import_rgbd(tmp_path / "in", tmp_path / "a.mcap", rate=1.0)
    assert (summary.layout, summary.num_labelled, summary.camera.fx) == ("Replica (Semantic-NeRF)", 3, 320.0)
    messages = read_messages(tmp_path / "a.mcap")
    [labels] = [found for topic, found in messages.items() if "/labels/image" in topic]
    assert [int(pixels(message)[0, 0]) for _, message in labels] == [2, 9, 10]


@pytest.mark.parametrize("kind", ["png", "ranges"])
def test_icl_nuim_is_read_with_y_down(tmp_path: Path, kind: str) -> None:
    """A point above the camera's axis is above it in the map, in a right-handed frame."""
    folder, plane = tmp_path / "in", np.full((480, 640), 10_000, np.uint16)
    if kind == "png":
        for k in range(1, 4):
            save(folder / "depth" / f"{k}.png", plane)
    else:
        folder.mkdir()
        u, v = np.meshgrid((np.arange(640) - 319.5) / 481.2, (np.arange(480) - 239.5) / -480.0)
        ranges = 2.0 * np.sqrt(u**2 + v**2 + 1)
        for k in range(1, 4):
            (folder / f"scene_00_{k:04d}.depth").write_text(" ".join(f"{value:.6f}" for value in ranges.ravel()))
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    rows = []
    for k in range(1, 3):
        T = flip @ pose(k) @ flip
        quaternion = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        rows.append(" ".join(map(repr, [k, *T[:3, 3].tolist(), *quaternion])))
    (folder / "livingRoom2.gt.freiburg").write_text("\n".join(rows))
    summary = import_rgbd(folder, tmp_path / "a.mcap", rate=30.0)
    assert (summary.layout, summary.num_frames, summary.num_without_pose) == ("ICL-NUIM", 2, 1)
    assert (summary.camera.fx, summary.camera.fy) == (481.2, 480.0)
    images, poses, _ = written(tmp_path / "a.mcap")
    np.testing.assert_allclose(images[0], 2.0, atol=1e-5)
    for k, T in enumerate(poses, start=1):
        np.testing.assert_allclose(T, pose(k), atol=1e-9)


def test_a_folder_of_sequences_names_its_sequences(tmp_path: Path) -> None:
    for name in ("seq-10", "seq-9"):
        matrix_table(tmp_path / "in" / name)
    (tmp_path / "in" / "notes").mkdir()
    assert [path.name for path in find_sequences(tmp_path / "in")] == ["seq-9", "seq-10"]
    assert find_sequences(tmp_path / "in" / "seq-9") == []
    with pytest.raises(InputError, match="holds 2 RGB-D sequences such as seq-9; name a folder as output"):
        import_rgbd(tmp_path / "in", tmp_path / "a.mcap", rate=1.0)


def write(name: str, text: str):
    return lambda folder: (folder / name).write_text(text)


@pytest.mark.parametrize(
    ("make", "spoiler", "message"),
    [
        (redwood, write("trajectory.log", redwood_log(range(2))), "has 2 poses for the 3 images in"),
        (redwood, write("trajectory.log", "0 0 1\n1 0 0 0"), "expects blocks of a row of 3 numbers and 4 rows"),
        (redwood, write("camera_intrinsic.json", "[]"), "expects a JSON object"),
        (redwood, write("camera_intrinsic.json", '{"intrinsic_matrix": [1]}'), "key 'intrinsic_matrix' with 9"),
        (redwood, write("camera_intrinsic.json", '{"intrinsic_matrix": [0,0,0,0,0,0,0,0,0]}'), "not a camera matrix"),
        (replica, write("../cam_params.json", '{"camera": {"fx": 1}}'), "numbers fx, fy, cx, cy and scale"),
        (replica, write("traj.txt", "1 2 3"), "line 1: is not the begin of a matrix"),
        (replica, write("traj.txt", "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1\n" * 3), "3x3 part is not a rotation"),
        (sun3d, write("extrinsics/2015.txt", matrices(range(2), 3)), "has 2 poses for the 4 images"),
        (habitat, write("depth/1.npy", "text"), "is damaged, or not a NumPy file of numbers"),
        (habitat, lambda f: np.save(f / "depth" / "1.npy", np.ones((4, 6), np.int32)), r"an array \(H, W\) of floats"),
        (habitat, lambda f: np.save(f / "depth" / "1.npy", np.ones((4, 7), np.float32)), "is 7x4 pixels"),
    ],
)  # fmt: skip
def test_damaged_files_are_named_and_no_log_is_left(tmp_path: Path, make, spoiler, message: str) -> None:
    make(tmp_path / "in")
    spoiler(tmp_path / "in")
    (tmp_path / "out").mkdir()
    with pytest.raises(InputError, match=message):
        import_rgbd(tmp_path / "in", tmp_path / "out" / "a.mcap", rate=1.0)
    assert list((tmp_path / "out").iterdir()) == []


def test_a_folder_without_a_camera_asks_for_it(tmp_path: Path) -> None:
    matrix_table(tmp_path / "in")
    (tmp_path / "in" / "intrinsics.txt").unlink()
    with pytest.raises(ConfigError, match=r"the folder has no intrinsics; give fx, fy, cx, cy \(--intrinsics\)"):
        import_rgbd(tmp_path / "in", tmp_path / "a.mcap", rate=1.0)


def test_ranges_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    (tmp_path / "scene_00_0001.depth").write_text("1 2 3")
    (tmp_path / "livingRoom0.gt.freiburg").write_text("1 0 0 0 0 0 0 1")
    with pytest.raises(InputError, match="has 3 numbers; 640x480 ranges are expected"):
        import_rgbd(tmp_path, tmp_path / "a.mcap", rate=1.0)
