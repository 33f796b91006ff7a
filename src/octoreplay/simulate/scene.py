"""Rays cast into the mesh of a world.

Only this module imports Open3D, and only when a scene is made.
"""

from __future__ import annotations

from types import ModuleType

import numpy as np

from octoreplay.errors import InputError
from octoreplay.records import BoolArray, Float32Array, Float64Array, UInt8Array
from octoreplay.simulate.world import World

NO_LABEL = 255
"""Raw label of a ray that hits nothing, and of a pixel without a measurement."""


class MeshScene:
    """Triangles of a world in a tree, so that a ray's time hardly depends on their number.

    Raises InputError if Open3D or one of its shared libraries is missing.
    """

    def __init__(self, world: World) -> None:
        open3d = _import_open3d()
        self._tensor = open3d.core.Tensor
        self._scene = open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(self._tensor(world.vertices), self._tensor(world.triangles.astype(np.uint32)))
        # The additional last entry is for rays that hit nothing; their primitive id is 2^32 - 1.
        self._labels = np.append(world.triangle_classes, np.uint8(NO_LABEL))

    def cast(self, origin: Float64Array, directions: Float64Array) -> tuple[Float32Array, UInt8Array, Float32Array]:
        """Cast rays from one point (3,) [m] in directions (H, W, 3).

        Returns the distances (H, W) in lengths of the directions, infinite where nothing is hit, the labels (H, W) and
        the unit normals (H, W, 3) of the surfaces that are hit.
        """
        rays = np.empty((*directions.shape[:2], 6), dtype=np.float32)
        rays[..., :3] = origin
        rays[..., 3:] = directions
        hits = self._scene.cast_rays(self._tensor(rays))
        ids = np.minimum(hits["primitive_ids"].numpy(), np.uint32(len(self._labels) - 1))
        return hits["t_hit"].numpy(), self._labels[ids], hits["primitive_normals"].numpy()

    def is_occluded(self, points: Float64Array, direction: Float64Array) -> BoolArray:
        """Return True (H, W) where a surface lies in a direction (3,) from points (H, W, 3)."""
        rays = np.empty((*points.shape[:2], 6), dtype=np.float32)
        rays[..., :3] = points
        rays[..., 3:] = direction
        hidden: BoolArray = self._scene.test_occlusions(self._tensor(rays)).numpy()
        return hidden


def _import_open3d() -> ModuleType:
    """Import Open3D. Raises InputError if it cannot be loaded."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise InputError(
            f"simulation needs Open3D, which cannot be loaded ({error}); on a headless Debian or Ubuntu machine install"
            " its shared libraries with: apt-get install libusb-1.0-0 libegl1 libgl1 libx11-6"
        ) from error
    module: ModuleType = open3d
    return module
