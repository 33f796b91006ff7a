"""End cells of a scan's rays: from measured points to keys, from keys to distinct end cells with their classes.

Neighbouring points mostly share a cell, so they are stored as *runs* of consecutive points with equal key and kind. The
loops over points have no branches, so that they compile to vector instructions. The *kind* of a point is its class_id,
or one of the constants below.
"""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import allocating_kernel, inline_kernel, kernel

_CUT = np.int32(255)
"""Kind of a ray that was cut at max_range; above every class_id."""

_UNUSABLE = np.int32(0)
"""Kind of a point that frees its ray and hits nothing, such as one with an ignored label."""

NUM_SCRATCH_ROWS = 8
"""Number of rows of each scratch array of the kernels that find runs."""

NUM_RUNS, NUM_POINTS = 0, 1
"""Counters: number of runs, and number of stored end points."""

IS_OWN = 3
"""Row of a box after those of the three axes; its first number is 1 for the robot's own body, 0 for another robot's."""

_NONE = np.int32(-1)
"""Kind of a point that carries no information."""

_OPEN = np.uint8(1)
"""Mark of a cell with a class to be voted on."""

_FARTHEST_KEY = float(1 << 20)
"""Limit of keys, outside the key space and within 32 bits."""

_CLOSE = 1e-8
"""Quotients farther than this from an integer have the same floor when rounded twice as when rounded once."""

BLOCK = 1024
"""Number of points of a cloud that are processed together."""

_SEGMENT = 64
"""Number of neighbouring points that are computed again in float64 where float32 does not decide one of them."""

_ROUNDING = np.float32(2.0**-20)
"""Bound on the relative error of a float32 computation: 16 roundings of 2^-24 each. The longest chain in float32 is the
coordinate of a pixel of a ray that was cut:

    q = z (a + b) + c,  z = r / sqrt(s + t),  all inputs rounded once

    s + t: 2, square root: 2, z: 4 roundings;  a + b: 2 (|a| + |b|);  product: 7 r (|a| + |b|);  q: 8 r (|a| + |b|) + 2

with r the range in cells and |c| < 1. Twice this bound holds terms of second order and the float64 reference, with an
error below 2^-33 cells, too."""

_TINY = np.float32(1e-18)
"""Depth [m] in float32 of smaller ones, with a square that does not underflow."""

_SQUARE_OF_TINY = np.float32(1e-37)
"""Squared distance below that of every measured point."""


@kernel
def depth_to_runs(
    depth_image, depth_unit, class_image, camera, pose, resolution, min_range, max_range, largest, special, meanings,
    confidences, boxes, floats, doubles, integers, keys, kinds, lengths, sums, ends, end_keys, counters,
):  # fmt: skip
    """Find the runs of a depth image's end cells.

    Loop invariant: the outputs hold the runs and end points of the rows before ``v``; ``counters`` holds their numbers
    m and n.

    - ``depth_image`` (H, W) uint16 or float32, ``depth_unit``: depth along z = value x ``depth_unit`` [m].
    - ``class_image`` (H, W) uint8: class ids.
    - ``camera`` (4,) float64: fx, fy, cx, cy [pixel].
    - ``pose`` (4, 4) float64: T_team_sensor.
    - ``resolution``: edge of a cell [m].
    - ``min_range``, ``max_range``: limits of a point's distance [m].
    - ``largest``: depth value that carries no information.
    - ``special`` (s,) float64: depth values with a meaning, NaN included.
    - ``meanings`` (s,) float64: their depths [m]; 0 carries no information. The last match applies.
    - ``confidences`` (H W,) uint8: label confidences in 1 / 255; size 0 for full confidence.
    - ``boxes`` (b, 4, 6) float64: a row (r_x, r_y, r_z, t, low, high) for each axis. A box holds the points p in the
      team's frame with low <= r p + t <= high. Its points carry no information where the number at (IS_OWN, 0) is not
      0; otherwise they free their rays and hit nothing.
    - ``floats`` float32, ``doubles`` float64, ``integers`` int32, each (NUM_SCRATCH_ROWS, >= max(W + 1, 3)): scratch.
    - ``keys`` (3, >= m + 1) int32, ``kinds`` (>= m + 1,) uint8, ``lengths`` (>= m + 1,) int32: output, runs.
    - ``sums`` (>= m + 1,) int32: output, confidences summed over each run.
    - ``ends`` (>= n + 1, 3) float64: output, end point of each ray in the team's frame [m]; size 0 for none.
    - ``end_keys`` (>= n + 1, 3) int32: output, key of each end point.
    - ``counters`` (2,) int64: m at NUM_RUNS and n at NUM_POINTS, in place.
    """
    height, width = depth_image.shape
    # A view of several shortened rows has no unit stride for the compiler, so these views are of whole rows or of one.
    slopes, squares, near, downs, rest = floats, floats[3, :width], floats[4, :width], floats[5], floats[6]
    world, ratios, z = doubles, doubles[3, :width], doubles[4]
    row_keys, row_kinds, is_unsure, base = integers, integers[3], integers[4, :width], integers[5]
    for u in range(width):
        ratios[u] = (u - camera[2]) / camera[0]
        is_unsure[u] = 1
    farthest = 0.0
    for axis in range(keys.shape[0]):
        base[axis] = np.int32(np.floor(pose[axis, 3] / resolution))
        rest[axis] = pose[axis, 3] / resolution - base[axis]
        steepest = max(abs(camera[3]), abs(height - 1 - camera[3])) * abs(pose[axis, 1] / camera[1])
        widest = 0.0
        for u in range(width):
            slope = pose[axis, 0] * ratios[u] + pose[axis, 2]
            slopes[axis, u], squares[u] = slope / resolution, ratios[u] * ratios[u]
            widest = max(widest, abs(slope))
        farthest = max(farthest, max_range * (steepest + widest) / resolution)
    tolerance = _ROUNDING * np.float32(farthest + 1.0)
    # Boxes and rays to points need points in float64; a tolerance of half a cell decides no key.
    is_rough = boxes.size + ends.size == 0 and tolerance < 0.5
    for v in range(height):
        ratio = (v - camera[3]) / camera[1]
        plus = ratio * ratio + 1.0
        if is_rough:
            _depths_of_row(depth_image[v], np.float32(depth_unit), np.float32(largest), special, meanings, _TINY, near)
            _kinds_of_row(near, squares, np.float32(plus), min_range, max_range, class_image[v], row_kinds, is_unsure)
            for axis in range(keys.shape[0]):
                downs[axis] = pose[axis, 1] * ratio / resolution
            _keys_of_row(near, slopes, downs, rest, base, tolerance, row_keys, is_unsure)
        if _sum(is_unsure) > 0:
            for first in range(0, width, _SEGMENT):
                part = slice(first, min(first + _SEGMENT, width))
                if _sum(is_unsure[part]) > 0:
                    depths = z[: part.stop - first]
                    _depths_of_row(depth_image[v, part], depth_unit, largest, special, meanings, 0.0, depths)
                    _exact_pixels(
                        depths, ratios[part], ratio, plus, pose, resolution, min_range, max_range,
                        class_image[v, part], world, row_kinds[part], row_keys, first,
                    )  # fmt: skip
        if boxes.size + confidences.size > 0:
            _filter_points(world, width, v * width, confidences, boxes, row_kinds)
        _add_runs(
            world, row_kinds, width, row_keys, integers[6:], confidences, v * width, keys, kinds, lengths, sums, ends,
            end_keys, counters,
        )  # fmt: skip


@inline_kernel
def _sum(numbers):
    """Sum of ``numbers`` (n,) int32 as int32: a loop that also had a wider sum would compute in shorter vectors."""
    total = np.int32(0)
    for i in range(numbers.size):
        total = np.int32(total + numbers[i])
    return total


@inline_kernel
def _kinds_of_row(near, squares, plus, min_range, max_range, labels, kinds, is_unsure):
    """Find the kinds of pixels, and cut rays at ``max_range``.

    - ``near`` (W,) float32: depths [m], 0 without information; in place.
    - ``squares`` (W,) float32, ``plus`` float32: squared length of a pixel's ray at depth 1 is squares + plus.
    - ``min_range``, ``max_range``: as for depth_to_runs.
    - ``labels`` (W,) uint8: class ids.
    - ``kinds`` (W,) int32: output.
    - ``is_unsure`` (W,) int32: output, 1 where float32 does not decide on which side of a limit the point is.
    """
    least, most = np.float32(min_range * min_range), np.float32(max_range * max_range)
    # A pixel without information has distance 0, below all limits.
    least_from = max(least - _ROUNDING * least - _TINY, _SQUARE_OF_TINY)
    least_to = least + _ROUNDING * least + _TINY
    most_from, most_to = most - _ROUNDING * most, most + _ROUNDING * most
    least = max(least, _SQUARE_OF_TINY)
    num_cut = np.int32(0)
    for u in range(near.size):
        distance = near[u] * near[u] * (squares[u] + plus)
        is_near_least = (distance >= least_from) & (distance <= least_to)
        is_near_most = (distance >= most_from) & (distance <= most_to)
        kind = np.int32(labels[u]) if distance >= least else _NONE
        kinds[u] = _CUT if distance > most else kind
        is_unsure[u] = np.int32(is_near_least | is_near_most)
        num_cut = np.int32(num_cut + (distance > most))
    if num_cut > 0:
        for u in range(near.size):
            near[u] = np.float32(max_range) / np.sqrt(squares[u] + plus) if kinds[u] == _CUT else near[u]


@inline_kernel
def _keys_of_row(near, slopes, downs, rest, base, tolerance, keys, is_unsure):
    """Compute keys in float32.

    - ``near`` (W,) float32: depths [m].
    - ``slopes`` (3, W) float32, ``downs`` (3,) float32: cells along each axis for a depth of 1 m are slopes + downs.
    - ``rest`` (3,) float32, ``base`` (3,) int32: position of the sensor in its cell, and the cell.
    - ``tolerance`` float32: bound on the error [cell].
    - ``keys`` (3, W) int32: output.
    - ``is_unsure`` (W,) int32: in place, 1 where the point is too close to a border of a cell.
    """
    # One loop for all axes reads and writes the other arrays once.
    slopes_x, slopes_y, slopes_z = slopes[0], slopes[1], slopes[2]
    keys_x, keys_y, keys_z = keys[0], keys[1], keys[2]
    down_x, down_y, down_z = downs[0], downs[1], downs[2]
    rest_x, rest_y, rest_z = rest[0], rest[1], rest[2]
    base_x, base_y, base_z = base[0], base[1], base[2]
    half = np.float32(0.5)
    from_middle = half - tolerance
    for u in range(near.size):
        x = near[u] * (slopes_x[u] + down_x) + rest_x
        y = near[u] * (slopes_y[u] + down_y) + rest_y
        z = near[u] * (slopes_z[u] + down_z) + rest_z
        cell_x, cell_y, cell_z = np.floor(x), np.floor(y), np.floor(z)
        keys_x[u], keys_y[u], keys_z[u] = (
            np.int32(cell_x) + base_x,
            np.int32(cell_y) + base_y,
            np.int32(cell_z) + base_z,
        )
        off_x, off_y, off_z = abs(x - cell_x - half), abs(y - cell_y - half), abs(z - cell_z - half)
        is_sure = max(max(off_x, off_y), off_z) < from_middle
        is_unsure[u] |= np.int32((near[u] > 0) & ~is_sure)


@inline_kernel
def _exact_pixels(z, ratios, ratio, plus, pose, resolution, min_range, max_range, labels, world, kinds, keys, first):
    """Compute pixels of one row in float64: kinds, points in the team's frame and keys. The other outputs follow these.

    - ``z`` (n,) float64: depths [m], 0 without information; those of rays that are cut become depths at ``max_range``.
    - ``ratios`` (n,) float64: x / z of each pixel; ``ratio``: y / z of the row, ``plus`` = ``ratio`` squared + 1.
    - ``pose``, ``resolution``, ``min_range``, ``max_range``: as for depth_to_runs.
    - ``labels`` (n,) uint8: class ids.
    - ``world`` (3, >= ``first`` + n) float64: output from position ``first`` on, points [m].
    - ``kinds`` (n,) int32: output.
    - ``keys`` (3, >= ``first`` + n) int32: output from position ``first`` on.
    """
    least, most = min_range * min_range, max_range * max_range
    num_cut = 0
    for u in range(z.size):
        distance = z[u] * z[u] * (ratios[u] * ratios[u] + plus)
        kind = np.int32(labels[u]) if (z[u] > 0.0) & (distance >= least) else _NONE
        kinds[u] = _CUT if distance > most else kind
        num_cut += distance > most
    if num_cut > 0:
        for u in range(z.size):
            square = ratios[u] * ratios[u] + plus
            z[u] = max_range / np.sqrt(square) if kinds[u] == _CUT else z[u]
    # range(3) would be unrolled: three times as much code to compile, and no faster.
    for axis in range(pose.shape[0] - 1):
        along, down = pose[axis, 0], pose[axis, 1] * ratio
        ahead, shift = pose[axis, 2], pose[axis, 3]
        coords = world[axis, first : first + z.size]
        for u in range(z.size):
            coords[u] = z[u] * (along * ratios[u] + ahead + down) + shift
        _coords_to_keys(coords, resolution, keys[axis, first : first + z.size])


@inline_kernel
def _depths_of_row(values, depth_unit, largest, special, meanings, least, z):
    """Write the depths of the ``values`` (n,) of a depth image into ``z`` (n,) [m], 0 without information.

    ``z`` is of the type of ``depth_unit``, ``largest`` and ``least``, float32 or float64. Depths above 0 are at least
    ``least``; see depth_to_runs for the others.
    """
    for u in range(z.size):
        value = z.dtype.type(values[u])
        is_depth = (value > 0) & (value < np.inf) & (value != largest)
        z[u] = max(value * depth_unit, least) if is_depth else least - least
    for k in range(special.size):
        for u in range(z.size):
            is_special = (values[u] == special[k]) | ((values[u] != values[u]) & (special[k] != special[k]))
            z[u] = meanings[k] if is_special else z[u]


@allocating_kernel
def depth_to_points(depth_image, depth_unit, slopes, farthest, largest, special, meanings, points):
    """Compute the points of a depth image with lens distortion.

    depth_to_runs has its own path for pinhole images, which would take 10 % longer if it read slopes.

    - ``depth_image``, ``depth_unit``: as for depth_to_runs.
    - ``slopes`` (2, H, W) float32: x / z and y / z of each pixel.
    - ``farthest``: limit of the depths [m].
    - ``largest``, ``special``, ``meanings``: as for depth_to_runs.
    - ``points`` (H W, 3) float64: output, in the sensor's frame [m]; 0 without information.
    """
    height, width = depth_image.shape
    z = np.empty(width)
    for v in range(height):
        _depths_of_row(depth_image[v], depth_unit, largest, special, meanings, 0.0, z)
        for u in range(width):
            depth, place = min(z[u], farthest), v * width + u
            points[place, 0] = depth * slopes[0, v, u]
            points[place, 1] = depth * slopes[1, v, u]
            points[place, 2] = depth


@kernel
def points_to_runs(
    points, class_ids, pose, resolution, min_range, max_range, confidences, boxes, doubles, integers, keys, kinds,
    lengths, sums, ends, end_keys, counters,
):  # fmt: skip
    """Find the runs of a point cloud's end cells. Points that are not finite, or are 0, carry no information.

    Loop invariant: the outputs hold the runs and end points of the points before ``first``.

    - ``points`` (p, 3) float32 or float64: in the sensor's frame [m].
    - ``class_ids`` (p,) uint8.
    - ``pose``, ``resolution``, ``min_range``, ``max_range``: as for depth_to_runs.
    - ``confidences`` (p,) uint8: label confidences in 1 / 255; size 0 for full confidence.
    - ``boxes``, ``keys``, ``kinds``, ``lengths``, ``sums``, ``ends``, ``end_keys``, ``counters``: as for depth_to_runs.
    - ``doubles`` float64, ``integers`` int32, each (NUM_SCRATCH_ROWS, > BLOCK): scratch.
    """
    least, most = min_range * min_range, max_range * max_range
    sensor, squares, world = doubles[:3], doubles[3], doubles[4:7]
    block_keys, block_kinds = integers[:3], integers[3]
    for first in range(0, points.shape[0], BLOCK):
        size = min(BLOCK, points.shape[0] - first)
        # numba tests the index first + i for being negative, which keeps the loop from becoming vector instructions.
        block, labels = points[first : first + size], class_ids[first : first + size]
        num_cut = 0
        for i in range(size):
            x, y, z = np.float64(block[i, 0]), np.float64(block[i, 1]), np.float64(block[i, 2])
            distance = x * x + y * y + z * z
            valid = (distance > 0.0) & (distance < np.inf) & (distance >= least)
            kind = np.int32(labels[i]) if valid else _NONE
            is_cut = valid & (distance > most)
            sensor[0, i] = x if valid else 0.0
            sensor[1, i] = y if valid else 0.0
            sensor[2, i] = z if valid else 0.0
            squares[i] = distance
            block_kinds[i] = _CUT if is_cut else kind
            num_cut += is_cut
        if num_cut > 0:
            for i in range(size):
                scale = max_range / np.sqrt(squares[i]) if block_kinds[i] == _CUT else 1.0
                sensor[0, i] *= scale
                sensor[1, i] *= scale
                sensor[2, i] *= scale
        for axis in range(keys.shape[0]):
            along_x, along_y, along_z, shift = pose[axis, 0], pose[axis, 1], pose[axis, 2], pose[axis, 3]
            coords = world[axis, :size]
            for i in range(size):
                coords[i] = along_x * sensor[0, i] + along_y * sensor[1, i] + along_z * sensor[2, i] + shift
            _coords_to_keys(coords, resolution, block_keys[axis])
        if boxes.size + confidences.size > 0:
            _filter_points(world, size, first, confidences, boxes, block_kinds)
        _add_runs(
            world, block_kinds, size, block_keys, integers[4:], confidences, first, keys, kinds, lengths, sums, ends,
            end_keys, counters,
        )  # fmt: skip


@kernel
def _add_runs(
    world, point_kinds, size, point_keys, scratch, confidences, first, keys, kinds, lengths, sums, ends, end_keys,
    counters,
):  # fmt: skip
    """Append the runs of points to the outputs of depth_to_runs.

    - ``world`` (3, >= size) float64: points in the team's frame [m]; not used where ``ends`` is empty.
    - ``point_kinds`` (>= size,) int32: kinds of the points.
    - ``size``: number of points.
    - ``point_keys`` (3, >= size) int32: keys of the points.
    - ``scratch`` (>= 2, > size) int32.
    - ``confidences`` (p,) uint8: of the scan's points; size 0 for full confidence.
    - ``first``: position of the first point in the scan.
    - ``keys``, ``kinds``, ``lengths``, ``sums``, ``ends``, ``end_keys``, ``counters``: as for depth_to_runs.
    """
    starts, is_start = scratch[0], scratch[1]
    is_start[0] = 1
    x, y, z = point_keys[0], point_keys[1], point_keys[2]
    for i in range(1, size):
        is_start[i] = (
            (x[i] != x[i - 1]) | (y[i] != y[i - 1]) | (z[i] != z[i - 1]) | (point_kinds[i] != point_kinds[i - 1])
        )
    # numba tests signed indices for being negative.
    num_starts = np.uint64(0)
    for i in range(size):
        starts[num_starts] = i
        num_starts += np.uint64(is_start[i])
    starts[num_starts] = size
    place = np.uint64(counters[NUM_RUNS])
    for run in range(np.int64(num_starts)):
        start = np.uint64(starts[run])
        keys[0, place], keys[1, place], keys[2, place] = x[start], y[start], z[start]
        kinds[place] = np.uint8(point_kinds[start])
        lengths[place] = starts[run + 1] - starts[run]
        if confidences.size > 0:
            total = 0
            for i in range(starts[run], starts[run + 1]):
                total += confidences[first + i]
            sums[place] = total
        place += np.uint64(point_kinds[start] != _NONE)
    counters[NUM_RUNS] = place
    if ends.size > 0:
        place = np.uint64(counters[NUM_POINTS])
        for i in range(size):
            for axis in range(3):
                ends[place, axis] = world[axis, i]
                end_keys[place, axis] = point_keys[axis, i]
            place += np.uint64(point_kinds[i] != _NONE)
        counters[NUM_POINTS] = place


@kernel
def _filter_points(world, size, first, confidences, boxes, point_kinds):
    """Set the kinds of points with zero confidence or within boxes.

    - ``world`` (3, >= size) float64: points in the team's frame [m].
    - ``size``: number of points.
    - ``first``: position of the first point in the scan.
    - ``confidences``, ``boxes``: as for depth_to_runs.
    - ``point_kinds`` (>= size,) int32: in place.
    """
    for i in range(size if confidences.size > 0 else 0):
        is_measured = (point_kinds[i] != _NONE) & (point_kinds[i] != _CUT)
        has_zero_confidence = (confidences[first + i] == 0) & is_measured
        point_kinds[i] = _UNUSABLE if has_zero_confidence else point_kinds[i]
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


@inline_kernel
def _coords_to_keys(coords, resolution, keys):
    """Write floor(coords / resolution) into ``keys`` (n,) int32; multiplies where the floor is the same."""
    inverse = 1.0 / resolution
    num_close = 0
    for i in range(coords.size):
        quotient = min(max(coords[i] * inverse, -_FARTHEST_KEY), _FARTHEST_KEY)
        keys[i] = np.int32(np.floor(quotient))
        num_close += abs(quotient - np.rint(quotient)) < _CLOSE
    if num_close > 0:
        for i in range(coords.size):
            quotient = min(max(coords[i] / resolution, -_FARTHEST_KEY), _FARTHEST_KEY)
            keys[i] = np.int32(np.floor(quotient))


@kernel
def extend_bounds(keys, num_runs, low, high):
    """Extend the box from ``low`` to ``high`` (3,) int64, in place, by ``num_runs`` of the ``keys`` (3, m) int32."""
    for axis in range(keys.shape[0]):
        least, most = np.int32(low[axis]), np.int32(high[axis])
        for i in range(num_runs):
            least, most = min(least, keys[axis, i]), max(most, keys[axis, i])
        low[axis], high[axis] = least, most


@kernel
def mark_ends(
    keys, kinds, num_runs, corner, tables, num_classes, is_weighted, marks, places, end_places, end_keys,
):  # fmt: skip
    """Find the distinct cells of runs and mark each with its class; returns their number n and that of open cells.

    A cell stays *open*, with mark 1, where its runs differ in class or have none, or labels are weighted. The marks of
    the scratch grid serve as the table of cells: most runs continue a cell of the row of pixels above.

    - ``keys`` (3, >= m) int32, ``kinds`` (>= m,) uint8, ``num_runs``: m runs.
    - ``corner`` (3,) int64: key of the scratch grid's lowest cell.
    - ``tables`` uint32: as filled by casting.fill_tables.
    - ``num_classes``: C.
    - ``is_weighted``: True leaves every cell open.
    - ``marks`` uint8: of the scratch grid, in place from 0.
    - ``places`` (>= m,) uint32: output, place of each run's cell.
    - ``end_places`` (>= n,) uint32, ``end_keys`` (>= n, 3) int32: output, places and keys of the cells.
    """
    num_ends, num_open = np.uint64(0), 0
    low_x, low_y, low_z = np.int32(corner[0]), np.int32(corner[1]), np.int32(corner[2])
    for run in range(num_runs):
        x, y, z = keys[0, run], keys[1, run], keys[2, run]
        place = np.uint32(
            tables[0, np.uint32(x - low_x)] + tables[1, np.uint32(y - low_y)] + tables[2, np.uint32(z - low_z)]
        )
        places[run] = place
        has_class = (kinds[run] > 0) & (kinds[run] <= num_classes) & (not is_weighted)
        mark = np.uint8(kinds[run] + 1) if has_class else _OPEN
        old = marks[place]
        if (old == mark) | (old == _OPEN):
            continue
        if old == 0:
            end_places[num_ends] = place
            end_keys[num_ends, 0], end_keys[num_ends, 1], end_keys[num_ends, 2] = x, y, z
            num_ends += np.uint64(1)
        else:
            mark = _OPEN
        marks[place] = mark
        num_open += mark == _OPEN
    return np.int64(num_ends), num_open


@kernel
def settle_ends(
    places, kinds, lengths, weights, num_runs, num_classes, table, open_places, votes, sums, marks, strengths,
    end_places, end_marks,
):  # fmt: skip
    """Mark each open cell with the class that has the largest weight, after mark_ends; copy the marks of all end cells.

    Ties go to the lower class_id. The mark becomes 0 where no point has a class.

    - ``places`` (>= m,) uint32: as left by mark_ends.
    - ``kinds``, ``lengths``: as for mark_ends; number of points of each run.
    - ``num_runs``: m; 0 where no cell is open.
    - ``weights`` (>= m,) int32: weight of each run, the sum over its points.
    - ``num_classes``: C.
    - ``table`` int32: hash table of -1, its size a power of two above that of ``open_places``; overwritten.
    - ``open_places`` (n,) uint32: output, places of the n open cells.
    - ``votes`` (n, C) int32, ``sums`` (n, C) int64: output from 0, points and weights by cell and class.
    - ``marks`` uint8: in place.
    - ``strengths`` uint8: output, mean weight of the class's points, rounded half up, parallel to the marks; size 0 for
      none.
    - ``end_places`` (k,) uint32: as left by mark_ends.
    - ``end_marks`` (k,) uint8: output, marks of the end cells.
    """
    mask, num_open = np.uint64(table.size - 1), 0
    for run in range(num_runs):
        place = places[run]
        if marks[place] != _OPEN:
            continue
        entry = (np.uint64(place) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(40) & mask
        while table[entry] >= 0 and open_places[table[entry]] != place:
            entry = (entry + np.uint64(1)) & mask
        slot = np.int64(table[entry])
        if slot < 0:
            slot = num_open
            table[entry], open_places[slot] = slot, place
            num_open += 1
        if 0 < kinds[run] <= num_classes:
            votes[slot, kinds[run] - 1] += lengths[run]
            sums[slot, kinds[run] - 1] += weights[run]
    for slot in range(num_open):
        best, most = -1, 0
        for c in range(num_classes):
            if sums[slot, c] > most:
                best, most = c, sums[slot, c]
        marks[open_places[slot]] = np.uint8(best + 2) if best >= 0 else np.uint8(0)
        if strengths.size > 0 and best >= 0:
            num_points = np.int64(votes[slot, best])
            strengths[open_places[slot]] = np.uint8((2 * most + num_points) // (2 * num_points))
    for i in range(end_marks.size):
        end_marks[i] = marks[end_places[i]]
