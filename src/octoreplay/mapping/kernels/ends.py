"""Where the rays of a scan end: measured points to keys, keys to distinct end cells with their classes.

Neighbouring points mostly share a cell, so they are kept as *runs*: key, kind and number of points in a row. The loops
over points have no branches, so that they run as vectors.
"""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel

CUT = 255
"""Kind of a ray that was cut at max_range, above every class_id; other kinds are class ids, 0 for an ignored label."""

NUM_RUNS, NUM_POINTS = 0, 1

_NONE = -1
"""Kind of a point that carries no information."""

_FARTHEST_KEY = float(1 << 20)
"""Keys are limited to this, which is outside every key space and fits 32 bits."""

_CLOSE = 1e-8
"""Quotients farther from a whole number than this have the same floor with two roundings as with one."""

_BLOCK = 1024


@inline_kernel
def _in_list(value, numbers):
    """True when ``value`` is one of ``numbers``; NaN equals NaN."""
    found = False
    for i in range(numbers.size):
        if value == numbers[i] or (value != value and numbers[i] != numbers[i]):
            found = True
    return found


@kernel
def depth_to_runs(
    depth_image, depth_unit, class_image, camera, pose, resolution, min_range, max_range, largest, invalid, no_return,
    keys, kinds, lengths, ends, end_keys, counters,
):  # fmt: skip
    """Runs of a depth image's end cells: ``keys`` (m, 3), ``kinds`` (m,) and ``lengths`` (m,), m = counters[NUM_RUNS].

    ``camera`` is (fx, fy, cx, cy), ``pose`` (4, 4); a class_image of size 0 means that every point is class 1.
    ``ends`` (n, 3), where it is not empty, gets the end point [m] of every ray and ``end_keys`` (n, 3) its key,
    n = counters[NUM_POINTS].
    """
    height, width = depth_image.shape
    labelled = class_image.size > 0
    least, most = min_range * min_range, max_range * max_range
    ratios = np.empty(width)
    across = np.empty((3, width))
    for u in range(width):
        ratios[u] = (u - camera[2]) / camera[0]
        for axis in range(3):
            across[axis, u] = pose[axis, 0] * ratios[u] + pose[axis, 2]
    z = np.empty(width)
    squares = np.empty(width)
    world = np.empty((3, width))
    row_kinds = np.empty(width, np.int16)
    row_keys = np.empty((3, width), np.int32)
    starts = np.empty(width + 1, np.int32)
    for v in range(height):
        ratio = (v - camera[3]) / camera[1]
        raw = depth_image[v]
        for u in range(width):
            value = raw[u] * depth_unit
            z[u] = value if (value > 0.0) & (value < np.inf) & (raw[u] != largest) else 0.0
        if no_return.size > 0 or invalid.size > 0:
            for u in range(width):
                if _in_list(raw[u], no_return):
                    z[u] = np.inf
                elif _in_list(raw[u], invalid):
                    z[u] = 0.0
        num_cut = 0
        plus = ratio * ratio + 1.0
        for u in range(width):
            square = ratios[u] * ratios[u] + plus
            squares[u] = square
            distance = z[u] * z[u] * square
            kind = np.int16(1) if (z[u] > 0.0) & (distance >= least) else np.int16(_NONE)
            kind = np.int16(CUT) if distance > most else kind
            row_kinds[u] = kind
            num_cut += kind == CUT
        if labelled:
            labels = class_image[v]
            for u in range(width):
                row_kinds[u] = np.int16(labels[u]) if row_kinds[u] == 1 else row_kinds[u]
        if num_cut > 0:
            for u in range(width):
                z[u] = max_range / np.sqrt(squares[u]) if row_kinds[u] == CUT else z[u]
        for axis in range(3):
            down, shift = pose[axis, 1] * ratio, pose[axis, 3]
            directions, out = across[axis], world[axis]
            for u in range(width):
                out[u] = z[u] * (directions[u] + down) + shift
        _add_runs(world, row_kinds, width, resolution, row_keys, starts, keys, kinds, lengths, ends, end_keys, counters)


@kernel
def points_to_runs(
    points, class_ids, pose, resolution, min_range, max_range, keys, kinds, lengths, ends, end_keys, counters
):
    """Runs of a point cloud's end cells; as depth_to_runs, for points (p, 3) in the sensor's frame."""
    labelled = class_ids.size > 0
    least, most = min_range * min_range, max_range * max_range
    sensor = np.empty((3, _BLOCK))
    scales = np.empty(_BLOCK)
    world = np.empty((3, _BLOCK))
    block_kinds = np.empty(_BLOCK, np.int16)
    block_keys = np.empty((3, _BLOCK), np.int32)
    starts = np.empty(_BLOCK + 1, np.int32)
    for first in range(0, points.shape[0], _BLOCK):
        size = min(_BLOCK, points.shape[0] - first)
        num_cut = 0
        for i in range(size):
            x, y, z = (
                np.float64(points[first + i, 0]),
                np.float64(points[first + i, 1]),
                np.float64(points[first + i, 2]),
            )
            distance = x * x + y * y + z * z
            valid = (distance > 0.0) & (distance < np.inf) & (distance >= least)
            kind = np.int16(1) if valid else np.int16(_NONE)
            kind = np.int16(CUT) if valid & (distance > most) else kind
            sensor[0, i] = x if valid else 0.0
            sensor[1, i] = y if valid else 0.0
            sensor[2, i] = z if valid else 0.0
            scales[i] = distance
            block_kinds[i] = kind
            num_cut += kind == CUT
        if labelled:
            for i in range(size):
                block_kinds[i] = np.int16(class_ids[first + i]) if block_kinds[i] == 1 else block_kinds[i]
        if num_cut > 0:
            for i in range(size):
                scale = max_range / np.sqrt(scales[i]) if block_kinds[i] == CUT else 1.0
                sensor[0, i] *= scale
                sensor[1, i] *= scale
                sensor[2, i] *= scale
        for axis in range(3):
            along_x, along_y, along_z, shift = pose[axis, 0], pose[axis, 1], pose[axis, 2], pose[axis, 3]
            xs, ys, zs, out = sensor[0], sensor[1], sensor[2], world[axis]
            for i in range(size):
                out[i] = along_x * xs[i] + along_y * ys[i] + along_z * zs[i] + shift
        _add_runs(
            world, block_kinds, size, resolution, block_keys, starts, keys, kinds, lengths, ends, end_keys, counters
        )


@kernel
def _add_runs(world, point_kinds, size, resolution, point_keys, starts, keys, kinds, lengths, ends, end_keys, counters):
    """Append the runs of ``size`` points, given in the world."""
    for axis in range(3):
        _coords_to_keys(world[axis], size, resolution, point_keys[axis])
    kx, ky, kz = point_keys[0], point_keys[1], point_keys[2]
    is_start = np.ones(size + 1, np.uint8)
    for i in range(1, size):
        is_start[i] = (
            (kx[i] != kx[i - 1]) | (ky[i] != ky[i - 1]) | (kz[i] != kz[i - 1]) | (point_kinds[i] != point_kinds[i - 1])
        )
    num_starts = 0
    for i in range(size):
        starts[num_starts] = i
        num_starts += is_start[i]
    starts[num_starts] = size
    place = counters[NUM_RUNS]
    for run in range(num_starts):
        i = starts[run]
        keys[place, 0], keys[place, 1], keys[place, 2] = kx[i], ky[i], kz[i]
        kinds[place] = np.uint8(point_kinds[i])
        lengths[place] = starts[run + 1] - i
        place += point_kinds[i] != _NONE
    counters[NUM_RUNS] = place
    if ends.size > 0:
        place = counters[NUM_POINTS]
        for i in range(size):
            for axis in range(3):
                ends[place, axis] = world[axis, i]
                end_keys[place, axis] = point_keys[axis, i]
            place += point_kinds[i] != _NONE
        counters[NUM_POINTS] = place


@kernel
def _coords_to_keys(coords, size, resolution, keys):
    """Keys = floor(coords / resolution), by multiplication where that cannot make a difference."""
    inverse = 1.0 / resolution
    num_close = 0
    for i in range(size):
        quotient = min(max(coords[i] * inverse, -_FARTHEST_KEY), _FARTHEST_KEY)
        keys[i] = np.int32(np.floor(quotient))
        num_close += abs(quotient - np.rint(quotient)) < _CLOSE
    if num_close > 0:
        for i in range(size):
            keys[i] = np.int32(np.floor(min(max(coords[i] / resolution, -_FARTHEST_KEY), _FARTHEST_KEY)))


@kernel
def widen_to_keys(keys, low, high):
    """Widen the box from ``low`` (3,) to ``high`` (3,) so that it holds all keys (n, 3)."""
    for axis in range(3):
        least, most = low[axis], high[axis]
        for i in range(keys.shape[0]):
            least = min(least, np.int64(keys[i, axis]))
            most = max(most, np.int64(keys[i, axis]))
        low[axis], high[axis] = least, most


@kernel
def distinct_ends(keys, kinds, lengths, low, edges, num_classes, table, votes, end_cells, end_keys, end_marks):
    """The distinct cells of runs (m,), with 1 + the class that most points in each have, 0 where none has a class.

    ``low`` and ``edges`` (3,) are the box of the keys. ``table``, a power of two of at least 2 m, is filled with -1
    and holds what it likes afterwards. Returns the number of cells, written to ``end_keys`` (n, 3) and ``end_marks``.
    """
    num_ends = 0
    last_cell, slot = np.int64(-1), np.int64(0)
    mask = table.size - 1
    for run in range(keys.shape[0]):
        x, y, z = keys[run, 0] - low[0], keys[run, 1] - low[1], keys[run, 2] - low[2]
        cell = (z * edges[1] + y) * edges[0] + x
        if cell != last_cell:
            last_cell = cell
            place = np.int64((np.uint64(cell) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(40)) & mask
            while table[place] >= 0 and end_cells[table[place]] != cell:
                place = (place + 1) & mask
            slot = np.int64(table[place])
            if slot < 0:
                slot = num_ends
                table[place] = slot
                end_cells[slot] = cell
                for axis in range(3):
                    end_keys[slot, axis] = keys[run, axis]
                for c in range(num_classes):
                    votes[slot, c] = 0
                num_ends += 1
        if 0 < kinds[run] <= num_classes:
            votes[slot, kinds[run] - 1] += lengths[run]
    for slot in range(num_ends):
        best, most = 0, 0
        for c in range(num_classes):
            if votes[slot, c] > most:
                best, most = c + 2, votes[slot, c]
        end_marks[slot] = np.uint8(best)
    return num_ends
