"""True surface of a scene as labelled cells, from a simulated world or a labelled PLY file."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.errors import InputError
from octoreplay.io.containers.decompression import content_limit
from octoreplay.io.datasets.ply_files import read_labelled_ply
from octoreplay.mapping.octree import KEY_OFFSET, keys_to_codes
from octoreplay.mapping.surface import CellVotes, num_cuts, points_on_triangles
from octoreplay.records import NO_CLASS, BoolArray, ClassTable, Float64Array, Int64Array, UInt8Array

WORLD_FILE = "world.npz"
"""Name of the simulator's file of labelled surface cells."""

MAX_POINTS = 1_000_000_000
"""Largest number of points that the faces of a mesh are sampled with."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Cells that hold surface; every other cell is free.

    Attributes
    ----------
    path : Path
        File or folder that the truth was read from.
    codes : (M,) int64
        Morton codes, ascending.
    class_ids : (M,) uint8
        Classes; NO_CLASS where the result does not have the class. These cells are not counted.
    """

    path: Path
    codes: Int64Array
    class_ids: UInt8Array

    @property
    def is_class(self) -> BoolArray:
        """True for the cells of one of the result's classes, (M,) bool."""
        is_class: BoolArray = self.class_ids != NO_CLASS
        return is_class


def load_truth(path: Path, class_table: ClassTable, resolution: float) -> Truth:
    """Read the truth for maps of these classes and this resolution [m].

    ``path`` is the simulator's world.npz, a folder that holds one, or a PLY file in the team's frame with a label for
    each face or each vertex. The resolution must be a whole multiple of that of a world.npz. A cell gets the class with
    the most samples in it; ties go to the lower class_id.

    Raises InputError for a file that is missing, damaged or of another kind, of another resolution, without surface or
    without a class of the result, and for surface outside the octree or too large to sample.
    """
    file = path / WORLD_FILE if path.is_dir() else path
    if not file.exists():
        raise InputError(f"{file}: not found; give a world.npz, the folder of a simulated team, or a labelled PLY file")
    suffix = file.suffix.lower()
    if suffix not in (".npz", ".ply"):
        raise InputError(f"{file}: a truth file ends in .npz or .ply, not '{suffix}'")
    votes = CellVotes()
    read = _vote_with_world if suffix == ".npz" else _vote_with_ply
    for keys, class_ids in read(file, class_table, resolution):
        if len(keys) and (keys.min() < -KEY_OFFSET or keys.max() >= KEY_OFFSET):
            raise InputError(
                f"{file}: reaches beyond {KEY_OFFSET * resolution / 1000:.3g} km, the limit of maps with cells of"
                f" {resolution:g} m; give it in metres, in the team's frame"
            )
        votes.add(keys_to_codes(keys), class_ids)
    codes, class_ids = votes.winners()
    if not codes.size:
        raise InputError(f"{file}: holds no surface; give a file with labelled cells, points or faces")
    if (class_ids == NO_CLASS).all():
        names = ", ".join(class_table.names)
        raise InputError(f"{file}: has no class in common with the result, whose classes are {names}")
    return Truth(path, codes, class_ids)


def _vote_with_world(path: Path, class_table: ClassTable, resolution: float) -> Iterable[tuple[Int64Array, UInt8Array]]:
    """Yield keys (P, 3) and class_ids (P,) of a world.npz, in cells of ``resolution``."""
    arrays = _arrays(path)
    keys, numbers = arrays["keys"], arrays["class_ids"]
    if keys.ndim != 2 or keys.shape[1] != 3 or numbers.shape != keys.shape[:1]:
        raise InputError(
            f"{path}: 'keys' and 'class_ids' must have the shapes (M, 3) and (M,), not {keys.shape} and"
            f" {numbers.shape}; {_REMEDY}"
        )
    if keys.dtype.kind not in "iu" or numbers.dtype.kind not in "iu":
        raise InputError(f"{path}: 'keys' and 'class_ids' must be integers; {_REMEDY}")
    factor = _factor(path, arrays["resolution"], resolution)
    names = arrays.get("class_names")
    if names is not None and (names.ndim != 1 or names.dtype.kind != "U"):
        raise InputError(f"{path}: 'class_names' must be an array of strings, one for each class_id from 1; {_REMEDY}")
    table = _by_raw_label(class_table) if names is None else _by_name(class_table, names.tolist())
    class_ids = _class_ids(numbers, table)
    step = 1_000_000
    for start in range(0, len(keys), step):
        yield keys[start : start + step].astype(np.int64) // factor, class_ids[start : start + step]


def _arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Arrays of a world.npz by name."""
    try:
        with path.open("rb") as stream:
            file = np.load(stream, allow_pickle=False)
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise InputError(f"{path}: is a single array; {_REMEDY}")
            size = sum(entry.file_size for entry in zipfile.ZipFile(path).infolist())
            if size > content_limit(path.stat().st_size):
                raise InputError(f"{path}: its arrays take {size:,} bytes, which a file of its size cannot; {_REMEDY}")
            arrays = {name: file[name] for name in _ARRAYS if name in file}
    except _DAMAGE as error:
        raise InputError(f"{path}: cannot be read, or is truncated or damaged: {error}; {_REMEDY}") from error
    missing = [name for name in _ARRAYS[:3] if name not in arrays]
    if missing:
        raise InputError(f"{path}: has no array '{missing[0]}'; {_REMEDY}")
    return arrays


_REMEDY = "give the world.npz of 'octoreplay simulate'"
_DAMAGE = (OSError, ValueError, EOFError, LookupError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error,
           struct.error)  # fmt: skip
"""Exceptions raised for a damaged .npz."""
_ARRAYS = ("keys", "class_ids", "resolution", "class_names")
"""Arrays of a world.npz; the last one may be missing."""


def _factor(path: Path, stored: npt.NDArray[Any], resolution: float) -> int:
    """Edge of a map's cell in cells of the truth."""
    if stored.size != 1 or stored.dtype.kind not in "iuf" or not 0 < float(stored.ravel()[0]) < np.inf:
        raise InputError(f"{path}: 'resolution' must be the edge of a cell in metres; {_REMEDY}")
    edge = float(stored.ravel()[0])
    factor = round(resolution / edge)
    if factor < 1 or abs(factor * edge - resolution) > 1e-6 * resolution:
        raise InputError(
            f"{path}: has cells of {edge:g} m, and the result's {resolution:g} m are no multiple of that; simulate"
            f" with --resolution {resolution:g}, or give the mesh (world.ply)"
        )
    return factor


def _vote_with_ply(path: Path, class_table: ClassTable, resolution: float) -> Iterable[tuple[Int64Array, UInt8Array]]:
    """Yield keys (P, 3) and class_ids (P,) of a PLY's points, or of points sampled on its faces."""
    corners, labels = read_labelled_ply(path)
    if not np.isfinite(corners).all():
        raise InputError(f"{path}: has vertices that are not finite; remove them")
    if not len(corners):
        return
    class_ids = _class_ids(labels, _by_raw_label(class_table))
    if corners.shape[1] == 1:
        yield _keys(corners[:, 0], resolution), class_ids
        return
    # The corners come first, so that a mesh outside the octree is refused before it is sampled.
    yield _keys(corners.reshape(-1, 3), resolution)[:0], class_ids[:0]
    if np.abs(corners).max() >= KEY_OFFSET * resolution:
        yield np.full((1, 3), KEY_OFFSET, np.int64), class_ids[:1]
    num_points = float((num_cuts(corners, resolution / 3).astype(np.float64) ** 2).sum())
    if num_points > MAX_POINTS:
        raise InputError(
            f"{path}: sampling its faces for cells of {resolution:g} m would take {num_points:.2g} points, more than"
            f" {MAX_POINTS:.2g}; crop it to the part that the robots saw"
        )
    for points, faces in points_on_triangles(corners, resolution / 3):
        yield _keys(points, resolution), class_ids[faces]


def _keys(points: Float64Array, resolution: float) -> Int64Array:
    """Keys (P, 3) of the cells that hold points (P, 3)."""
    keys: Int64Array = np.clip(np.floor(points / resolution), -KEY_OFFSET - 1, KEY_OFFSET).astype(np.int64)
    return keys


def _class_ids(numbers: npt.NDArray[Any], table: Mapping[int, int]) -> UInt8Array:
    """Class_id of each number (P,), NO_CLASS where the table has none."""
    found, place = np.unique(numbers, return_inverse=True)
    class_ids: UInt8Array = np.array([table.get(number, NO_CLASS) for number in found.tolist()], np.uint8)[place]
    return class_ids


def _by_raw_label(class_table: ClassTable) -> dict[int, int]:
    """Class_id of each raw label."""
    return {raw: item.class_id for item in class_table.classes for raw in item.raw_labels}


def _by_name(class_table: ClassTable, names: list[str]) -> dict[int, int]:
    """Class_id of each of the truth's classes, numbered from 1.

    A name that the result does not have may belong to a class that was merged into another one. Where the numbers of
    all common names are raw labels of their classes, such a class is found by its number.
    """
    ids, by_raw_label = {item.name: item.class_id for item in class_table.classes}, _by_raw_label(class_table)
    numbers = dict(enumerate(names, start=1))
    table = {number: ids[name] for number, name in numbers.items() if name in ids}
    if table and all(by_raw_label.get(number) == class_id for number, class_id in table.items()):
        table |= {number: by_raw_label[number] for number in numbers if number in by_raw_label}
    return table
