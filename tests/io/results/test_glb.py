"""GLB files, read back by Open3D."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from octoreplay.io.results import glb
from octoreplay.mapping.merged_faces import merged_faces
from support.result_factory import leaf_table

COLORS = np.array([[250, 1, 2], [3, 200, 5], [10, 20, 30], [255, 255, 255]], np.uint8)


def test_open3d_reads_positions_colours_and_area(tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    leaves = leaf_table()
    faces = merged_faces(leaves, COLORS, 0.2)
    path = tmp_path / "map.glb"
    path.write_bytes(glb.mesh_file(*faces))
    mesh = o3d.io.read_triangle_mesh(str(path))
    half = leaves.sizes[:, None] / 2
    # The y axis of glTF points up.
    vertices = np.asarray(mesh.vertices)
    back = np.column_stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]])
    np.testing.assert_allclose(back.min(axis=0), (leaves.centers - half).min(axis=0), atol=1e-6)
    np.testing.assert_allclose(back.max(axis=0), (leaves.centers + half).max(axis=0), atol=1e-6)
    assert mesh.get_surface_area() == pytest.approx((6 * leaves.sizes**2).sum(), rel=1e-5)
    # The cubes do not touch: each is a closed surface with outward triangles (divergence theorem).
    triangles = vertices[np.asarray(mesh.triangles)]
    volume = np.einsum("ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])).sum() / 6
    assert volume == pytest.approx((leaves.sizes**3).sum(), rel=1e-4)
    linear = np.asarray(mesh.vertex_colors)
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    found = {tuple(row) for row in np.rint(shown * 255).astype(int).tolist()}
    assert found == {tuple(row) for row in COLORS.tolist()}


def test_chunks_are_those_of_the_specification() -> None:
    data = glb.mesh_file(*merged_faces(leaf_table(), COLORS, 0.2), ["frame: team"])
    magic, version, length, text_length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    assert text_length % 4 == 0
    content = json.loads(data[20 : 20 + text_length])
    size, kind = struct.unpack_from("<I4s", data, 20 + text_length)
    assert (kind, size) == (b"BIN\0", len(data) - 28 - text_length)
    assert content["buffers"] == [{"byteLength": size}]
    assert content["asset"]["extras"] == {"comments": ["frame: team"]}
