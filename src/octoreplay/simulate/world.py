"""Simulated world: terrain, triangle mesh and classes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from octoreplay.mapping.surface import points_on_triangles
from octoreplay.records import BoolArray, ClassTable, Color, Float64Array, Int32Array, SemanticClass, UInt8Array

GRASS, DIRT_ROAD, BUILDING, ROOF, TRUNK, FOLIAGE, FENCE, CAR = range(1, 9)

_CLASSES = (
    ("grass", (124, 179, 66)),
    ("dirt_road", (161, 122, 82)),
    ("building", (224, 209, 178)),
    ("roof", (183, 58, 46)),
    ("trunk", (96, 62, 35)),
    ("foliage", (27, 108, 48)),
    ("fence", (240, 196, 60)),
    ("car", (41, 98, 201)),
)
"""Names and colours of the classes 1 to 8."""

MAX_KINDS = 31
"""Maximum number of kinds of each class; class_ids and raw labels must be below 255."""


def village_classes(kinds: int = 1) -> ClassTable:
    """Return the class table of the simulated world.

    With several ``kinds`` the classes are grass_1, grass_2 and so on, with darker colours for later kinds. The raw
    label of a class is its class_id; 255 marks pixels without a measurement.
    """
    rows = [
        (name if kinds == 1 else f"{name}_{kind + 1}", tuple(round(c * (1.0 - 0.5 * kind / kinds)) for c in color))
        for name, color in _CLASSES
        for kind in range(kinds)
    ]
    return ClassTable(
        tuple(SemanticClass(i, name, cast("Color", color), (i,)) for i, (name, color) in enumerate(rows, 1)),
        ignored_raw_labels=(255,),
    )


def similar_classes(kinds: int = 1) -> UInt8Array:
    """Return the class_id (C + 1,) uint8 of the class that resembles each class of ``village_classes(kinds)``.

    Grass and road, building and roof, trunk and foliage, fence and car resemble each other. 0 stays 0.
    """
    indices = np.arange(len(_CLASSES) * kinds)
    # Similar classes stand beside each other in the table.
    similar = (indices // kinds ^ 1) * kinds + indices % kinds + 1
    return np.concatenate([[0], similar]).astype(np.uint8)


_KIND_SQUARE = 8.0


@dataclass(frozen=True, eq=False)
class Terrain:
    """Rolling ground as a sum of plane waves, with height and slope in closed form.

    ``wave_vectors`` (W, 2) float64 [rad/m], ``phases`` (W,) float64 [rad], ``amplitudes`` (W,) float64 [m].
    """

    wave_vectors: Float64Array
    phases: Float64Array
    amplitudes: Float64Array

    @property
    def highest(self) -> float:
        """Height that the ground does not exceed [m]."""
        return float(np.abs(self.amplitudes).sum())

    def height(self, xy: npt.ArrayLike) -> Float64Array:
        """Return the height (...,) [m] at points (..., 2) [m]."""
        heights: Float64Array = np.sin(np.asarray(xy) @ self.wave_vectors.T + self.phases) @ self.amplitudes
        return heights

    def normal(self, xy: npt.ArrayLike) -> Float64Array:
        """Return upward unit normals (..., 3) at points (..., 2) [m]."""
        slopes = (np.cos(np.asarray(xy) @ self.wave_vectors.T + self.phases) * self.amplitudes) @ self.wave_vectors
        normals = np.concatenate([-slopes, np.ones((*slopes.shape[:-1], 1))], axis=-1)
        unit: Float64Array = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
        return unit


@dataclass(frozen=True, eq=False)
class World:
    """Triangle mesh with a class for each triangle.

    ``vertices`` (V, 3) float32 [m], ``triangles`` (T, 3) int32 indices of vertices, ``triangle_classes`` (T,) uint8
    class_ids of ``village_classes(kinds)``. Robots may drive where |x| and |y| are at most ``size`` / 2; the ground
    extends a few metres further.
    """

    size: float
    terrain: Terrain
    vertices: npt.NDArray[np.float32]
    triangles: Int32Array
    triangle_classes: UInt8Array
    kinds: int = 1

    def is_ground(self, class_ids: UInt8Array) -> BoolArray:
        """Return a mask (P,) of the class_ids (P,) that are grass or road of any kind."""
        is_ground: BoolArray = class_ids <= DIRT_ROAD * self.kinds
        return is_ground

    def with_kinds(self, kinds: int) -> World:
        """Return the same world with ``kinds`` kinds of each class; triangles in one square of 8 m are of one kind."""
        middles = self.vertices[self.triangles].mean(axis=1)[:, :2]
        squares = np.floor(middles / _KIND_SQUARE).astype(np.int64)
        kind = (squares[:, 0] * 7 + squares[:, 1] * 3) % kinds
        classes = (self.triangle_classes.astype(np.int64) - 1) * kinds + kind + 1
        return dataclasses.replace(self, triangle_classes=classes.astype(np.uint8), kinds=kinds)

    def surface_points(
        self, spacing: float, triangles: npt.NDArray[Any] | None = None
    ) -> Iterator[tuple[Float64Array, UInt8Array]]:
        """Yield batches of surface points (P, 3) at most ``spacing`` [m] apart, with their class_ids (P,).

        The points are those of ``points_on_triangles``, on all triangles or on those of a mask or of indices.
        """
        chosen = slice(None) if triangles is None else triangles
        corners = self.vertices[self.triangles[chosen]].astype(np.float64)
        classes = self.triangle_classes[chosen]
        for points, members in points_on_triangles(corners, spacing):
            yield points, classes[members]

    def obstacle_mask(self, cell: float) -> npt.NDArray[np.bool_]:
        """Return a mask (n, n) of the cells in which a robot cannot drive.

        The axes are x and y from -size/2 in steps of ``cell`` [m]. A cell is blocked if a surface other than ground
        lies 0.1 m to 1.5 m above the ground in it.
        """
        n = grid_length(self.size, cell)
        mask = np.zeros((n, n), dtype=np.bool_)
        highest = self.terrain.highest + 1.5
        for points, _ in self.surface_points(cell / 2, ~self.is_ground(self.triangle_classes)):
            # Roofs and crowns need no height of the ground below them.
            solid = points[points[:, 2] < highest]
            above = solid[:, 2] - self.terrain.height(solid[:, :2])
            index = np.floor((solid[(above > 0.1) & (above < 1.5), :2] + self.size / 2) / cell).astype(np.int64)
            index = index[((index >= 0) & (index < n)).all(axis=1)]
            mask[index[:, 0], index[:, 1]] = True
        return mask


def grid_length(size: float, cell: float) -> int:
    """Return the number of cells along one side of a square grid that covers ``size`` [m]."""
    return math.ceil(size / cell - 1e-9)
