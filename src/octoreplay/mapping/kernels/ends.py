"""Where the rays of a scan end: measured points to keys, keys to distinct end cells with their classes.

Neighbouring points mostly share a cell, so they are kept as *runs*: key, kind and number of points in a row. The loops
over points have no branches, so that they run as vectors.
"""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import allocating_kernel, inline_kernel, kernel

_CUT = np.int16(255)
"""Kind of a ray that was cut at max_range, above every class_id; other kinds are class ids, 0 for an ignored label."""

_UNUSABLE = np.int16(0)
"""Kind of a point that frees its ray and hits nothing."""

_UNLABELLED = np.int16(1)
"""Kind of a point without a label."""

NUM_RUNS, NUM_POINTS = 0, 1

IS_OWN = 3
"""Row of a box that says whose body it is, after those of the axes."""

_NONE = np.int16(-1)
"""Kind of a point that carries no information."""

_FARTHEST_KEY = float(1 << 20)
"""Keys are limited to this, which is outside every key space and fits 32 bits."""

_CLOSE = 1e-8
"""Quotients farther from a whole number than this have the same floor with two roundings as with one."""

_BLOCK = 1024


@allocating_kernel
def depth_to_runs(
    depth_image, depth_unit, class_image, camera, pose, resolution, min_range, max_range, largest, special, meanings,
    confidences, boxes, keys, kinds, lengths, sums, ends, end_keys, counters,
):  # fmt: skip
    """Runs of a depth image's end cells: ``keys`` (m, 3), ``kinds`` (m,) and ``lengths`` (m,), m = counters[NUM_RUNS].

    ``camera`` is (fx, fy, cx, cy), ``pose`` (4, 4); a class_image of size 0 means that every point is class 1.
    Depths that equal one of ``special`` (s,), NaN included, become ``meanings`` (s,) [m], the last that applies.
    ``ends`` (n, 3), where it is not empty, gets the end point [m] of every ray and ``end_keys`` (n, 3) its key,
    n = counters[NUM_POINTS].

    ``confidences`` (H W,), where they are not empty, are the points', in 255ths, and ``sums`` (m,) gets their sum over
    each run. ``boxes`` (b, 4, 6) have a row (r_x, r_y, r_z, t, low, high) for each axis, and hold the points p with
    low <= r p + t <= high: these carry no information where the number at (IS_OWN, 0) is not 0, else they hit nothing.
    """
    height, width = depth_image.shape
    labelled = class_image.size > 0
    least, most = min_range * min_range, max_range * max_range
    ratios = np.empty(width)
    for u in range(width):
        ratios[u] = (u - camera[2]) / camera[0]
    z = np.empty(width)
    world = np.empty((3, width))
    row_kinds = np.empty(width, np.int16)
    row_keys = np.empty((3, width), np.int32)
    starts = np.empty(width + 1, np.int32)
    for v in range(height):
        ratio = (v - camera[3]) / camera[1]
        _depths_of_row(depth_image, v, depth_unit, largest, special, meanings, z)
        num_cut = 0
        plus = ratio * ratio + 1.0
        for u in range(width):
            distance = z[u] * z[u] * (ratios[u] * ratios[u] + plus)
            kind = _UNLABELLED if (z[u] > 0.0) & (distance >= least) else _NONE
            row_kinds[u] = _CUT if distance > most else kind
            num_cut += distance > most
        if labelled:
            for u in range(width):
                row_kinds[u] = class_image[v, u] if row_kinds[u] == _UNLABELLED else row_kinds[u]
        if num_cut > 0:
            for u in range(width):
                square = ratios[u] * ratios[u] + plus
                z[u] = max_range / np.sqrt(square) if row_kinds[u] == _CUT else z[u]
        # A loop over a number that is written down would be unrolled: three times as much to compile, and no faster.
        for axis in range(keys.shape[1]):
            along, down = pose[axis, 0], pose[axis, 1] * ratio
            ahead, shift = pose[axis, 2], pose[axis, 3]
            for u in range(width):
                world[axis, u] = z[u] * (along * ratios[u] + ahead + down) + shift
        if boxes.size + confidences.size > 0:
            _leave_out(world, width, v * width, confidences, boxes, row_kinds)
        num_runs = counters[NUM_RUNS]
        _add_runs(world, row_kinds, width, resolution, row_keys, starts, keys, kinds, lengths, ends, end_keys, counters)
        if confidences.size > 0:
            _sum_over_runs(confidences, v * width, starts, width, row_kinds, sums, num_runs)


@inline_kernel
def _depths_of_row(depth_image, v, depth_unit, largest, special, meanings, z):
    """Depths z (W,) [m] of the pixels in row v, 0 for those without information."""
    for u in range(z.size):
        raw = depth_image[v, u]
        value = raw * depth_unit
        z[u] = value if (value > 0.0) & (value < np.inf) & (raw != largest) else 0.0
    for k in range(special.size):
        for u in range(z.size):
            raw = depth_image[v, u]
            is_special = (raw == special[k]) | ((raw != raw) & (special[k] != special[k]))
            z[u] = meanings[k] if is_special else z[u]


@allocating_kernel
def depth_to_points(depth_image, depth_unit, slopes, farthest, largest, special, meanings, points):
    """The points (H W, 3) of a depth image, in the sensor's frame, where a lens distorts: 0 without information.

    ``slopes`` (2, H, W) are x / z and y / z of each pixel; depths are limited to ``farthest`` [m], the rest is as for
    depth_to_runs. There the pinhole has a way of its own, which would take a tenth longer if it had to read slopes.
    """
    height, width = depth_image.shape
    z = np.empty(width)
    for v in range(height):
        _depths_of_row(depth_image, v, depth_unit, largest, special, meanings, z)
        for u in range(width):
            depth, place = min(z[u], farthest), v * width + u
            points[place, 0] = depth * slopes[0, v, u]
            points[place, 1] = depth * slopes[1, v, u]
            points[place, 2] = depth


@allocating_kernel
def points_to_runs(
    points, class_ids, pose, resolution, min_range, max_range, confidences, boxes, keys, kinds, lengths, sums, ends,
    end_keys, counters,
):  # fmt: skip
    """Runs of a point cloud's end cells; as depth_to_runs, for points (p, 3) in the sensor's frame.

    Points that are not finite, or in the sensor itself, carry no information.
    """
    labelled = class_ids.size > 0
    least, most = min_range * min_range, max_range * max_range
    sensor = np.empty((3, _BLOCK))
    squares = np.empty(_BLOCK)
    world = np.empty((3, _BLOCK))
    block_kinds = np.empty(_BLOCK, np.int16)
    block_keys = np.empty((3, _BLOCK), np.int32)
    starts = np.empty(_BLOCK + 1, np.int32)
    for first in range(0, points.shape[0], _BLOCK):
        size = min(_BLOCK, points.shape[0] - first)
        num_cut = 0
        for i in range(size):
            x, y = np.float64(points[first + i, 0]), np.float64(points[first + i, 1])
            z = np.float64(points[first + i, 2])
            distance = x * x + y * y + z * z
            valid = (distance > 0.0) & (distance < np.inf) & (distance >= least)
            kind = _UNLABELLED if valid else _NONE
            is_cut = valid & (distance > most)
            sensor[0, i] = x if valid else 0.0
            sensor[1, i] = y if valid else 0.0
            sensor[2, i] = z if valid else 0.0
            squares[i] = distance
            block_kinds[i] = _CUT if is_cut else kind
            num_cut += is_cut
        if labelled:
            for i in range(size):
                block_kinds[i] = class_ids[first + i] if block_kinds[i] == _UNLABELLED else block_kinds[i]
        if num_cut > 0:
            for i in range(size):
                scale = max_range / np.sqrt(squares[i]) if block_kinds[i] == _CUT else 1.0
                sensor[0, i] *= scale
                sensor[1, i] *= scale
                sensor[2, i] *= scale
        for axis in range(keys.shape[1]):
            along_x, along_y, along_z, shift = pose[axis, 0], pose[axis, 1], pose[axis, 2], pose[axis, 3]
            for i in range(size):
                world[axis, i] = along_x * sensor[0, i] + along_y * sensor[1, i] + along_z * sensor[2, i] + shift
        if boxes.size + confidences.size > 0:
            _leave_out(world, size, first, confidences, boxes, block_kinds)
        num_runs = counters[NUM_RUNS]
        _add_runs(
            world, block_kinds, size, resolution, block_keys, starts, keys, kinds, lengths, ends, end_keys, counters
        )
        if confidences.size > 0:
            _sum_over_runs(confidences, first, starts, size, block_kinds, sums, num_runs)


@allocating_kernel
def _add_runs(world, point_kinds, size, resolution, point_keys, starts, keys, kinds, lengths, ends, end_keys, counters):
    """Append the runs of ``size`` points, given in the world."""
    _coords_to_keys(world, size, resolution, point_keys)
    is_start = np.empty(size + 1, np.uint8)
    is_start[0] = 1
    for i in range(1, size):
        is_start[i] = (
            (point_keys[0, i] != point_keys[0, i - 1])
            | (point_keys[1, i] != point_keys[1, i - 1])
            | (point_keys[2, i] != point_keys[2, i - 1])
            | (point_kinds[i] != point_kinds[i - 1])
        )
    num_starts = 0
    for i in range(size):
        starts[num_starts] = i
        num_starts += is_start[i]
    starts[num_starts] = size
    place = counters[NUM_RUNS]
    for run in range(num_starts):
        i = starts[run]
        for axis in range(3):
            keys[place, axis] = point_keys[axis, i]
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
def _leave_out(world, size, first, confidences, boxes, point_kinds):
    """The kinds of points without confidence or within boxes; the ``size`` points begin at ``first`` in the scan."""
    for i in range(size if confidences.size > 0 else 0):
        is_vain = (confidences[first + i] == 0) & (point_kinds[i] != _NONE) & (point_kinds[i] != _CUT)
        point_kinds[i] = _UNUSABLE if is_vain else point_kinds[i]
    for box in range(boxes.shape[0]):
        kind = _NONE if boxes[box, IS_OWN, 0] != 0.0 else _UNUSABLE
        for i in range(size):
            is_within = (point_kinds[i] != _NONE) & (point_kinds[i] != _CUT)
            for axis in range(IS_OWN):
                place = (
                    boxes[box, axis, 0] * world[0, i] + boxes[box, axis, 1] * world[1, i]
                    + boxes[box, axis, 2] * world[2, i] + boxes[box, axis, 3]
                )  # fmt: skip
                is_within &= (boxes[box, axis, 4] <= place) & (place <= boxes[box, axis, 5])
            point_kinds[i] = kind if is_within else point_kinds[i]


@kernel
def _sum_over_runs(confidences, first, starts, size, point_kinds, sums, place):
    """Write the sums of the points' confidences over each of their runs, which begin at ``place``."""
    run = 0
    while starts[run] < size:
        total = 0
        for i in range(starts[run], starts[run + 1]):
            total += confidences[first + i]
        sums[place] = total
        place += point_kinds[starts[run]] != _NONE
        run += 1


@inline_kernel
def _coords_to_keys(coords, size, resolution, keys):
    """Keys = floor(coords / resolution) (3, size), by multiplication where that cannot make a difference."""
    inverse = 1.0 / resolution
    for axis in range(keys.shape[0]):
        num_close = 0
        for i in range(size):
            quotient = min(max(coords[axis, i] * inverse, -_FARTHEST_KEY), _FARTHEST_KEY)
            keys[axis, i] = np.int32(np.floor(quotient))
            num_close += abs(quotient - np.rint(quotient)) < _CLOSE
        if num_close > 0:
            for i in range(size):
                quotient = min(max(coords[axis, i] / resolution, -_FARTHEST_KEY), _FARTHEST_KEY)
                keys[axis, i] = np.int32(np.floor(quotient))


@kernel
def widen_to_keys(keys, low, high):
    """Widen the box from ``low`` (3,) to ``high`` (3,) so that it holds all keys (n, 3)."""
    for axis in range(3):
        least, most = low[axis], high[axis]
        for i in range(keys.shape[0]):
            least = min(least, np.int64(keys[i, axis]))
            most = max(most, np.int64(keys[i, axis]))
        low[axis], high[axis] = least, most


@inline_kernel
def _place_of(cell, table, end_cells):
    """Where in the hash table a cell's number is, or belongs."""
    mask = table.size - 1
    place = np.int64((np.uint64(cell) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(40)) & mask
    while table[place] >= 0 and end_cells[table[place]] != cell:
        place = (place + 1) & mask
    return place


@kernel
def distinct_ends(keys, kinds, lengths, low, edges, num_classes, table, votes, end_cells, end_keys, end_marks):
    """The distinct cells of runs (m,), with 1 + the class that most points in each have, 0 where none has a class.

    ``low`` and ``edges`` (3,) are the box of the keys. ``table``, a power of two of at least 2 m, is filled with -1
    and holds what it likes afterwards. Returns the number of cells, written to ``end_keys`` (n, 3) and ``end_marks``.
    """
    num_ends = 0
    last_cell, slot = np.int64(-1), np.int64(0)
    for run in range(keys.shape[0]):
        x, y, z = keys[run, 0] - low[0], keys[run, 1] - low[1], keys[run, 2] - low[2]
        cell = (z * edges[1] + y) * edges[0] + x
        if cell != last_cell:
            last_cell = cell
            place = _place_of(cell, table, end_cells)
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


@kernel
def weigh_ends(
    keys, kinds, sums, low, edges, num_classes, table, votes, vote_sums, end_cells, end_marks, end_strengths
):
    """Let the class with the largest sum of confidences win each cell, and give the mean of its points as strength.

    ``sums`` (m,) are those of the points in each run; the rest is as distinct_ends has left it. ``vote_sums`` (n, C) is
    0 and gets the sums by cell, ``end_marks`` (n,) 1 + the classes, and ``end_strengths`` (n,) the means, rounded half
    up; both stay as they are where no point has a class.
    """
    last_cell, slot = np.int64(-1), np.int64(0)
    for run in range(keys.shape[0]):
        x, y, z = keys[run, 0] - low[0], keys[run, 1] - low[1], keys[run, 2] - low[2]
        cell = (z * edges[1] + y) * edges[0] + x
        if cell != last_cell:
            last_cell = cell
            slot = np.int64(table[_place_of(cell, table, end_cells)])
        if 0 < kinds[run] <= num_classes:
            vote_sums[slot, kinds[run] - 1] += sums[run]
    for slot in range(end_marks.size):
        best, most = -1, 0
        for c in range(num_classes):
            if vote_sums[slot, c] > most:
                best, most = c, vote_sums[slot, c]
        if best >= 0:
            num_points = np.int64(votes[slot, best])
            end_marks[slot] = np.uint8(best + 2)
            end_strengths[slot] = np.uint8((2 * most + num_points) // (2 * num_points))
