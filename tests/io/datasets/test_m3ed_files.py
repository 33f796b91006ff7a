"""M3ED: stand-ins with the layout of the authors' HDF5 files, converted to logs and mapped; damaged files."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from octoreplay.config.team_file import load_team_file
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.containers.log_reader import first_whole_message
from octoreplay.io.containers.logs import open_log
from octoreplay.io.datasets.rgbd_folder import import_rgbd
from octoreplay.io.datasets.rgbd_layouts import find_layout
from octoreplay.io.messages.sensor_messages import Kind
from support.command_line import octoreplay
from support.data_set_walls import FORWARD, WALL, mapped, pose, seen

COUNT, WIDTH, HEIGHT = 4, 320, 180
INTRINSICS = (200.0, 205.0, 150.0, 95.0)
# Without this distortion the edge of the wall would be 0.3 m outside.
DISTORTION = (0.9, 0.3, 0.01, -0.01)
NAME = "car_urban_day_wall"
IMAGES = "depth/prophesee/left"


def image(index: int) -> np.ndarray:
    """Depth image of the wall's points, projected and stored as by the authors (fasterlio_gt.py, get_view)."""
    points = seen(pose(index) @ FORWARD).astype(np.float64)
    fx, fy, cx, cy = INTRINSICS
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(DISTORTION))[0][:, 0]
    inside = (pixels >= 0).all(axis=1) & (pixels < (WIDTH, HEIGHT)).all(axis=1)
    u, v = pixels[inside].astype(int).T
    depth = np.full((HEIGHT, WIDTH), np.inf)
    depth[v, u] = points[inside, 2]
    return depth


def m3ed(folder: Path) -> Path:
    """A sequence as stored by the authors' download script, with poses relative to the first camera."""
    place = folder / NAME
    place.mkdir(parents=True)
    with h5py.File(place / f"{NAME}_depth_gt.h5", "w") as file:
        first = pose(0) @ FORWARD
        file["Cn_T_C0"] = np.stack([np.linalg.inv(pose(k) @ FORWARD) @ first for k in range(COUNT)])
        file["Ln_T_L0"] = np.stack([np.linalg.inv(pose(k)) @ pose(0) for k in range(COUNT)])
        file["ts"] = np.array([81_938 + 99_980 * k for k in range(COUNT)], np.int64)
        file["ts_map_prophesee_left"] = np.arange(COUNT, dtype=np.uint64)
        file.create_dataset(
            IMAGES, data=np.stack([image(k) for k in range(COUNT)]), dtype="f4", chunks=(1, HEIGHT, WIDTH),
            compression="lzf",
        )  # fmt: skip
    with h5py.File(place / f"{NAME}_data.h5", "w") as file:
        calibration = file.create_group("prophesee/left/calib")
        calibration["T_to_prophesee_left"] = np.eye(4)
        calibration["camera_model"], calibration["distortion_model"] = "pinhole", "radtan"
        calibration["distortion_coeffs"] = np.array(DISTORTION)
        calibration["intrinsics"] = np.array(INTRINSICS)
        calibration["resolution"] = np.array([WIDTH, HEIGHT])
        file["prophesee/left/t"] = np.arange(10)
    return place


def test_depth_of_the_left_event_camera_is_mapped_with_its_lens(tmp_path):
    m3ed(tmp_path / "in")
    done = octoreplay("dataset", "m3ed", tmp_path / "in", "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    [robot] = load_team_file(tmp_path / "out" / "team.yaml").robots
    assert robot.robot_id == NAME
    # The map has the axes of the first camera's body.
    first = np.linalg.inv(pose(0))
    mapped(tmp_path / "out" / "team.yaml", wall=WALL @ first[:3, :3].T + first[:3, 3])


def test_the_log_has_the_own_times_and_the_distortion_of_the_images(tmp_path):
    place = m3ed(tmp_path)
    summary = import_rgbd(place, tmp_path / "a.mcap", every=2)
    assert (summary.layout, summary.num_frames, summary.duration) == ("M3ED", 2, 0.19996)
    with open_log(tmp_path / "a.mcap") as log:
        message = first_whole_message(log, "/a/camera/depth/camera_info", (Kind.CAMERA_INFO,))
        calibration = message.sensor_message()
    assert message.sensor_message().stamp_ns == 81_938_000
    assert calibration.model == "plumb_bob"
    assert calibration.D.tolist() == [*DISTORTION, 0.0]
    # The centre of pixel 0 is at 0.5 in the authors' projection.
    assert calibration.K[:2, 2].tolist() == [149.5, 94.5]
    # Given intrinsics replace the lens too.
    assert import_rgbd(place, tmp_path / "b.mcap", intrinsics=(9, 9, 1, 1)).camera.fx == 9
    with open_log(tmp_path / "b.mcap") as log:
        given = first_whole_message(log, "/b/camera/depth/camera_info", (Kind.CAMERA_INFO,)).sensor_message()
    assert not given.D.any()


def test_a_frame_without_a_finite_pose_is_left_out(tmp_path):
    place = m3ed(tmp_path)
    with h5py.File(place / f"{NAME}_depth_gt.h5", "a") as file:
        file["Cn_T_C0"][1] = np.nan
    assert import_rgbd(place, tmp_path / "a.mcap").num_without_pose == 1


def test_a_sequence_without_its_calibration_is_refused(tmp_path):
    place = m3ed(tmp_path / "in")
    (place / f"{NAME}_data.h5").unlink()
    done = octoreplay("dataset", "m3ed", tmp_path / "in", "-o", tmp_path / "out")
    assert (done.returncode, (tmp_path / "out").exists()) == (1, False)
    assert f"{NAME}_data.h5: not found; it has the calibration" in done.stderr
    with pytest.raises(ConfigError, match="no intrinsics; give fx, fy, cx, cy"):
        import_rgbd(place, tmp_path / "a.mcap")


def test_two_sequences_in_one_folder_are_refused(tmp_path):
    place = m3ed(tmp_path)
    (place / "b_depth_gt.h5").touch()
    with pytest.raises(InputError, match="holds 2 files"):
        find_layout(place)


def test_without_h5py_the_extra_is_named(tmp_path, monkeypatch):
    place = m3ed(tmp_path)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ConfigError, match=r"pip install 'octoreplay\[h5\]'"):
        find_layout(place)


def replaced(name: str, **options: object) -> Callable[[h5py.File], None]:
    """Function that replaces a dataset of a file."""

    def replace(file: h5py.File) -> None:
        del file[name]
        file.create_dataset(name, **options)

    return replace


def external(file: h5py.File) -> None:
    del file["ts"]
    file["ts"] = h5py.ExternalLink(f"{NAME}_data.h5", "/prophesee/left/t")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (replaced("ts", data=np.arange(5)), r"'Cn_T_C0' has the shape \(4, 4, 4\); expects 5 x 4 x 4"),
        (replaced("ts", data=[b"a"] * COUNT), "'ts' has values of type"),
        (replaced("ts", data=np.full(COUNT, np.nan)), "'ts' has times that are not finite"),
        (replaced("ts", shape=(1 << 21,), dtype="i8"), "N up to 1048576"),
        (replaced("ts", shape=(COUNT,), dtype="i8", chunks=(1 << 27,), maxshape=(None,)), "chunks of"),
        (replaced("ts", data=np.arange(COUNT), compression="gzip"), "is compressed with gzip"),
        (replaced("Cn_T_C0", data=np.full((COUNT, 4, 4), 2.0)), "is not a rotation"),
        (replaced(IMAGES, shape=(COUNT, 1 << 15, 1 << 15), dtype="f4"), "too large for the file"),
        (replaced(IMAGES, shape=(COUNT, 60, 60), dtype="f4", chunks=(4, 60, 60)), "expects one image in a chunk"),
        (lambda file: file.pop("depth"), f"has no dataset '{IMAGES}'"),
        (external, "is not a dataset inside this file"),
    ],
)  # fmt: skip
def test_other_files_are_refused_before_their_arrays_are_read(tmp_path, damage, message):
    place = m3ed(tmp_path)
    with h5py.File(place / f"{NAME}_depth_gt.h5", "a") as file:
        damage(file)
    with pytest.raises(InputError, match=message):
        find_layout(place)


def test_damaged_files_give_one_sentence_and_no_log(tmp_path):
    place = m3ed(tmp_path)
    path = place / f"{NAME}_depth_gt.h5"
    with h5py.File(path) as file:
        chunk = file[IMAGES].id.get_chunk_info_by_coord((2, 0, 0))
    whole = path.read_bytes()
    damaged = bytearray(whole)
    damaged[chunk.byte_offset : chunk.byte_offset + chunk.size] = b"\xff" * chunk.size
    for content in (b"", b"\x89HDF\r\n\x1a\n", whole[: len(whole) // 2], bytes(damaged)):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"is damaged, or not an HDF5 file: [^\n]+$"):
            import_rgbd(place, tmp_path / "a.mcap")
    assert not (tmp_path / "a.mcap").exists()
    path.write_bytes(whole)
    with h5py.File(place / f"{NAME}_data.h5", "a") as file:
        file["prophesee/left/calib/intrinsics"][0] = 0.0
    with pytest.raises(InputError, match="is not a camera"):
        import_rgbd(place, tmp_path / "a.mcap")
