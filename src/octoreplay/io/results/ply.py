"""Encoders of binary PLY files: meshes, and maps with leaf centres as points or leaves as cubes.

CloudCompare, MeshLab and Open3D read them. Open3D keeps the ``label`` property only when reading with ``open3d.t.io``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

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


def points_file(leaves: LeafTable, colors: UInt8Array, comments: Sequence[str] = ()) -> bytes:
    """Return a PLY file of the centres of the leaves as points. ``colors`` is (L, 3) uint8."""
    return mesh_file(_vertices(leaves, colors, leaves.centers), None, comments)


def voxels_file(leaves: LeafTable, colors: UInt8Array, comments: Sequence[str] = ()) -> bytes:
    """Return a PLY file of each leaf as a cube of its size: 8 vertices and 12 triangles. ``colors`` is (L, 3) uint8.

    Cubes share no vertices, so each keeps its colour. Not all viewers support quads, hence triangles.
    """
    corners = leaves.centers[:, None, :] + _CORNERS[None] * leaves.sizes[:, None, None]
    vertices = np.repeat(_vertices(leaves, colors, leaves.centers), 8)
    for axis, name in enumerate("xyz"):
        vertices[name] = corners[..., axis].reshape(-1)
    triangles = np.concatenate([_FACES[:, [0, 1, 2]], _FACES[:, [0, 2, 3]]])
    indices = 8 * np.arange(len(leaves), dtype=np.int32)[:, None, None] + triangles.astype(np.int32)[None]
    faces = np.empty(12 * len(leaves), dtype=[("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = indices.reshape(-1, 3)
    return mesh_file(vertices, faces, comments)


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


def mesh_file(vertices: Any, faces: Any, comments: Sequence[str] = ()) -> bytes:
    """Return a PLY file of a mesh, or of points where ``faces`` is None.

    ``vertices`` (V,) and ``faces`` (F,) are packed structured arrays of little-endian numbers. The first field of
    ``faces`` is ``vertex_indices`` (3,) int32.
    """
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header += [f"element vertex {len(vertices)}", *_properties(vertices.dtype)]
    content = [vertices.tobytes()]
    if faces is not None:
        header += [f"element face {len(faces)}", *_properties(faces.dtype)]
        rows = np.empty(len(faces), dtype=[("length", "u1"), *faces.dtype.descr])
        rows["length"] = 3
        for name in faces.dtype.names:
            rows[name] = faces[name]
        content.append(rows.tobytes())
    return b"".join(["\n".join([*header, "end_header\n"]).encode("ascii"), *content])


def _properties(dtype: np.dtype[Any]) -> Iterator[str]:
    """Lines of the header on the properties of an element."""
    for name in dtype.names or ():
        kind = _PLY_TYPES[dtype[name].base.str.lstrip("<|")]
        yield f"property {f'list uchar {kind}' if dtype[name].shape else kind} {name}"


_PLY_TYPES = {"u1": "uchar", "i4": "int", "u4": "uint", "f4": "float", "f8": "double"}
