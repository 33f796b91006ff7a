"""Exact voxel traversal of one ray on the uniform grid.

Source: Amanatides and Woo, 'A Fast Voxel Traversal Algorithm for Ray Tracing' (1987), in integers: without rounding,
so errors cannot accumulate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from octoreplay.records import Float64Array, Int64Array

Key = tuple[int, int, int]


def coord_to_key(coord: Sequence[float] | Float64Array, resolution: float) -> Key:
    """Return the key of the cell that holds a coordinate [m]: floor(coordinate / resolution) in float64."""
    x, y, z = (math.floor(float(value) / resolution) for value in coord)
    return x, y, z


def key_to_coord(key: Sequence[int] | Int64Array, resolution: float) -> tuple[float, float, float]:
    """Return the centre of a cell [m]."""
    x, y, z = ((float(k) + 0.5) * resolution for k in key)
    return x, y, z


def cells_before_end(
    origin: Sequence[float], target: Sequence[float], end_key: Key, resolution: float
) -> list[tuple[int, int, int]]:
    """Return the cells that the ray from ``origin`` to ``target`` [m] passes, in order, without its end cell.

    ``end_key`` is the cell of ``target``. Both points are rounded to 2^-32 of a cell; all else is exact. The next wall
    is the one with the smallest ray parameter t; walls at the same t are crossed z before y before x (OctoMap's order).
    An axis at the end cell's index has no more walls.
    """
    start_key = coord_to_key(origin, resolution)
    starts = [_fixed(o, k, resolution) for o, k in zip(origin, start_key, strict=True)]
    lengths = [_fixed(v, k, resolution) - s for v, k, s in zip(target, end_key, starts, strict=True)]
    steps = [_sign(end - start) for end, start in zip(end_key, start_key, strict=True)]
    # t = (wall - start) / length, multiplied by the product of all lengths, so that integers are compared.
    scales = [math.prod(abs(n) or 1 for other, n in enumerate(lengths) if other != axis) for axis in range(3)]
    key = list(start_key)
    passed = []
    while key != list(end_key):
        passed.append((key[0], key[1], key[2]))
        moving = [axis for axis in (2, 1, 0) if key[axis] != end_key[axis]]
        # The wall ahead of cell k is at k in falling direction and at k + 1 in rising direction.
        ahead = {axis: abs(((key[axis] + (steps[axis] > 0)) << 32) - starts[axis]) * scales[axis] for axis in moving}
        axis = min(moving, key=ahead.__getitem__)
        key[axis] += steps[axis]
    return passed


def _fixed(coord: float, key: int, resolution: float) -> int:
    """Return a coordinate [m] in the cell ``key`` in integer multiples of 2^-32 cells, within its cell."""
    inside = round((float(coord) / resolution - key) * 2.0**32)
    return (key << 32) + min(max(inside, 0), (1 << 32) - 1)


def _sign(number: int) -> int:
    """Return -1, 0 or 1."""
    return (number > 0) - (number < 0)
