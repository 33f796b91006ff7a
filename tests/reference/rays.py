"""The cells that a straight ray passes on the uniform grid: exact voxel traversal, one ray at a time.

Source: Amanatides and Woo, 'A Fast Voxel Traversal Algorithm for Ray Tracing' (1987). Unlike theirs, every crossing is
computed from the cell wall itself and never accumulated, so nothing drifts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from octoreplay.records import Float64Array, Int64Array

Key = tuple[int, int, int]


def coord_to_key(coord: Sequence[float] | Float64Array, resolution: float) -> Key:
    """The cell that holds a coordinate [m]: floor(coordinate / resolution) in float64."""
    x, y, z = (math.floor(float(value) / resolution) for value in coord)
    return x, y, z


def key_to_coord(key: Sequence[int] | Int64Array, resolution: float) -> tuple[float, float, float]:
    """The centre of a cell [m]."""
    x, y, z = ((float(k) + 0.5) * resolution for k in key)
    return x, y, z


def cells_before_end(
    origin: Sequence[float], target: Sequence[float], end_key: Key, resolution: float
) -> list[tuple[int, int, int]]:
    """The cells that the ray from ``origin`` to ``target`` [m] passes, in order, its start included, its end cell not.

    ``end_key`` holds ``target``. The next wall to cross is the one with the least ray parameter t; walls at the same t
    are crossed z before y before x (OctoMap's strict comparisons: x if tx < ty and tx < tz; else z if tx < ty; else y
    if ty < tz; else z). An axis that has reached the end cell's index has no more walls, so the walk takes exactly
    sum |end - start| steps and always ends in the end cell.
    """
    ox, oy, oz = origin
    dx, dy, dz = target[0] - ox, target[1] - oy, target[2] - oz
    x, y, z = coord_to_key(origin, resolution)
    end_x, end_y, end_z = end_key
    step_x, step_y, step_z = _sign(end_x - x), _sign(end_y - y), _sign(end_z - z)
    # The wall ahead of cell k is at k * resolution going down and at (k + 1) * resolution going up.
    ahead_x, ahead_y, ahead_z = step_x > 0, step_y > 0, step_z > 0
    tx = ((x + ahead_x) * resolution - ox) / dx if x != end_x else math.inf
    ty = ((y + ahead_y) * resolution - oy) / dy if y != end_y else math.inf
    tz = ((z + ahead_z) * resolution - oz) / dz if z != end_z else math.inf
    passed = []
    while x != end_x or y != end_y or z != end_z:
        passed.append((x, y, z))
        if tx < ty and tx < tz:
            x += step_x
            tx = ((x + ahead_x) * resolution - ox) / dx if x != end_x else math.inf
        elif ty < tz and not tx < ty:
            y += step_y
            ty = ((y + ahead_y) * resolution - oy) / dy if y != end_y else math.inf
        else:
            z += step_z
            tz = ((z + ahead_z) * resolution - oz) / dz if z != end_z else math.inf
    return passed


def _sign(number: int) -> int:
    """-1, 0 or 1."""
    return (number > 0) - (number < 0)
