from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from octoreplay.io.results import ply
from octoreplay.records import LeafTable
from support.result_factory import leaf_table

COLORS = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9], [250, 251, 252]], dtype=np.uint8)


def test_points_hold_centres_colours_labels_and_probabilities(tmp_path: Path) -> None:
    leaves = leaf_table()
    (tmp_path / "a.ply").write_bytes(ply.mesh_file(*ply.points(leaves, COLORS), ["first", "second"]))
    data = PlyData.read(tmp_path / "a.ply")
    vertices = data["vertex"]
    assert [p.name for p in vertices.properties] == [
        "x", "y", "z", "red", "green", "blue", "label", "probability", "size",
    ]  # fmt: skip
    np.testing.assert_allclose(np.column_stack([vertices[n] for n in "xyz"]), leaves.centers, rtol=1e-6)
    assert np.column_stack([vertices[n] for n in ("red", "green", "blue")]).tolist() == COLORS.tolist()
    assert vertices["label"].tolist() == [1, 2, 1, 0]
    np.testing.assert_allclose(vertices["size"], leaves.sizes, rtol=1e-6)
    expected = [np.exp(2) / (1 + np.exp(2) + np.exp(1)), np.exp(3) / (1 + np.exp(-1) + np.exp(3))]
    np.testing.assert_allclose(vertices["probability"][:2], expected, rtol=1e-6)
    assert data.comments == ["first", "second"]
    assert data.byte_order == "<"
    assert not data.text


def test_voxels_are_closed_cubes_of_the_leaves_sizes(tmp_path: Path) -> None:
    leaves = leaf_table()
    (tmp_path / "a.ply").write_bytes(ply.mesh_file(*ply.voxels(leaves, COLORS)))
    data = PlyData.read(tmp_path / "a.ply")
    corners = np.column_stack([data["vertex"][n] for n in "xyz"]).astype(np.float64).reshape(-1, 8, 3)
    np.testing.assert_allclose(corners.mean(axis=1), leaves.centers, atol=1e-6)
    np.testing.assert_allclose(
        corners.max(axis=1) - corners.min(axis=1), np.repeat(leaves.sizes[:, None], 3, 1), atol=1e-6
    )
    assert data["vertex"]["label"].reshape(-1, 8).tolist() == [[n] * 8 for n in (1, 2, 1, 0)]
    faces = np.vstack(data["face"]["vertex_indices"]).reshape(len(leaves), 12, 3)
    for index in range(len(leaves)):
        triangles = corners[index][faces[index] - 8 * index]
        # Divergence theorem: outward faces enclose exactly the cube's volume.
        volume = np.einsum("ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])).sum() / 6
        assert volume == pytest.approx(leaves.sizes[index] ** 3, rel=1e-4)
        edges = {tuple(sorted((a, b))) for face in faces[index] for a, b in zip(face, np.roll(face, 1), strict=True)}
        assert len(edges) == 18


def test_open3d_reads_points_labels_and_cubes(tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    leaves = leaf_table()
    (tmp_path / "points.ply").write_bytes(ply.mesh_file(*ply.points(leaves, COLORS), ["made by a test"]))
    (tmp_path / "voxels.ply").write_bytes(ply.mesh_file(*ply.voxels(leaves, COLORS)))
    cloud = o3d.t.io.read_point_cloud(str(tmp_path / "points.ply"))
    np.testing.assert_allclose(cloud.point.positions.numpy(), leaves.centers, rtol=1e-6)
    assert cloud.point.colors.numpy().tolist() == COLORS.tolist()
    assert cloud.point.label.numpy().reshape(-1).tolist() == [1, 2, 1, 0]
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "voxels.ply"))
    assert (len(mesh.vertices), len(mesh.triangles)) == (8 * 4, 12 * 4)
    assert mesh.has_vertex_colors()


def test_an_empty_map_is_an_empty_file(tmp_path: Path) -> None:
    empty = LeafTable(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2), dtype=np.float32))
    for encode in (ply.points, ply.voxels):
        (tmp_path / "a.ply").write_bytes(ply.mesh_file(*encode(empty, np.zeros((0, 3), dtype=np.uint8))))
        assert len(PlyData.read(tmp_path / "a.ply")["vertex"].data) == 0
