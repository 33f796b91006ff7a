"""Files of a simulated world: ground truth cells and the labelled mesh."""

from __future__ import annotations

import io
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from octoreplay.io.output_file import write_whole
from octoreplay.io.results import ply
from octoreplay.mapping.surface import CellVotes
from octoreplay.records import ClassTable, Int32Array, Int64Array, UInt8Array
from octoreplay.simulate.world import World

_SLAB = 64.0
"""Width of the slabs in which cells are labelled [m]."""

_MAX_THREADS = 4
"""Largest number of slabs in memory at once."""

_KEY_BITS = 18
_KEY_OFFSET = 1 << 17


def labelled_cells(world: World, resolution: float) -> tuple[Int32Array, UInt8Array]:
    """Return the ground truth: keys (M, 3) int32 of the finest cells that contain surface, and class_ids (M,) uint8.

    key = floor(coordinate / resolution). Surfaces are sampled every third of a cell's edge. The class with the most
    points in a cell wins; ties go to the lower class_id. Surfaces under the ground are left out. Keys are in ascending
    order. The cells are found slab by slab along x, so that memory holds the points' cells of a few slabs.
    """
    along_x = world.vertices[:, 0][world.triangles].astype(np.float64)
    # Points may leave their triangle by a rounding error.
    first = np.floor(along_x.min(axis=1) / resolution).astype(np.int64) - 1
    last = np.floor(along_x.max(axis=1) / resolution).astype(np.int64) + 1
    step = max(1, round(_SLAB / resolution))

    def found(start: int) -> tuple[Int32Array, UInt8Array]:
        near = np.flatnonzero((last >= start) & (first < start + step))
        return _slab_cells(world, resolution, (start, start + step), near)

    with ThreadPoolExecutor(min(_MAX_THREADS, os.cpu_count() or 1)) as threads:
        slabs = list(threads.map(found, range(int(first.min()), int(last.max()) + 1, step)))
    return np.concatenate([keys for keys, _ in slabs]), np.concatenate([class_ids for _, class_ids in slabs])


def _slab_cells(
    world: World, resolution: float, slab: tuple[int, int], triangles: Int64Array
) -> tuple[Int32Array, UInt8Array]:
    """Labelled cells whose first key is in [start, stop), from the triangles that may reach them."""
    votes = CellVotes()
    start, stop = slab
    for points, class_ids in world.surface_points(resolution / 3, triangles):
        keys = np.floor(points / resolution).astype(np.int64)
        is_counted = (keys[:, 0] >= start) & (keys[:, 0] < stop)
        low = np.flatnonzero(is_counted & ~world.is_ground(class_ids) & (points[:, 2] < world.terrain.highest))
        is_counted[low] = points[low, 2] >= world.terrain.height(points[low, :2]) - 0.05
        keys = keys[is_counted] + _KEY_OFFSET
        cells = ((keys[:, 0] << _KEY_BITS) + keys[:, 1] << _KEY_BITS) + keys[:, 2]
        pairs, counts = np.unique(cells << 8 | class_ids[is_counted], return_counts=True)
        votes.add(pairs >> 8, (pairs & 0xFF).astype(np.uint8), counts)
    cells, winners = votes.winners()
    mask = (1 << _KEY_BITS) - 1
    keys = np.stack([cells >> 2 * _KEY_BITS, (cells >> _KEY_BITS) & mask, cells & mask], axis=1) - _KEY_OFFSET
    return keys.astype(np.int32), winners


def write_ground_truth(path: Path, world: World, resolution: float, class_table: ClassTable) -> int:
    """Write the labelled cells as a NumPy archive (docs/simulation.md) and return their number.

    Raises OutputError if the file cannot be written.
    """
    keys, class_ids = labelled_cells(world, resolution)
    archive = io.BytesIO()
    np.savez_compressed(
        archive,
        keys=keys,
        class_ids=class_ids,
        resolution=np.float64(resolution),
        class_names=np.array(class_table.names),
        class_colors=class_table.colors,
    )
    write_whole(path, archive.getvalue())
    return len(class_ids)


def write_mesh(path: Path, world: World, class_table: ClassTable) -> None:
    """Write the mesh as binary PLY whose faces have red, green, blue and label.

    Raises OutputError if the file cannot be written.
    """
    vertices = np.empty(len(world.vertices), dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    for axis, name in enumerate("xyz"):
        vertices[name] = world.vertices[:, axis]
    faces = np.empty(
        len(world.triangles),
        dtype=[("vertex_indices", "<i4", (3,)), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("label", "u1")],
    )
    faces["vertex_indices"] = world.triangles
    faces["label"] = world.triangle_classes
    colors = class_table.colors[world.triangle_classes - 1]
    for channel, name in enumerate(("red", "green", "blue")):
        faces[name] = colors[:, channel]
    names = ", ".join(f"{c.class_id} {c.name}" for c in class_table.classes)
    write_whole(path, ply.mesh_file(vertices, faces, [f"labels: {names}"]))
