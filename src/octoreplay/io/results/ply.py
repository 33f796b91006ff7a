"""Writers of binary PLY files: meshes, and maps with leaf centres as points or leaves as cubes.

CloudCompare, MeshLab and Open3D read them. Open3D keeps the ``label`` property only when reading with ``open3d.t.io``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from octoreplay.errors import OutputError
from octoreplay.log_odds import best_labels, label_probabilities
from octoreplay.records import LeafTable, UInt8Array

VERTEX_DTYPE = np.dtype(
    [
        ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("label", "u1"),
        ("probability", "<f4"), ("size", "<f4"),
    ]
)  # fmt: skip
"""Vertex properties: ``label`` is the most probable class_id (0: free), ``size`` the edge of the leaf [m]."""

_CORNERS = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
"""Corners of the unit cube, (8, 3); x varies fastest."""
_FACES = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
"""Faces of the cube as indices of corners, counter-clockwise as seen from outside."""


def write_points(path: Path, leaves: LeafTable, colors: UInt8Array, comments: Sequence[str] = ()) -> None:
    """Write the centres of the leaves as points. ``colors`` is (L, 3) uint8. Raises OutputError."""
    write_mesh(path, _vertices(leaves, colors, leaves.centers), None, comments)


def write_voxels(path: Path, leaves: LeafTable, colors: UInt8Array, comments: Sequence[str] = ()) -> None:
    """Write each leaf as a cube of its size: 8 vertices and 12 triangles. ``colors`` is (L, 3) uint8.

    Cubes share no vertices, so each keeps its colour. Not all viewers support quads, hence triangles.
    Raises OutputError.
    """
    corners = leaves.centers[:, None, :] + _CORNERS[None] * leaves.sizes[:, None, None]
    vertices = np.repeat(_vertices(leaves, colors, leaves.centers), 8)
    for axis, name in enumerate("xyz"):
        vertices[name] = corners[..., axis].reshape(-1)
    triangles = np.concatenate([_FACES[:, [0, 1, 2]], _FACES[:, [0, 2, 3]]])
    indices = 8 * np.arange(len(leaves), dtype=np.int32)[:, None, None] + triangles.astype(np.int32)[None]
    faces = np.empty(12 * len(leaves), dtype=[("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = indices.reshape(-1, 3)
    write_mesh(path, vertices, faces, comments)


def _vertices(leaves: LeafTable, colors: UInt8Array, positions: Any) -> Any:
    """Return one vertex for each leaf, (L,) of ``VERTEX_DTYPE``."""
    vertices = np.zeros(len(leaves), dtype=VERTEX_DTYPE)
    for axis, name in enumerate("xyz"):
        vertices[name] = positions[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colors[:, channel]
    vertices["label"] = best_labels(leaves.log_odds)
    vertices["probability"] = label_probabilities(leaves.log_odds)
    vertices["size"] = leaves.sizes
    return vertices


def write_mesh(path: Path, vertices: Any, faces: Any, comments: Sequence[str] = ()) -> None:
    """Write a mesh, or points where ``faces`` is None. Raises OutputError.

    ``vertices`` (V,) and ``faces`` (F,) are packed structured arrays of little-endian numbers. The first field of
    ``faces`` is ``vertex_indices`` (3,) int32. No incomplete file appears under ``path``.
    """
    from plyfile import PlyData, PlyElement

    elements = [PlyElement.describe(vertices, "vertex")]
    content = [vertices.tobytes()]
    if faces is not None:
        elements.append(PlyElement.describe(faces, "face"))
        # plyfile writes lists row by row, 100 times slower than rows of one length at once.
        rows = np.empty(len(faces), dtype=[("length", "u1"), *faces.dtype.descr])
        rows["length"] = 3
        for name in faces.dtype.names:
            rows[name] = faces[name]
        content.append(rows.tobytes())
    header = PlyData(elements, byte_order="<", comments=list(comments)).header
    partial = path.with_name(f"{path.name}.partial")
    try:
        partial.write_bytes(b"".join([header.encode("ascii"), b"\n", *content]))
        partial.replace(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
    finally:
        partial.unlink(missing_ok=True)
