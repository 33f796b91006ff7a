"""Window of Open3D with a map."""

from __future__ import annotations

import os
import sys

import numpy as np

from octoreplay.errors import InputError, OutputError
from octoreplay.log_odds import best_labels
from octoreplay.report.map_view import cube_faces
from octoreplay.result import Result


def show_window(result: Result, max_depth: int | None = None) -> None:
    """Show the occupied leaves of the first robot's last map until the window is closed.

    ``max_depth`` is as in ``StoredMap.coarsened``. Raises InputError for a map without occupied leaves, and OutputError
    without a screen or without Open3D.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise OutputError("this machine has no screen; use 'octoreplay view' without --window, or 'octoreplay report'")
    stored = result.map(result.robots[0]).coarsened(max_depth)
    leaves = stored.leaves()
    labels = best_labels(leaves.log_odds)
    occupied = labels > 0
    if not occupied.any():
        raise InputError(f"{result.path}: the map of {result.robots[0]} holds no occupied leaf")
    colors = result.class_table.colors[labels[occupied].astype(np.intp) - 1]
    triangles = []
    for edge in np.unique(leaves.sizes[occupied]):
        same = leaves.sizes[occupied] == edge
        triangles.append(
            cube_faces(leaves.centers[occupied][same], float(edge), colors[same], np.ones(int(same.sum())))
        )
    import open3d

    corners = np.concatenate(
        [np.stack([f.corners, f.corners + f.edges_a, f.corners + f.edges_a + f.edges_b, f.corners + f.edges_b], axis=1)
         for f in triangles]
    )  # fmt: skip
    shades = np.concatenate([f.colors for f in triangles]) / 255.0
    first = 4 * np.arange(len(corners))[:, None]
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(corners.reshape(-1, 3)),
        open3d.utility.Vector3iVector((first[:, None] + np.array([[0, 1, 2], [0, 2, 3]])[None]).reshape(-1, 3)),
    )
    mesh.vertex_colors = open3d.utility.Vector3dVector(np.repeat(shades, 4, axis=0))
    mesh.compute_triangle_normals()
    window = open3d.visualization.Visualizer()
    if not window.create_window(window_name=f"{result.path.name}: {stored.robot_id}, {stored.title()}"):
        raise OutputError("Open3D cannot open a window; use 'octoreplay view' without --window")
    window.add_geometry(mesh)
    window.run()
    window.destroy_window()
