"""PCD files: written here by hand and by Open3D, real ones, and damaged ones."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from octoreplay.errors import InputError
from octoreplay.io.datasets.pcd import _unpack_lzf, read_pcd, read_viewpoint
from support.recordings import RECORDINGS, needs_recordings

HEADER = (
    "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z label\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 3\nHEIGHT 1\n"
    "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA {}\n"
)
ROWS = "1 2 3 7\n-1.5 nan 0 8\n4 5 6 9\n"
POINTS = np.array([(1, 2, 3, 7), (-1.5, np.nan, 0, 8), (4, 5, 6, 9)], dtype="<f4,<f4,<f4,<u4")


def save(path: Path, text: str, data: bytes = b"") -> Path:
    path.write_bytes(text.encode() + data)
    return path


def literal_lzf(data: bytes) -> bytes:
    """LZF data of literals alone, in runs of at most 32 bytes."""
    return b"".join(bytes([len(data[k : k + 32]) - 1]) + data[k : k + 32] for k in range(0, len(data), 32))


def compressed(points: np.ndarray) -> bytes:
    plain = b"".join(points[name].tobytes() for name in points.dtype.names)
    packed = literal_lzf(plain)
    return struct.pack("<II", len(packed), len(plain)) + packed


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_the_three_encodings_hold_the_same_points(tmp_path, data):
    body = {"ascii": ROWS.encode(), "binary": POINTS.tobytes(), "binary_compressed": compressed(POINTS)}[data]
    columns, extra = read_pcd(save(tmp_path / "a.pcd", HEADER.format(data), body))
    assert (list(columns), extra) == (["x", "y", "z", "label"], 0)
    for name, stored in zip(columns, POINTS.dtype.names, strict=True):
        assert columns[name].dtype == POINTS[stored].dtype
        np.testing.assert_array_equal(columns[name], POINTS[stored])


@pytest.mark.parametrize("options", [{"write_ascii": True}, {}, {"compressed": True}])
def test_files_of_open3d_are_read_to_the_bit(tmp_path, options):
    o3d = pytest.importorskip("open3d")
    rng = np.random.default_rng(1)
    # Rounded numbers repeat, so that the compressed file has copies of several distances.
    positions = np.round(rng.normal(size=(5000, 3)) * 4).astype(np.float32)
    positions[:40] = rng.normal(size=(40, 3))
    labels = rng.integers(-3, 70000, size=(5000, 1)).astype(np.int32)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(positions))
    cloud.point["label"] = o3d.core.Tensor(labels)
    assert o3d.t.io.write_point_cloud(str(tmp_path / "a.pcd"), cloud, **options)
    columns, _ = read_pcd(tmp_path / "a.pcd")
    np.testing.assert_array_equal(np.stack([columns[name] for name in "xyz"], axis=1), positions)
    np.testing.assert_array_equal(columns["label"], labels[:, 0])


def test_fields_of_several_numbers_and_of_one_name_do_not_shift_the_rest(tmp_path):
    header = (
        "FIELDS _ x _ y z label\nSIZE 1 8 2 8 8 1\nTYPE U F I F F I\nCOUNT 3 1 2 1 1 1\nWIDTH 2\nHEIGHT 1\nDATA {}\n"
    )
    points = np.zeros(2, "3u1,<f8,2<i2,<f8,<f8,i1")
    for name, values in zip(("f1", "f3", "f4", "f5"), ([1, 5], [2, 6], [3, 7], [-4, 8]), strict=True):
        points[name] = values
    points["f0"], points["f2"] = 99, 77
    rows = "9 9 9 1 0 0 2 3 -4\n9 9 9 5 0 0 6 7 8\n"
    for data, body in (
        ("ascii", rows.encode()),
        ("binary", points.tobytes()),
        ("binary_compressed", compressed(points)),
    ):
        columns, extra = read_pcd(save(tmp_path / "a.pcd", header.format(data), body))
        assert (list(columns), extra) == (["x", "y", "z", "label"], 0)
        np.testing.assert_array_equal(np.array(list(columns.values())), [[1, 5], [2, 6], [3, 7], [-4, 8]])
        assert columns["x"].dtype == np.float64


def test_extra_columns_of_a_text_are_counted_and_not_read(tmp_path):
    columns, extra = read_pcd(save(tmp_path / "a.pcd", HEADER.format("ascii"), b"1 2 3 7 -1 5\n" * 3))
    assert extra == 2
    np.testing.assert_array_equal(columns["label"], [7, 7, 7])


def test_a_number_out_of_its_types_range_is_kept(tmp_path):
    columns, _ = read_pcd(save(tmp_path / "a.pcd", HEADER.format("ascii"), b"1 2 3 -1\n1 2 3 4\n1 2 3 nan\n"))
    np.testing.assert_array_equal(columns["label"], [-1, 4, np.nan])


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_a_file_may_hold_no_points(tmp_path, data):
    header = HEADER.replace("WIDTH 3", "WIDTH 0").replace("POINTS 3", "POINTS 0").format(data)
    body = struct.pack("<II", 0, 0) if data == "binary_compressed" else b""
    columns, _ = read_pcd(save(tmp_path / "a.pcd", header, body))
    assert {name: len(column) for name, column in columns.items()} == {"x": 0, "y": 0, "z": 0, "label": 0}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [("DATA ascii", "", "is not a PCD file, or is cut: its header has no line 'DATA'"),
     ("DATA ascii", "DATA zip", "its data is 'zip'; expects ascii"),
     ("FIELDS x y z label", "", "FIELDS, SIZE, TYPE and COUNT do not fit together"),
     ("SIZE 4 4 4 4", "SIZE 4 4 4", "FIELDS, SIZE, TYPE and COUNT do not fit together"),
     ("SIZE 4 4 4 4", "SIZE 4 4 4 four", "line SIZE is '4 4 4 four'; expects integers"),
     ("SIZE 4 4 4 4", "SIZE 4 4 4 3", "field 'label' has the unknown type U with 1 x 3 bytes"),
     ("COUNT 1 1 1 1", "COUNT 1 1 1 999999999999", "field 'label' has the unknown type"),
     ("COUNT 1 1 1 1", "COUNT 1 1 1 0", "field 'label' has the unknown type"),
     ("POINTS 3", "POINTS 4", "POINTS, WIDTH and HEIGHT do not fit together"),
     ("POINTS 3", "POINTS -3", "POINTS, WIDTH and HEIGHT do not fit together"),
     ("VIEWPOINT 0 0 0 1 0 0 0", "VIEWPOINT 0 0 0", "VIEWPOINT is '0 0 0'; expects 7 numbers"),
     ("FIELDS x y z label\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1",
      "FIELDS x y z label more\nSIZE 4 4 4 4 4\nTYPE F F F U U\nCOUNT 1 1 1 1 1", "gives 5 columns, but its rows"),
     ("-1.5 nan 0 8", "", "gives 3 points, but it has 2 rows"),
     ("4 5 6 9", "4 5 6 9\n4 5 6 9", "gives 3 points, but it has 4 rows"),
     ("4 5 6 9", "4 5", "row 3 has 2 columns, the first one 4"),
     ("4 5 6 9", "4 5 six 9", "row 3 is not numbers: '4 5 six 9'")],
)  # fmt: skip
def test_damage_is_one_sentence(tmp_path, old, new, message):
    text = HEADER.format("ascii") + ROWS
    assert old in text
    with pytest.raises(InputError, match=rf"a\.pcd: .*{message}"):
        read_pcd(save(tmp_path / "a.pcd", text.replace(old, new)))


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_a_file_cut_anywhere_is_never_read(tmp_path, data):
    body = {"ascii": ROWS.encode(), "binary": POINTS.tobytes(), "binary_compressed": compressed(POINTS)}[data]
    whole = HEADER.format(data).encode() + body
    # A text file may lack its last line break, and a lost last digit cannot be detected.
    for length in range(len(whole) - (2 if data == "ascii" else 0)):
        (tmp_path / "a.pcd").write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"a\.pcd: "):
            read_pcd(tmp_path / "a.pcd")


def test_more_binary_points_than_the_header_gives_are_refused(tmp_path):
    with pytest.raises(InputError, match="gives 3 points of 16 bytes, but it holds 64 bytes"):
        read_pcd(save(tmp_path / "a.pcd", HEADER.format("binary"), POINTS.tobytes() + bytes(16)))
    read_pcd(save(tmp_path / "a.pcd", HEADER.format("binary"), POINTS.tobytes() + b"\n"))


@given(st.binary(max_size=400))
def test_random_data_is_refused_in_one_sentence(tmp_path_factory, body):
    path = tmp_path_factory.getbasetemp() / "any.pcd"
    for data in ("ascii", "binary", "binary_compressed"):
        try:
            columns, _ = read_pcd(save(path, HEADER.format(data), body))
        except InputError:
            continue
        assert all(len(column) == 3 for column in columns.values())


literals = st.binary(min_size=1, max_size=32)
copies = st.tuples(st.integers(3, 264), st.integers(1, 8192))


@given(st.lists(st.one_of(literals, copies), max_size=30))
def test_lzf_literals_and_copies_are_unpacked(pieces):
    packed, plain = bytearray(), bytearray()
    for piece in pieces:
        if isinstance(piece, bytes):
            packed += bytes([len(piece) - 1]) + piece
            plain += piece
            continue
        length, distance = piece
        if distance > len(plain):
            continue
        short = length - 2
        high, low = divmod(distance - 1, 256)
        packed += bytes([(min(short, 7) << 5) | high]) + (bytes([short - 7]) if short >= 7 else b"") + bytes([low])
        for _ in range(length):
            plain.append(plain[-distance])
    assert _unpack_lzf(bytes(packed), len(plain)) == plain
    assert _unpack_lzf(bytes(packed), len(plain) + 1) is None


def test_viewpoint_is_position_then_quaternion_with_w_first(tmp_path):
    rotation = Rotation.from_euler("zyx", [0.4, -0.2, 0.1])
    x, y, z, w = rotation.as_quat()
    path = save(tmp_path / "a.pcd", HEADER.replace("0 0 0 1 0 0 0", f"1 2 3 {w} {x} {y} {z}").format("ascii"))
    T = read_viewpoint(path)
    assert T is not None
    np.testing.assert_allclose(T[:3, :3], rotation.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(T[:, 3], [1, 2, 3, 1])


@pytest.mark.parametrize("line", ["VIEWPOINT 0 0 0 0 0 0 0", "VIEWPOINT nan 0 0 1 0 0 0", ""])
def test_a_viewpoint_without_a_direction_is_none(tmp_path, line):
    path = save(tmp_path / "a.pcd", HEADER.replace("VIEWPOINT 0 0 0 1 0 0 0", line).format("ascii"))
    assert read_viewpoint(path) is None


@needs_recordings
def test_the_fourth_column_of_the_real_scans_is_the_label():
    """The rows have five columns for four fields; near points of two scans agree in the fourth alone."""
    from scipy.spatial import cKDTree

    folder = RECORDINGS / "semantic_pcd" / "bki_sim"
    clouds = []
    for number in (1, 6):
        path = folder / f"sim_unstructured_annotated_{number}.pcd"
        columns, extra = read_pcd(path)
        assert extra == 1
        assert set(np.unique(columns["label"])) == {1, 2, 3}
        assert {line.split()[4] for line in path.read_text().splitlines()[11:]} == {"-1"}
        clouds.append((np.stack([columns[name] for name in "xyz"], axis=1), columns["label"]))
    (first, first_labels), (second, second_labels) = clouds
    distances, nearest = cKDTree(second).query(first)
    near = distances < 0.1
    assert near.sum() > 100
    assert np.mean(first_labels[near] == second_labels[nearest[near]]) > 0.95
