"""The cells that a straight ray passes on the uniform grid: exact voxel traversal, one ray at a time.

Source: Amanatides and Woo, 'A Fast Voxel Traversal Algorithm for Ray Tracing' (1987), in whole numbers: nothing is
rounded on the way and nothing drifts.
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

    ``end_key`` holds ``target``. Both points are rounded to 2^-32 of a cell, and all else is exact: the next wall to
    cross is the one with the least ray parameter t; walls at the same t are crossed z before y before x (OctoMap's
    order). An axis that has reached the end cell's index has no more walls.
    """
    start_key = coord_to_key(origin, resolution)
    starts = [_fixed(o, k, resolution) for o, k in zip(origin, start_key, strict=True)]
    lengths = [_fixed(v, k, resolution) - s for v, k, s in zip(target, end_key, starts, strict=True)]
    steps = [_sign(end - start) for end, start in zip(end_key, start_key, strict=True)]
    # t = (wall - start) / length, times the product of all lengths, so that only whole numbers are compared.
    scales = [math.prod(abs(n) or 1 for other, n in enumerate(lengths) if other != axis) for axis in range(3)]
    key = list(start_key)
    passed = []
    while key != list(end_key):
        passed.append((key[0], key[1], key[2]))
        moving = [axis for axis in (2, 1, 0) if key[axis] != end_key[axis]]
        # The wall ahead of cell k is at k going down and at k + 1 going up.
        ahead = {axis: abs(((key[axis] + (steps[axis] > 0)) << 32) - starts[axis]) * scales[axis] for axis in moving}
        axis = min(moving, key=ahead.__getitem__)
        key[axis] += steps[axis]
    return passed


def _fixed(coord: float, key: int, resolution: float) -> int:
    """A coordinate [m] in the cell ``key``, in whole 2^-32 of a cell; it stays in its cell."""
    inside = round((float(coord) / resolution - key) * 2.0**32)
    return (key << 32) + min(max(inside, 0), (1 << 32) - 1)


def _sign(number: int) -> int:
    """-1, 0 or 1."""
    return (number > 0) - (number < 0)
