"""PLY files: all elements, and labelled points or triangles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.errors import InputError
from octoreplay.io.datasets.ply_format import PlyError, read_elements
from octoreplay.io.sensors.clouds import LABEL_FIELDS
from octoreplay.io.sensors.labels import UNLABELLED
from octoreplay.records import Float64Array, Int64Array

_FACE_LISTS = ("vertex_indices", "vertex_index")
"""Names of the list of a face's vertices."""


def read_ply(path: Path, remedy: str) -> dict[str, npt.NDArray[Any]]:
    """Return the elements of a file by name, as ``read_elements`` does.

    Raises InputError where it cannot be read, is cut or damaged, or has no element 'vertex'; ``remedy`` ends the
    message.
    """
    try:
        elements = read_elements(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except PlyError as error:
        raise InputError(f"{path}: is cut or damaged: {error}; {remedy}") from error
    if "vertex" not in elements:
        raise InputError(f"{path}: has no element 'vertex'; {remedy}")
    return elements


def raw_labels(column: npt.NDArray[Any]) -> npt.NDArray[np.uint32]:
    """Return raw labels of a column of any type; negative, 2^32 - 1 and values that are not finite become 65535."""
    values = column.astype(np.float64)
    is_label = (values >= 0) & (values < 2**32 - 1)
    return np.where(is_label, values, UNLABELLED[1]).astype(np.uint32)


def read_labelled_ply(path: Path) -> tuple[Float64Array, npt.NDArray[np.uint32]]:
    """Return a mesh's triangles (T, 3, 3), or a cloud's points (T, 1, 3), in metres, and their raw labels (T,).

    Faces of more than three vertices become fans of triangles. A file is a mesh where its faces have labels. Raises
    InputError where neither faces nor vertices have labels, and as ``read_ply`` does.
    """
    ply = read_ply(path, "write it again")
    vertices = ply["vertex"]
    names = vertices.dtype.names or ()
    missing = [name for name in "xyz" if name not in names or vertices[name].dtype.kind not in "iuf"]
    if missing:
        raise InputError(
            f"{path}: its vertices have no numeric property '{missing[0]}'; write it with x, y and z in metres"
        )
    points = np.stack([vertices[name].astype(np.float64) for name in "xyz"], axis=1)
    labels = _label_column(ply, "face")
    if labels is not None:
        triangles, faces = _triangles(path, ply["face"], len(points))
        return points[triangles], raw_labels(labels)[faces]
    labels = _label_column(ply, "vertex")
    if labels is None:
        raise InputError(f"{path}: neither its faces nor its vertices have labels; write a numeric property 'label'")
    return points[:, None], raw_labels(labels)


def _label_column(ply: dict[str, npt.NDArray[Any]], element: str) -> npt.NDArray[Any] | None:
    """Labels of an element's rows; None without any."""
    if element not in ply:
        return None
    rows = ply[element]
    present = set(rows.dtype.names or ())
    names = (name for name in LABEL_FIELDS if name in present and rows[name].dtype.kind in "iuf")
    return next((rows[name] for name in names), None)


def _triangles(path: Path, faces: npt.NDArray[Any], num_vertices: int) -> tuple[Int64Array, Int64Array]:
    """Vertex indices (T, 3) of the faces' triangles, and the face index of each triangle (T,)."""
    name = next((name for name in _FACE_LISTS if name in (faces.dtype.names or ())), None)
    if name is None:
        raise InputError(f"{path}: its faces have no list 'vertex_indices'; write them with one")
    lists = faces[name]
    if lists.ndim == 2 and lists.shape[1] == 3:
        triangles, owners = lists.astype(np.int64), np.arange(len(lists))
    else:
        sizes = np.fromiter(map(len, lists), np.int64, len(lists))
        flat = np.concatenate([np.empty(0, np.int64), *lists]).astype(np.int64)
        num_triangles = np.maximum(sizes - 2, 0)
        owners = np.repeat(np.arange(len(lists)), num_triangles)
        first = (np.cumsum(sizes) - sizes)[owners]
        # Triangle n of a fan has the vertices 0, n + 1 and n + 2.
        nth = np.arange(len(owners)) - (np.cumsum(num_triangles) - num_triangles)[owners]
        triangles = flat[np.stack([first, first + nth + 1, first + nth + 2], axis=1)]
    if triangles.size and (triangles.min() < 0 or triangles.max() >= num_vertices):
        raise InputError(f"{path}: is damaged: a face has a vertex index out of range; write it again")
    return triangles, owners
