"""Encoders of binary PLY files: meshes, and maps with leaf centres as points or leaves as cubes.

CloudCompare, MeshLab and Open3D read them. Open3D keeps the ``label`` property only when reading with ``open3d.t.io``.
"""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Self

import numpy as np

from octoreplay.io.output_file import writing
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


def points(leaves: LeafTable, colors: UInt8Array) -> tuple[Any, None]:
    """Return the centres of the leaves as vertices of ``mesh_file``, without faces. ``colors`` is (L, 3) uint8."""
    return _vertices(leaves, colors, leaves.centers), None


def voxels(leaves: LeafTable, colors: UInt8Array) -> tuple[Any, Any]:
    """Return vertices and faces of ``mesh_file``: each leaf as a cube of 8 vertices and 12 triangles.

    ``colors`` is (L, 3) uint8. Cubes share no vertices, so each keeps its colour. Not all viewers support quads, hence
    triangles.
    """
    corners = leaves.centers[:, None, :] + _CORNERS[None] * leaves.sizes[:, None, None]
    vertices = np.repeat(_vertices(leaves, colors, leaves.centers), 8)
    for axis, name in enumerate("xyz"):
        vertices[name] = corners[..., axis].reshape(-1)
    triangles = np.concatenate([_FACES[:, [0, 1, 2]], _FACES[:, [0, 2, 3]]])
    indices = 8 * np.arange(len(leaves), dtype=np.int32)[:, None, None] + triangles.astype(np.int32)[None]
    faces = np.empty(12 * len(leaves), dtype=[("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = indices.reshape(-1, 3)
    return vertices, faces


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
    parts = MeshParts()
    with parts:
        parts.add("", vertices, faces)
        return b"".join(parts.content("", comments))


class MeshParts:
    """PLY files whose meshes come in parts, which are kept in a temporary file in a folder; a context manager.

    Raises OutputError where the temporary file cannot be written.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._meshes: dict[object, _Mesh] = {}

    def __enter__(self) -> Self:
        with writing(self._folder or Path("PLY")):
            self._file: IO[bytes] = io.BytesIO() if self._folder is None else tempfile.TemporaryFile(dir=self._folder)
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def add(self, name: object, vertices: Any, faces: Any) -> None:
        """Add a part to the mesh of a name; arrays as in ``mesh_file``, indices of vertices as in the part."""
        mesh = self._meshes.setdefault(name, _Mesh(vertices.dtype, None if faces is None else faces.dtype))
        if faces is not None:
            rows = np.empty(len(faces), dtype=[("length", "u1"), *faces.dtype.descr])
            rows["length"] = 3
            for column in faces.dtype.names:
                rows[column] = faces[column]
            rows["vertex_indices"] += mesh.num_vertices
            mesh.faces.append(self._kept(rows))
            mesh.num_faces += len(faces)
        mesh.vertices.append(self._kept(vertices))
        mesh.num_vertices += len(vertices)

    def _kept(self, rows: Any) -> tuple[int, int]:
        """Write rows; return their place and length in the file."""
        with writing(self._folder or Path("PLY")):
            start = self._file.tell()
            self._file.write(rows.tobytes())
            return start, self._file.tell() - start

    def content(self, name: object, comments: Sequence[str] = ()) -> Iterator[bytes]:
        """Yield the bytes of the file of a name."""
        mesh = self._meshes[name]
        header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
        header += [f"element vertex {mesh.num_vertices}", *_properties(mesh.vertex_type)]
        if mesh.face_type is not None:
            header += [f"element face {mesh.num_faces}", *_properties(mesh.face_type)]
        yield "\n".join([*header, "end_header\n"]).encode("ascii")
        for start, length in (*mesh.vertices, *mesh.faces):
            self._file.seek(start)
            yield self._file.read(length)


@dataclass
class _Mesh:
    """One mesh in a temporary file: types of its rows, their numbers, and places and lengths of its parts."""

    vertex_type: np.dtype[Any]
    face_type: np.dtype[Any] | None
    num_vertices: int = 0
    num_faces: int = 0
    vertices: list[tuple[int, int]] = field(default_factory=list)
    faces: list[tuple[int, int]] = field(default_factory=list)


def _properties(dtype: np.dtype[Any]) -> Iterator[str]:
    """Lines of the header on the properties of an element."""
    for name in dtype.names or ():
        kind = _PLY_TYPES[dtype[name].base.str.lstrip("<|")]
        yield f"property {f'list uchar {kind}' if dtype[name].shape else kind} {name}"


_PLY_TYPES = {"u1": "uchar", "i4": "int", "u4": "uint", "f4": "float", "f8": "double"}
