"""Labelled points and triangles of PLY files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from octoreplay.errors import InputError
from octoreplay.io.datasets.ply_files import raw_labels, read_labelled_ply

CORNERS = [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (2.0, 2.0, 0.0), (0.0, 2.0, 0.0), (1.0, 3.0, 0.5)]


def save(path: Path, faces: list[list[int]] | None, labels: list[float], *, kind: str = "u1", name: str = "label",
         list_name: str = "vertex_indices", **options: object) -> Path:  # fmt: skip
    """A mesh whose faces have labels, or without faces a cloud whose vertices have them."""
    on_points = faces is None
    kinds = [("x", "f8"), ("y", "f8"), ("z", "f8"), *([(name, kind)] if on_points else [])]
    rows = [(*corner, *([labels[i]] if on_points else [])) for i, corner in enumerate(CORNERS)]
    elements = [PlyElement.describe(np.array(rows, kinds), "vertex")]
    if faces is not None:
        table = np.empty(len(faces), [(list_name, "O"), (name, kind)])
        for index, face in enumerate(faces):
            table[index] = (np.array(face, np.int32), labels[index])
        elements.append(PlyElement.describe(table, "face"))
    PlyData(elements, **options).write(str(path))
    return path


@pytest.mark.parametrize("options", [{"text": True}, {"byte_order": "<"}, {"byte_order": ">"}])
@pytest.mark.parametrize("list_name", ["vertex_indices", "vertex_index"])
def test_triangles_with_labels(tmp_path: Path, list_name: str, options: dict[str, object]) -> None:
    path = save(tmp_path / "a.ply", [[0, 1, 2], [2, 3, 4]], [7, 9], list_name=list_name, **options)
    corners, labels = read_labelled_ply(path)
    np.testing.assert_array_equal(corners, np.array(CORNERS)[[[0, 1, 2], [2, 3, 4]]])
    assert labels.tolist() == [7, 9]


@pytest.mark.parametrize("options", [{"text": True}, {"byte_order": "<"}])
def test_larger_faces_become_fans(tmp_path: Path, options: dict[str, object]) -> None:
    faces = [[0, 1, 2, 3], [0, 1], [4, 3, 2], [0, 1, 2, 4, 3]]
    corners, labels = read_labelled_ply(save(tmp_path / "a.ply", faces, [1, 2, 3, 4], **options))
    expected = [[0, 1, 2], [0, 2, 3], [4, 3, 2], [0, 1, 2], [0, 2, 4], [0, 4, 3]]
    np.testing.assert_array_equal(corners, np.array(CORNERS)[expected])
    assert labels.tolist() == [1, 1, 3, 4, 4, 4]


@pytest.mark.parametrize("kind", ["u1", "i2", "i4", "f4", "f8"])
def test_points_with_labels_of_any_type(tmp_path: Path, kind: str) -> None:
    corners, labels = read_labelled_ply(save(tmp_path / "a.ply", None, [1, 2, 3, 4, 5], kind=kind))
    np.testing.assert_array_equal(corners, np.array(CORNERS)[:, None])
    assert labels.tolist() == [1, 2, 3, 4, 5]


def test_invalid_labels() -> None:
    assert raw_labels(np.array([3.0, -1.0, np.nan, np.inf])).tolist() == [3, 65535, 65535, 65535]
    assert raw_labels(np.array([-1, 70_000], np.int32)).tolist() == [65535, 70_000]
    assert raw_labels(np.array([2**32 - 1, 8], np.uint32)).tolist() == [65535, 8]


@pytest.mark.parametrize("options", [{"text": True}, {"byte_order": "<"}])
def test_a_mesh_cut_anywhere_is_never_read(tmp_path: Path, options: dict[str, object]) -> None:
    whole = save(tmp_path / "a.ply", [[0, 1, 2], [2, 3, 4]], [7, 9], **options).read_bytes().rstrip()
    for length in range(len(whole)):
        (tmp_path / "a.ply").write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"a\.ply: "):
            read_labelled_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("index", [-1, 5])
def test_a_vertex_index_out_of_range_is_refused(tmp_path: Path, index: int) -> None:
    with pytest.raises(InputError, match=r"a\.ply: is damaged: a face has a vertex index out of range"):
        read_labelled_ply(save(tmp_path / "a.ply", [[0, 1, index]], [7]))


def test_missing_properties_of_a_mesh_are_named(tmp_path: Path) -> None:
    for path, message in (
        (save(tmp_path / "a.ply", [[0, 1, 2]], [7], name="quality"), "neither its faces nor its vertices have labels"),
        (save(tmp_path / "b.ply", [[0, 1, 2]], [7], list_name="edges"), "its faces have no list 'vertex_indices'"),
    ):
        with pytest.raises(InputError, match=message):
            read_labelled_ply(path)
    points = np.array([(0, 0, 1)], [("x", "f4"), ("z", "f4"), ("label", "u1")])
    PlyData([PlyElement.describe(points, "vertex")]).write(str(tmp_path / "c.ply"))
    with pytest.raises(InputError, match=r"c\.ply: its vertices have no numeric property 'y'"):
        read_labelled_ply(tmp_path / "c.ply")
    with pytest.raises(InputError, match=r"d\.ply: cannot be read"):
        read_labelled_ply(tmp_path / "d.ply")
