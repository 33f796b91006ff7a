"""Point cloud files: fields, labels, colours and damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from octoreplay.errors import InputError
from octoreplay.io.datasets.cloud_files import read_cloud, read_kitti_labels
from support.recordings import RECORDINGS, needs_recordings

XYZ = [("x", "f4"), ("y", "f4"), ("z", "f4")]


def vertices(fields: list[tuple[str, str]], count: int = 3) -> np.ndarray:
    points = np.zeros(count, [*XYZ, *fields])
    for axis, name in enumerate("xyz"):
        points[name] = np.arange(count) + 10 * axis
    return points


def save_ply(path: Path, points: np.ndarray, *, text: bool = False, order: str = "<") -> Path:
    PlyData([PlyElement.describe(points, "vertex")], text=text, byte_order=order).write(str(path))
    return path


def save_pcd(path: Path, names: str, sizes: str, types: str, rows: list[str]) -> Path:
    path.write_text(
        f"FIELDS {names}\nSIZE {sizes}\nTYPE {types}\nWIDTH {len(rows)}\nHEIGHT 1\nDATA ascii\n" + "\n".join(rows)
    )
    return path


@pytest.mark.parametrize(("text", "order"), [(True, "="), (False, "<"), (False, ">")])
def test_ply_in_every_encoding(tmp_path, text, order):
    points = vertices([("red", "u1"), ("green", "u1"), ("blue", "u1"), ("intensity", "f8"), ("semantic", "i2")])
    points["red"], points["green"], points["blue"] = 1, 2, [3, 4, 255]
    points["intensity"], points["semantic"] = 0.5, [40, -1, 7]
    cloud = read_cloud(save_ply(tmp_path / "a.PLY", points, text=text, order=order))
    np.testing.assert_array_equal(cloud.points, [[0, 10, 20], [1, 11, 21], [2, 12, 22]])
    assert cloud.points.dtype == np.dtype("=f4")
    assert cloud.rgb is not None
    assert cloud.rgb.tolist() == [0x010203, 0x010204, 0x0102FF]
    assert cloud.labels is not None
    assert cloud.labels.tolist() == [40, 65535, 7]
    assert cloud.intensity is not None
    assert cloud.intensity.tolist() == [0.5] * 3


def test_a_ply_mesh_gives_its_vertices(tmp_path):
    faces = np.array([([0, 1, 2],)], dtype=[("vertex_indices", "i4", (3,))])
    elements = [PlyElement.describe(vertices([]), "vertex"), PlyElement.describe(faces, "face")]
    for text in (True, False):
        PlyData(elements, text=text).write(str(tmp_path / "a.ply"))
        assert len(read_cloud(tmp_path / "a.ply").points) == 3


def test_packed_colours_of_the_other_byte_order(tmp_path):
    points = vertices([("rgb", "i4")])
    points["rgb"] = [0x010203, 0x040506, 0x070809]
    cloud = read_cloud(save_ply(tmp_path / "a.ply", points, order=">"))
    assert cloud.rgb is not None
    assert cloud.rgb.tolist() == [0x010203, 0x040506, 0x070809]


def test_large_coordinates_keep_their_digits(tmp_path):
    points = np.array([(4_500_000.001, 1.0, 2.0)], dtype=[("x", "f8"), ("y", "f4"), ("z", "f4")])
    assert read_cloud(save_ply(tmp_path / "a.ply", points)).points[0, 0] == 4_500_000.001


@pytest.mark.parametrize("text", [True, False])
def test_a_ply_file_cut_anywhere_is_never_read(tmp_path, text):
    whole = save_ply(tmp_path / "a.ply", vertices([]), text=text).read_bytes()
    for length in range(len(whole) - (2 if text else 0)):
        (tmp_path / "a.ply").write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"a\.ply: is cut or damaged: .*; fetch it again"):
            read_cloud(tmp_path / "a.ply")


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize(
    ("new", "message"),
    [(b"vertex 2", "it is longer than its header says"), (b"vertex 4000000000000", "is cut or damaged"),
     (b"vertex -3", "is cut or damaged"), (b"vertex three", "is cut or damaged"), (b"point 3", "no element 'vertex'")],
)  # fmt: skip
def test_a_wrong_ply_header_is_refused(tmp_path, text, new, message):
    whole = save_ply(tmp_path / "a.ply", vertices([]), text=text).read_bytes()
    (tmp_path / "a.ply").write_bytes(whole.replace(b"vertex 3", new))
    with pytest.raises(InputError, match=rf"a\.ply: .*{message}"):
        read_cloud(tmp_path / "a.ply")


def test_damaged_bytes_are_refused_in_one_sentence(tmp_path):
    rng = np.random.default_rng(3)
    whole = save_ply(tmp_path / "a.ply", vertices([("label", "u1")]), text=True).read_bytes()
    for _ in range(300):
        damaged = bytearray(whole)
        for _ in range(2):
            damaged[rng.integers(len(damaged))] = rng.integers(256)
        (tmp_path / "a.ply").write_bytes(damaged)
        try:
            assert read_cloud(tmp_path / "a.ply").points.shape[1] == 3
        except InputError as error:
            assert str(error).startswith(str(tmp_path / "a.ply"))  # noqa: PT017 - one of several outcomes


def test_pcl_colours_are_the_bits_of_a_float_or_an_integer(tmp_path):
    bits = np.array([0x00102030, 0x00FFFEFD], np.uint32)
    for kind, words in (("F", bits.view(np.float32)), ("U", bits)):
        rows = [f"1 2 3 {word!r}" for word in words.tolist()]
        cloud = read_cloud(save_pcd(tmp_path / "a.pcd", "x y z rgb", "4 4 4 4", f"F F F {kind}", rows))
        assert cloud.rgb is not None
        assert cloud.rgb.tolist() == bits.tolist()
    rows = ["1 2 3 4278190081"]
    cloud = read_cloud(save_pcd(tmp_path / "a.pcd", "x y z rgba", "4 4 4 4", "F F F U", rows))
    assert cloud.rgb is not None
    assert cloud.rgb.tolist() == [1]


def test_invalid_labels_are_65535(tmp_path):
    rows = ["1 2 3 5", "1 2 3 -1", "1 2 3 nan", "1 2 3 4294967295", "1 2 3 70000"]
    cloud = read_cloud(save_pcd(tmp_path / "a.pcd", "x y z class", "4 4 4 4", "F F F F", rows))
    assert cloud.labels is not None
    assert cloud.labels.tolist() == [5, 65535, 65535, 65535, 70000]
    rows = ["1 2 3 4294967294", "1 2 3 4294967295"]
    cloud = read_cloud(save_pcd(tmp_path / "a.pcd", "x y z class", "4 4 4 4", "F F F U", rows))
    assert cloud.labels is not None
    assert cloud.labels.tolist() == [4294967294, 65535]


def test_a_cloud_without_coordinates_names_its_fields(tmp_path):
    path = save_pcd(tmp_path / "a.pcd", "x y label", "4 4 4", "F F U", ["1 2 3"])
    with pytest.raises(InputError, match=r"has no field 'z' with one number per point; its fields are x, y, label"):
        read_cloud(path)


def test_kitti_clouds_and_labels(tmp_path):
    points = np.arange(12, dtype="<f4").reshape(3, 4)
    (tmp_path / "0.bin").write_bytes(points.tobytes())
    cloud = read_cloud(tmp_path / "0.bin")
    np.testing.assert_array_equal(cloud.points, points[:, :3])
    assert cloud.intensity is not None
    np.testing.assert_array_equal(cloud.intensity, points[:, 3])
    assert (cloud.labels, cloud.rgb) == (None, None)
    (tmp_path / "0.label").write_bytes(np.array([40, 5 << 16 | 252, 0xFFFF0000], "<u4").tobytes())
    assert read_kitti_labels(tmp_path / "0.label", 3).tolist() == [40, 252, 0]
    with pytest.raises(InputError, match=r"0\.label: holds 3 labels of 4 bytes, but its cloud has 4 points"):
        read_kitti_labels(tmp_path / "0.label", 4)


@pytest.mark.parametrize(("name", "size"), [("0.bin", 50), ("0.pcd.bin", 80)])
def test_bin_files_of_another_layout_are_refused(tmp_path, name, size):
    (tmp_path / name).write_bytes(bytes(size))
    with pytest.raises(InputError, match=rf"{size} bytes are not KITTI's points of 16 bytes"):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize("name", ["a.pcd", "a.ply", "a.bin"])
def test_a_missing_file_is_one_sentence(tmp_path, name):
    with pytest.raises(InputError, match="cannot be read: No such file"):
        read_cloud(tmp_path / name)


@needs_recordings
def test_a_real_kitti_cloud_with_its_labels():
    folder = RECORDINGS / "semantic_misc" / "mmdet3d_semantickitti" / "sequences" / "00"
    cloud = read_cloud(folder / "velodyne" / "000000.bin")
    labels = read_kitti_labels(folder / "labels" / "000000.label", len(cloud.points))
    assert cloud.points.shape == (50, 3)
    assert set(labels.tolist()) == {0, 50, 52, 70, 71, 80}
    ranges = np.linalg.norm(cloud.points, axis=1)
    assert ranges.min() > 1
    assert ranges.max() < 120
