"""Files of exported maps: content of a file, and the encoders of the formats."""

from __future__ import annotations

import datetime
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from octoreplay.errors import OutputError
from octoreplay.io.results import glb, las, npz, octomap_trees, ply
from octoreplay.io.results.occupancy_grid import OCCUPIED, grid_files, grid_of
from octoreplay.mapping.merged_faces import first_cells, merged_faces
from octoreplay.mapping.octree import keys_to_codes
from octoreplay.records import BoolArray, ClassTable, Int64Array, LeafTable, UInt8Array

_log = logging.getLogger(__name__)

SPLITS = ("class", "robot")
"""Properties by which a map is divided into several files."""
_MOST_OCCUPIED = 0.5
"""Share of the known cells of a grid above which the ground is probably in it."""


class MapContent(NamedTuple):
    """Content of one file: leaves with colours (L, 3) and robots (L,), and what describes them.

    ``limits`` are those of the colours (``LeafColors``).
    """

    leaves: LeafTable
    colors: UInt8Array
    robots: Int64Array
    comments: Sequence[str]
    classes: ClassTable
    resolution: float
    day: datetime.date
    limits: tuple[float, float] | None

    @classmethod
    def joined(cls, parts: Sequence[MapContent]) -> MapContent:
        """Return the content of all parts, in Morton order where there are several."""
        if len(parts) == 1:
            return parts[0]
        first = parts[0]
        whole = first._replace(
            leaves=LeafTable.joined([part.leaves for part in parts]),
            colors=np.concatenate([part.colors for part in parts]),
            robots=np.concatenate([part.robots for part in parts]),
        )
        codes = keys_to_codes(first_cells(whole.leaves, first.resolution)[0])
        return whole.taken(np.argsort(codes, kind="stable"))

    def taken(self, chosen: BoolArray | Int64Array) -> MapContent:
        """Return the content with the leaves where ``chosen`` (L,) is True, or at positions ``chosen`` (n,)."""
        return self._replace(leaves=self.leaves.taken(chosen), colors=self.colors[chosen], robots=self.robots[chosen])


_Files = dict[Path, tuple[bytes, int]]
"""Contents of files, and the number of leaves or of known cells in each."""


def _encode_npz(path: Path, content: MapContent) -> _Files:
    """NumPy archive."""
    archive = npz.archive_file(content.leaves, content.colors, content.classes, content.resolution)
    return {path: (archive, len(content.leaves))}


def _encode_glb(path: Path, content: MapContent) -> _Files:
    """GLB file."""
    faces = merged_faces(content.leaves, content.colors, content.resolution)
    return {path: (glb.mesh_file(*faces, content.comments), len(content.leaves))}


def _encode_las(path: Path, content: MapContent) -> _Files:
    """LAS or LAZ file."""
    is_compressed = path.suffix.lower() == ".laz"
    points = las.points_file(
        content.leaves, content.colors, content.classes, content.robots, content.day, compressed=is_compressed
    )
    return {path: (points, len(content.leaves))}


def _encode_tree(path: Path, content: MapContent) -> _Files:
    """OctoMap file."""
    is_binary = path.suffix.lower() == ".bt"
    tree = octomap_trees.tree_file(content.leaves, content.colors, content.resolution, binary=is_binary)
    return {path: (tree, len(content.leaves))}


def _encode_grid(path: Path, content: MapContent) -> _Files:
    """Occupancy grid and its image."""
    grid = grid_of(content.leaves, content.resolution)
    return {name: (data, grid.num_known) for name, data in grid_files(path, grid).items()}


def warn_of_ground(path: Path, content: MapContent) -> None:
    """Warn where the ground seems to be in an occupancy grid."""
    grid = grid_of(content.leaves, content.resolution)
    share = np.count_nonzero(grid.cells == OCCUPIED) / max(grid.num_known, 1)
    if share > _MOST_OCCUPIED:
        _log.warning(
            "warning: %s: %.0f %% of the known cells are occupied, as with the ground in the grid; leave it out with"
            " --heights LOW HIGH, such as --heights 0.2 1.5", path, 100 * share,
        )  # fmt: skip


class FileFormat(NamedTuple):
    """Format of a suffix: its encoder, whether it needs free leaves, and the properties that it can be split by.

    Without an encoder it is PLY, which is written part by part.
    """

    encode: Callable[[Path, MapContent], _Files] | None
    has_free: bool = False
    splits: tuple[str, ...] = SPLITS

    @property
    def is_grid(self) -> bool:
        """True for occupancy grids."""
        return self.encode is _encode_grid


FORMATS: Mapping[str, FileFormat] = {
    ".ply": FileFormat(None),
    ".npz": FileFormat(_encode_npz),
    ".glb": FileFormat(_encode_glb),
    ".laz": FileFormat(_encode_las),
    ".las": FileFormat(_encode_las),
    ".bt": FileFormat(_encode_tree, has_free=True, splits=("robot",)),
    ".ot": FileFormat(_encode_tree, has_free=True, splits=("robot",)),
    ".yaml": FileFormat(_encode_grid, has_free=True, splits=("robot",)),
}


class MapFiles:
    """Files of a format that are made of the contents given by ``add``; a context manager.

    ``what`` is the form of PLY files, 'points' or 'voxels'. The parts of PLY files are kept in a temporary file in
    ``folder``. Methods raise OutputError.
    """

    def __init__(self, kind: FileFormat, what: str, folder: Path) -> None:
        self._kind = kind
        self._mesh = ply.voxels if what == "voxels" else ply.points
        self._parts = ply.MeshParts(folder)
        self._encoded: _Files = {}
        self._comments: dict[Path, Sequence[str]] = {}
        self.counts: dict[Path, int] = {}

    def __enter__(self) -> Self:
        self._parts.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._parts.__exit__(*error)

    def add(self, path: Path, content: MapContent) -> None:
        """Add the content of a file, of PLY files a part of it. OutputError for a map that the format cannot hold."""
        if self._kind.encode is None:
            self._parts.add(path, *self._mesh(content.leaves, content.colors))
            self._comments[path] = content.comments
            self.counts[path] = self.counts.get(path, 0) + len(content.leaves)
            return
        try:
            files = self._kind.encode(path, content)
        except ValueError as error:
            raise OutputError(f"{path}: {error}; export a PLY or NPZ file") from error
        self._encoded |= files
        self.counts |= {name: count for name, (_, count) in files.items()}

    def contents(self) -> dict[Path, Iterable[bytes]]:
        """Return the contents of all files."""
        if self._kind.encode is None:
            return {path: self._parts.content(path, comments) for path, comments in self._comments.items()}
        return {path: [data] for path, (data, _) in self._encoded.items()}
