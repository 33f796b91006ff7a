"""Which cells a scan touches, and what it adds to them."""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel
from octoreplay.mapping.kernels.storage import (
    BRICK_BITS,
    BRICK_CELLS,
    BRICK_EDGE,
    KEY_OFFSET,
    SCALAR,
    UNIFORM,
    all_known,
    collapse,
    make_scalar,
    make_vector,
    spread_bits,
)

CUT = 255
"""Kind of a ray that was cut at max_range, above every class_id; other kinds are class ids, 0 for an ignored label."""


@inline_kernel
def _in_list(value, numbers):
    """True when ``value`` is one of ``numbers``; NaN equals NaN."""
    found = False
    for i in range(numbers.size):
        if value == numbers[i] or (value != value and numbers[i] != numbers[i]):
            found = True
    return found


@kernel
def depth_to_ends(
    depth_image, depth_unit, class_image, camera, pose, resolution, min_range, max_range, largest, invalid, no_return,
    keys, kinds, ends,
):  # fmt: skip
    """End cells of a depth image's rays: keys (n, 3) and kinds (n,) for the n rays that carry information.

    ``camera`` is (fx, fy, cx, cy), ``pose`` (4, 4); a class_image of size 0 means that every point is class 1;
    ``ends`` (n, 3), where it is not empty, gets the rays' end points [m]. Returns n, or -1 when a key is out of range.
    """
    height, width = depth_image.shape
    labelled = class_image.size > 0
    count = 0
    ratios = np.empty(width)
    for u in range(width):
        ratios[u] = (u - camera[2]) / camera[0]
    for v in range(height):
        y_ratio = (v - camera[3]) / camera[1]
        for u in range(width):
            raw = depth_image[v, u]
            kind = np.uint8(1)
            if no_return.size > 0 and _in_list(raw, no_return):
                z = 1.0
                distance = np.inf
            else:
                z = raw * depth_unit
                if not (z > 0.0 and z < np.inf) or raw == largest or (invalid.size > 0 and _in_list(raw, invalid)):
                    continue
                distance = z * np.sqrt(ratios[u] * ratios[u] + y_ratio * y_ratio + 1.0)
                if distance < min_range:
                    continue
                if labelled:
                    kind = class_image[v, u]
            if distance > max_range:
                z = max_range / np.sqrt(ratios[u] * ratios[u] + y_ratio * y_ratio + 1.0)
                kind = np.uint8(CUT)
            x = ratios[u] * z
            y = y_ratio * z
            if not _store_end(x, y, z, kind, pose, resolution, keys, kinds, ends, count):
                return -1
            count += 1
    return count


@kernel
def _store_end(x, y, z, kind, pose, resolution, keys, kinds, ends, place):
    """Write one ray's end, given in the sensor's frame; False when its key is outside the key space."""
    wx = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
    wy = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
    wz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
    kx, ky, kz = np.floor(wx / resolution), np.floor(wy / resolution), np.floor(wz / resolution)
    if not (abs(kx) < KEY_OFFSET and abs(ky) < KEY_OFFSET and abs(kz) < KEY_OFFSET):
        return False
    keys[place, 0] = np.int32(kx)
    keys[place, 1] = np.int32(ky)
    keys[place, 2] = np.int32(kz)
    kinds[place] = kind
    if ends.size > 0:
        ends[place, 0] = wx
        ends[place, 1] = wy
        ends[place, 2] = wz
    return True


@kernel
def points_to_ends(points, class_ids, pose, resolution, min_range, max_range, keys, kinds, ends):
    """End cells of a point cloud's rays; as depth_to_ends, for points (p, 3) in the sensor's frame."""
    labelled = class_ids.size > 0
    count = 0
    for i in range(points.shape[0]):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        distance = np.sqrt(x * x + y * y + z * z)
        if not (distance > 0.0 and distance < np.inf) or distance < min_range:
            continue
        kind = class_ids[i] if labelled else np.uint8(1)
        if distance > max_range:
            scale = max_range / distance
            x, y, z = x * scale, y * scale, z * scale
            kind = np.uint8(CUT)
        if not _store_end(x, y, z, kind, pose, resolution, keys, kinds, ends, count):
            return -1
        count += 1
    return count


@kernel
def widen_to_keys(keys, low, high):
    """Widen the box from ``low`` (3,) to ``high`` (3,) so that it holds all keys (n, 3)."""
    for i in range(keys.shape[0]):
        for axis in range(3):
            low[axis] = min(low[axis], keys[i, axis])
            high[axis] = max(high[axis], keys[i, axis])


@kernel
def fill_axis_tables(num_bricks, offsets):
    """Offset of each local coordinate in the scratch grid, per axis (3, m): their sum over the axes is the cell.

    The grid holds ``num_bricks`` (3,) whole bricks, x fastest, each in Morton order.
    """
    stride = BRICK_CELLS
    for axis in range(3):
        for i in range(num_bricks[axis] * BRICK_EDGE):
            offsets[axis, i] = (i >> BRICK_BITS) * stride + (spread_bits(i & 7) << axis)
        stride *= num_bricks[axis]


@kernel
def _mark(marks, cell, value, touched_flags, touched, count):
    """Write a mark and list its brick; returns the number of listed bricks."""
    marks[cell] = value
    brick = cell >> 9
    if touched_flags[brick] == 0:
        touched_flags[brick] = 1
        touched[count] = brick
        return count + 1
    return count


@kernel
def mark_ends(keys, kinds, num_classes, corner, offsets, mapped, slots, votes, rays, marks, touched_flags, touched):
    """Find the distinct end cells and mark the hit ones with 1 + the class that most points in them have.

    ``offsets`` (3, m) are the axis tables of the scratch grid with lowest cell ``corner`` (3,); in ``mapped``,
    coordinates outside the mapped region make every sum negative. ``slots`` (a grid) and ``votes`` (n, C) are zeroed
    and left so; ``rays`` (n,) gets one input index for each distinct end cell. Returns the number of distinct end
    cells and of touched bricks.
    """
    num_rays = 0
    num_touched = 0
    last_cell = np.int64(-1)
    slot = np.int64(0)
    for i in range(keys.shape[0]):
        cell = (
            offsets[0, keys[i, 0] - corner[0]] + offsets[1, keys[i, 1] - corner[1]] + offsets[2, keys[i, 2] - corner[2]]
        )
        if cell != last_cell:
            last_cell = cell
            slot = np.int64(slots[cell]) - 1
            if slot < 0:
                slot = num_rays
                slots[cell] = slot + 1
                rays[slot] = i
                num_rays += 1
        if 0 < kinds[i] <= num_classes:
            votes[slot, kinds[i] - 1] += 1
    for slot in range(num_rays):
        x, y, z = keys[rays[slot], 0] - corner[0], keys[rays[slot], 1] - corner[1], keys[rays[slot], 2] - corner[2]
        slots[offsets[0, x] + offsets[1, y] + offsets[2, z]] = 0
        best, most = -1, 0
        for c in range(num_classes):
            if votes[slot, c] > most:
                best, most = c, votes[slot, c]
            votes[slot, c] = 0
        cell = mapped[0, x] + mapped[1, y] + mapped[2, z]
        if best >= 0 and cell >= 0:
            num_touched = _mark(marks, cell, np.uint8(best + 2), touched_flags, touched, num_touched)
    return num_rays, num_touched


@kernel
def mark_free(origin, ends, end_keys, resolution, corner, mapped, marks, touched_flags, touched, num_touched):
    """Mark with 1 every unmarked cell that a ray passes before its end cell (Amanatides and Woo 1987).

    All rays start at ``origin`` (3,) and go to ``ends`` (n, 3) in the cells ``end_keys`` (n, 3). The walk takes exactly
    as many steps along each axis as the keys differ, so that it always arrives; where two borders are met at once, z
    goes before y and y before x, as in OctoMap. Returns the number of touched bricks.
    """
    start_x = np.int64(np.floor(origin[0] / resolution)) - corner[0]
    start_y = np.int64(np.floor(origin[1] / resolution)) - corner[1]
    start_z = np.int64(np.floor(origin[2] / resolution)) - corner[2]
    origin_cell = mapped[0, start_x] + mapped[1, start_y] + mapped[2, start_z]
    for i in range(ends.shape[0]):
        x, y, z = start_x, start_y, start_z
        left_x = end_keys[i, 0] - corner[0] - x
        left_y = end_keys[i, 1] - corner[1] - y
        left_z = end_keys[i, 2] - corner[2] - z
        dx, dy, dz = ends[i, 0] - origin[0], ends[i, 1] - origin[1], ends[i, 2] - origin[2]
        step_x = 1 if left_x > 0 else -1
        step_y = 1 if left_y > 0 else -1
        step_z = 1 if left_z > 0 else -1
        left_x, left_y, left_z = abs(left_x), abs(left_y), abs(left_z)
        next_x = next_y = next_z = np.inf
        # The wall ahead of local cell k is at (k + ahead) x resolution; crossings are not summed up, so nothing drifts.
        ahead_x, ahead_y, ahead_z = corner[0] + (step_x > 0), corner[1] + (step_y > 0), corner[2] + (step_z > 0)
        if left_x > 0:
            next_x = ((x + ahead_x) * resolution - origin[0]) / dx
        if left_y > 0:
            next_y = ((y + ahead_y) * resolution - origin[1]) / dy
        if left_z > 0:
            next_z = ((z + ahead_z) * resolution - origin[2]) / dz
        part_x, part_y, part_z = mapped[0, x], mapped[1, y], mapped[2, z]
        if left_x + left_y + left_z > 0 and origin_cell >= 0 and marks[origin_cell] == 0:
            num_touched = _mark(marks, origin_cell, np.uint8(1), touched_flags, touched, num_touched)
        for _ in range(left_x + left_y + left_z - 1):
            if next_x < next_y and next_x < next_z:
                x += step_x
                left_x -= 1
                next_x = ((x + ahead_x) * resolution - origin[0]) / dx if left_x > 0 else np.inf
                part_x = mapped[0, x]
            elif next_y < next_z and not next_x < next_y:
                y += step_y
                left_y -= 1
                next_y = ((y + ahead_y) * resolution - origin[1]) / dy if left_y > 0 else np.inf
                part_y = mapped[1, y]
            else:
                z += step_z
                left_z -= 1
                next_z = ((z + ahead_z) * resolution - origin[2]) / dz if left_z > 0 else np.inf
                part_z = mapped[2, z]
            cell = part_x + part_y + part_z
            if cell >= 0 and marks[cell] == 0:
                num_touched = _mark(marks, cell, np.uint8(1), touched_flags, touched, num_touched)
    return num_touched


@kernel
def count_hit_bricks(marks, touched, num_touched):
    """Number of touched bricks with at least one hit cell."""
    total = 0
    for t in range(num_touched):
        for i in range(BRICK_CELLS):
            if marks[touched[t] * BRICK_CELLS + i] > 1:
                total += 1
                break
    return total


@kernel
def touched_codes(touched, low_brick, num_bricks, codes):
    """Brick codes (n,) of the touched bricks (n,) of the scratch grid."""
    offset = KEY_OFFSET >> BRICK_BITS
    for t in range(touched.size):
        x = touched[t] % num_bricks[0]
        y = (touched[t] // num_bricks[0]) % num_bricks[1]
        z = touched[t] // (num_bricks[0] * num_bricks[1])
        codes[t] = (
            spread_bits(x + low_brick[0] + offset)
            | spread_bits(y + low_brick[1] + offset) << 1
            | spread_bits(z + low_brick[2] + offset) << 2
        )


@kernel
def apply_marks(bricks, indices, touched, marks, hit, miss, hit_other, clamp_min, clamp_max, revision):
    """Add one scan's log-odds to the bricks ``indices`` (n,) whose marks are the scratch bricks ``touched`` (n,).

    A free cell gets ``miss`` in all classes, a hit cell ``hit`` in its class and ``hit_other`` in the others; the sums
    are clamped. Room for the rows that may be needed must be there.
    """
    num_classes = bricks.vector.shape[1]
    for t in range(indices.size):
        index = indices[t]
        cells = marks[touched[t] * BRICK_CELLS : (touched[t] + 1) * BRICK_CELLS]
        hits = 0
        for i in range(BRICK_CELLS):
            hits += cells[i] > 1
        if bricks.tiers[index] == UNIFORM and hits == 0:
            value = bricks.values[index]
            if min(max(value + miss, clamp_min), clamp_max) == value and all_known(bricks.known[index]):
                continue
        bricks.revisions[index] = revision
        for byte in range(64):
            bits = np.uint8(0)
            for j in range(8):
                if cells[byte * 8 + j] > 0:
                    bits |= np.uint8(1 << j)
            bricks.known[index, byte] |= bits
        if hits > 0 and num_classes > 1:
            make_vector(bricks, index)
        else:
            make_scalar(bricks, index)
        if bricks.tiers[index] == SCALAR:
            data = bricks.scalar[bricks.rows[index]]
            for i in range(BRICK_CELLS):
                step = hit if cells[i] > 1 else miss
                changed = min(max(data[i] + step, clamp_min), clamp_max)
                data[i] = changed if cells[i] > 0 else data[i]
            collapse(bricks, index)
            continue
        for c in range(num_classes):
            row = bricks.vector[bricks.rows[index], c]
            for i in range(BRICK_CELLS):
                mark = cells[i]
                step = miss if mark == 1 else (hit if mark == c + 2 else hit_other)
                changed = min(max(row[i] + step, clamp_min), clamp_max)
                row[i] = changed if mark > 0 else row[i]


@kernel
def clear_marks(marks, touched_flags, touched):
    """Zero the scratch grid again, touched bricks only."""
    for t in range(touched.size):
        marks[touched[t] * BRICK_CELLS : (touched[t] + 1) * BRICK_CELLS] = 0
        touched_flags[touched[t]] = 0
