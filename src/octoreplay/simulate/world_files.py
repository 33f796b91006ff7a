"""Files of a simulated world: ground truth cells and the labelled mesh."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from octoreplay.io.output_file import write_whole
from octoreplay.io.results import ply
from octoreplay.mapping.surface import CellVotes
from octoreplay.records import ClassTable, Int32Array, UInt8Array
from octoreplay.simulate.world import World

_KEY_BITS = 18
_KEY_OFFSET = 1 << 17


def labelled_cells(world: World, resolution: float) -> tuple[Int32Array, UInt8Array]:
    """Return the ground truth: keys (M, 3) int32 of the finest cells that contain surface, and class_ids (M,) uint8.

    key = floor(coordinate / resolution). Surfaces are sampled every third of a cell's edge. The class with the most
    points in a cell wins; ties go to the lower class_id. Surfaces under the ground are left out. Keys are in ascending
    order.
    """
    votes = CellVotes()
    for points, class_ids in world.surface_points(resolution / 3):
        is_visible = world.is_ground(class_ids)
        above = np.flatnonzero(~is_visible)
        is_visible[above] = points[above, 2] >= world.terrain.height(points[above, :2]) - 0.05
        keys = np.floor(points[is_visible] / resolution).astype(np.int64) + _KEY_OFFSET
        votes.add(((keys[:, 0] << _KEY_BITS) + keys[:, 1] << _KEY_BITS) + keys[:, 2], class_ids[is_visible])
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
