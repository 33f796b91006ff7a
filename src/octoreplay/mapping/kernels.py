"""The compiled loops of the map: plain arrays in, plain arrays out; the wrappers check and coerce, the kernels trust.

A *brick* is a cube of 8 x 8 x 8 finest cells, stored in Morton order (bit 0 of the index is x, bit 1 y, bit 2 z).
Its tier says how much is stored: UNIFORM one value for all its cells and classes, SCALAR one value per cell (equal over
the classes: no cell was ever hit), VECTOR one value per class and cell. The functions that call each other share this
file because numba's cache does not see changes in other files.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import carray, njit, types
from numba.extending import intrinsic

from octoreplay.records import Float32Array, Int32Array, Int64Array, UInt8Array

UNIFORM, SCALAR, VECTOR = 0, 1, 2
ABSENT = 255

BRICK_BITS = 3
BRICK_EDGE = 8
BRICK_CELLS = 512
KEY_BITS = 19
"""A key's three coordinates lie in [-2^18, 2^18)."""
KEY_OFFSET = 1 << (KEY_BITS - 1)
BRICK_DEPTH = KEY_BITS - BRICK_BITS
"""Depth of a brick's cube in the octree; the root is depth 0, the finest cells are at depth KEY_BITS."""

NUM_BRICKS, NUM_SCALAR, NUM_VECTOR, NUM_FREE_SCALAR = 0, 1, 2, 3

CHILD_UNKNOWN, CHILD_INNER, CHILD_SCALAR, CHILD_VECTOR = 0, 1, 2, 3

CUT = 255
"""Kind of a ray that was cut at max_range, above every class_id; other kinds are class ids, 0 for an ignored label."""

GRADIENT, NATURAL, BAYES, LOCAL = 0, 1, 2, 3

logger = logging.getLogger(__name__)


class Bricks(NamedTuple):
    """The arrays of one octree. ``counters`` holds NUM_BRICKS, NUM_SCALAR, NUM_VECTOR and NUM_FREE_SCALAR."""

    codes: Int64Array
    tiers: UInt8Array
    rows: Int32Array
    values: Float32Array
    known: UInt8Array
    revisions: Int64Array
    table: Int32Array
    counters: Int64Array
    free_scalar: Int32Array
    scalar: Float32Array
    vector: Float32Array


def _compile(function: Callable[..., Any], **options: Any) -> Any:
    """numba.njit with the on-disk cache where a cache folder can be written, without it elsewhere.

    No fast-math: reordered sums come out differently when callees are linked from the cache instead of inlined, and
    the same input must give the same bytes. Loops over a brick run as vectors when they sum element by element.
    """
    settings = {"nogil": True, "error_model": "numpy", **options}
    try:
        return njit(cache=True, **settings)(function)
    except RuntimeError:
        logger.warning("no folder for compiled kernels can be written; they are compiled anew in every run")
        return njit(**settings)(function)


def kernel(function: Callable[..., Any]) -> Any:
    """Compile for plain arrays."""
    return _compile(function)


def inline_kernel(function: Callable[..., Any]) -> Any:
    """Compile for use inside other kernels."""
    return _compile(function, inline="always")


@intrinsic
# The parameters' names and number are numba's.
def _float_pointer(typing_context: Any, address: Any) -> Any:  # noqa: ARG001
    """The float32 pointer of an integer address."""
    pointer = types.CPointer(types.float32)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001
        return builder.inttoptr(arguments[0], context.get_value_type(pointer))

    return pointer(types.int64), generate


# --- Morton codes ----------------------------------------------------------------------------------------------------


@kernel
def spread_bits(value):
    """Bits 0..20 of ``value`` moved to every third bit."""
    x = np.int64(value) & 0x1FFFFF
    x = (x | x << 32) & 0x1F00000000FFFF
    x = (x | x << 16) & 0x1F0000FF0000FF
    x = (x | x << 8) & 0x100F00F00F00F00F
    x = (x | x << 4) & 0x10C30C30C30C30C3
    return (x | x << 2) & 0x1249249249249249


@kernel
def gather_bits(code):
    """Every third bit of ``code``, starting at bit 0: the inverse of spread_bits."""
    x = np.int64(code) & 0x1249249249249249
    x = (x | x >> 2) & 0x10C30C30C30C30C3
    x = (x | x >> 4) & 0x100F00F00F00F00F
    x = (x | x >> 8) & 0x1F0000FF0000FF
    x = (x | x >> 16) & 0x1F00000000FFFF
    return (x | x >> 32) & 0x1FFFFF


@kernel
def key_to_code(x, y, z):
    """Morton code of a finest cell's key; the key space's lowest corner has code 0."""
    return spread_bits(x + KEY_OFFSET) | spread_bits(y + KEY_OFFSET) << 1 | spread_bits(z + KEY_OFFSET) << 2


@kernel
def keys_to_codes(keys, codes):
    """Morton codes (n,) of the cells with these keys (n, 3)."""
    for i in range(codes.size):
        codes[i] = key_to_code(keys[i, 0], keys[i, 1], keys[i, 2])


@kernel
def codes_to_keys(codes, keys):
    """Keys (n, 3) of the cells with these Morton codes (n,)."""
    for i in range(codes.size):
        keys[i, 0] = gather_bits(codes[i]) - KEY_OFFSET
        keys[i, 1] = gather_bits(codes[i] >> 1) - KEY_OFFSET
        keys[i, 2] = gather_bits(codes[i] >> 2) - KEY_OFFSET


# --- brick storage ---------------------------------------------------------------------------------------------------


@kernel
def _slot(table, code):
    """First place in the hash table where ``code`` may stand (Fibonacci hashing)."""
    return np.int64((np.uint64(code) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(20)) & (table.size - 1)


@kernel
def find_brick(bricks, code):
    """Index of the brick with this code, or -1."""
    place = _slot(bricks.table, code)
    while True:
        index = bricks.table[place]
        if index < 0 or bricks.codes[index] == code:
            return index
        place = (place + 1) & (bricks.table.size - 1)


@kernel
def _enter(bricks, index):
    """Put brick ``index`` into the hash table."""
    place = _slot(bricks.table, bricks.codes[index])
    while bricks.table[place] >= 0:
        place = (place + 1) & (bricks.table.size - 1)
    bricks.table[place] = index


@kernel
def rebuild_table(bricks):
    """Fill an empty hash table with all bricks."""
    for index in range(bricks.counters[NUM_BRICKS]):
        _enter(bricks, index)


@kernel
def add_brick(bricks, code):
    """A new brick, all of it unknown: a UNIFORM brick of value 0 without a known cell."""
    index = bricks.counters[NUM_BRICKS]
    bricks.counters[NUM_BRICKS] = index + 1
    bricks.codes[index] = code
    bricks.tiers[index] = UNIFORM
    bricks.rows[index] = -1
    bricks.values[index] = 0.0
    bricks.revisions[index] = 0
    bricks.known[index, :] = 0
    _enter(bricks, index)
    return index


@kernel
def find_or_add(bricks, codes, indices):
    """Index (n,) of each brick code (n,), added where it is new. Room for n bricks must be there."""
    for i in range(codes.size):
        index = find_brick(bricks, codes[i])
        if index < 0:
            index = add_brick(bricks, codes[i])
        indices[i] = index


@kernel
def find_all(bricks, codes, indices):
    """Index (n,) of each brick code (n,), -1 where it is absent."""
    for i in range(codes.size):
        indices[i] = find_brick(bricks, codes[i])


@kernel
def _make_scalar(bricks, index):
    """Raise a UNIFORM brick to SCALAR. Room for one row must be there."""
    if bricks.tiers[index] != UNIFORM:
        return
    free = bricks.counters[NUM_FREE_SCALAR]
    if free > 0:
        row = np.int64(bricks.free_scalar[free - 1])
        bricks.counters[NUM_FREE_SCALAR] = free - 1
    else:
        row = bricks.counters[NUM_SCALAR]
        bricks.counters[NUM_SCALAR] = row + 1
    bricks.scalar[row, :] = bricks.values[index]
    bricks.tiers[index] = SCALAR
    bricks.rows[index] = row


@kernel
def _release_scalar(bricks, index):
    """Give a SCALAR brick's row back."""
    free = bricks.counters[NUM_FREE_SCALAR]
    bricks.free_scalar[free] = bricks.rows[index]
    bricks.counters[NUM_FREE_SCALAR] = free + 1


@kernel
def _make_vector(bricks, index):
    """Raise a brick to VECTOR. Room for one row must be there."""
    if bricks.tiers[index] == VECTOR:
        return
    row = bricks.counters[NUM_VECTOR]
    bricks.counters[NUM_VECTOR] = row + 1
    if bricks.tiers[index] == UNIFORM:
        bricks.vector[row, :, :] = bricks.values[index]
    else:
        source = bricks.scalar[bricks.rows[index]]
        for c in range(bricks.vector.shape[1]):
            bricks.vector[row, c, :] = source
        _release_scalar(bricks, index)
    bricks.tiers[index] = VECTOR
    bricks.rows[index] = row


@kernel
def make_tiers(bricks, tiers):
    """Raise each brick (n,) to at least the tier (n,) that is asked for. Room must be there."""
    for index in range(tiers.size):
        if tiers[index] == VECTOR:
            _make_vector(bricks, index)
        elif tiers[index] == SCALAR:
            _make_scalar(bricks, index)


@kernel
def _all_known(known):
    """True when all 512 cells of a brick are known."""
    missing = 0
    for byte in range(64):
        missing += known[byte] != 255
    return missing == 0


@kernel
def _collapse(bricks, index):
    """Make a SCALAR brick UNIFORM when all its cells are known and equal: the in-memory prune."""
    if bricks.tiers[index] != SCALAR or not _all_known(bricks.known[index]):
        return
    data = bricks.scalar[bricks.rows[index]]
    first = data[0]
    different = 0
    for i in range(BRICK_CELLS):
        different += data[i] != first
    if different == 0:
        _release_scalar(bricks, index)
        bricks.tiers[index] = UNIFORM
        bricks.rows[index] = -1
        bricks.values[index] = first


@kernel
def copy_bricks(source, indices, target, target_indices):
    """Copy the bricks ``indices`` (n,) of one octree over ``target_indices`` (n,) of another, raised beforehand."""
    for i in range(indices.size):
        a, b = indices[i], target_indices[i]
        tier = source.tiers[a]
        target.known[b, :] = source.known[a]
        if target.tiers[b] == UNIFORM:
            target.values[b] = source.values[a]
        elif target.tiers[b] == SCALAR:
            if tier == UNIFORM:
                target.scalar[target.rows[b], :] = source.values[a]
            else:
                target.scalar[target.rows[b], :] = source.scalar[source.rows[a]]
            _collapse(target, b)
        elif tier == VECTOR:
            target.vector[target.rows[b], :, :] = source.vector[source.rows[a]]
        else:
            for c in range(target.vector.shape[1]):
                if tier == UNIFORM:
                    target.vector[target.rows[b], c, :] = source.values[a]
                else:
                    target.vector[target.rows[b], c, :] = source.scalar[source.rows[a]]


@kernel
def brick_addresses(bricks, indices, scalar_base, vector_base, values_base, addresses, tiers):
    """Where the data of the bricks ``indices`` (n,) lies in memory and their tier; 0 and ABSENT for index -1."""
    vector_bytes = bricks.vector.shape[1] * BRICK_CELLS * 4
    for i in range(indices.size):
        index = indices[i]
        if index < 0:
            addresses[i] = 0
            tiers[i] = ABSENT
            continue
        tier = bricks.tiers[index]
        tiers[i] = tier
        if tier == UNIFORM:
            addresses[i] = values_base + index * 4
        elif tier == SCALAR:
            addresses[i] = scalar_base + np.int64(bricks.rows[index]) * BRICK_CELLS * 4
        else:
            addresses[i] = vector_base + np.int64(bricks.rows[index]) * vector_bytes


@kernel
def count_known(known):
    """Number of known cells in bricks with these masks (n, 64)."""
    total = 0
    for i in range(known.shape[0]):
        for byte in range(64):
            bits = np.int64(known[i, byte])
            bits = bits - ((bits >> 1) & 0x55)
            bits = (bits & 0x33) + ((bits >> 2) & 0x33)
            total += (bits + (bits >> 4)) & 0x0F
    return total


@kernel
def merge_known(known, indices, other_known):
    """known[indices] |= other_known; returns a flag (n,) where that changed anything."""
    changed = np.zeros(indices.size, dtype=np.bool_)
    for i in range(indices.size):
        for byte in range(64):
            old = known[indices[i], byte]
            new = old | other_known[i, byte]
            if new != old:
                known[indices[i], byte] = new
                changed[i] = True
    return changed


# --- scans -----------------------------------------------------------------------------------------------------------


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
            if min(max(value + miss, clamp_min), clamp_max) == value and _all_known(bricks.known[index]):
                continue
        bricks.revisions[index] = revision
        for byte in range(64):
            bits = np.uint8(0)
            for j in range(8):
                if cells[byte * 8 + j] > 0:
                    bits |= np.uint8(1 << j)
            bricks.known[index, byte] |= bits
        if hits > 0 and num_classes > 1:
            _make_vector(bricks, index)
        else:
            _make_scalar(bricks, index)
        if bricks.tiers[index] == SCALAR:
            data = bricks.scalar[bricks.rows[index]]
            for i in range(BRICK_CELLS):
                step = hit if cells[i] > 1 else miss
                changed = min(max(data[i] + step, clamp_min), clamp_max)
                data[i] = changed if cells[i] > 0 else data[i]
            _collapse(bricks, index)
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


# --- consensus -------------------------------------------------------------------------------------------------------


@kernel
def _exp_negative(x, out, powers, scales):
    """Exp of ``x`` (512,), all at most 0, into ``out``: 2^n times a polynomial (Cephes' expf, Moshier 1992).

    ``powers`` (512,) int32 and ``scales``, the same memory seen as float32, are scratch.
    """
    for i in range(x.size):
        value = max(x[i], np.float32(-87.0))
        n = np.floor(value * np.float32(1.44269504088896341) + np.float32(0.5))
        f = value - n * np.float32(0.693359375) + n * np.float32(2.12194440e-4)
        p = np.float32(1.9875691500e-4)
        p = p * f + np.float32(1.3981999507e-3)
        p = p * f + np.float32(8.3334519073e-3)
        p = p * f + np.float32(4.1665795894e-2)
        p = p * f + np.float32(1.6666665459e-1)
        p = p * f + np.float32(5.0000001201e-1)
        out[i] = p * f * f + f + np.float32(1.0)
        powers[i] = (np.int32(n) + np.int32(127)) << np.int32(23)
    for i in range(x.size):
        out[i] *= scales[i]


@inline_kernel
def _add_scaled(target, address, tier, c, factor, num_classes):
    """Target (512,) += factor x class c of the brick at ``address``."""
    if tier == UNIFORM:
        value = carray(_float_pointer(address), (1,))[0] * factor
        for i in range(target.size):
            target[i] += value
    elif tier == SCALAR:
        data = carray(_float_pointer(address), (BRICK_CELLS,))
        for i in range(target.size):
            target[i] += data[i] * factor
    elif tier == VECTOR:
        rows = carray(_float_pointer(address), (num_classes, BRICK_CELLS))
        for i in range(target.size):
            target[i] += rows[c, i] * factor


@inline_kernel
def _load(target, address, tier, c, num_classes):
    """Target (512,) = class c of the brick at ``address``, 0 where there is none."""
    target[:] = np.float32(0.0)
    _add_scaled(target, address, tier, c, np.float32(1.0), num_classes)


@inline_kernel
def _load_evidence(target, addresses, tiers, column, count_column, scale, c, counts, num_classes):
    """Target (512,) = class c of log q: the evidence times ``scale``, or divided by the cells' scan counts."""
    _load(target, addresses[column], tiers[column], c, num_classes)
    if count_column >= 0:
        _load(counts, addresses[count_column], tiers[count_column], 0, 1)
        for i in range(target.size):
            target[i] /= max(counts[i], np.float32(1.0))
    elif scale != np.float32(1.0):
        for i in range(target.size):
            target[i] *= scale


OWN, BASE, EVIDENCE, OLD_EVIDENCE, NEIGHBOURS = 0, 1, 2, 3, 4
"""Columns of the address table of a consensus step: the robot's own map, the map that it published (the base of the
differences), its evidence log q, its evidence at the last iteration, then the neighbours' maps."""


@kernel
def consensus_step(addresses, tiers, weights, rule, gamma, num_classes, changes):
    """One iteration of a rule at one robot, brick by brick, in place in the robot's own map (column OWN).

    ``addresses`` and ``tiers`` (n, NEIGHBOURS + J) say where each brick lies; the own brick has at least the tier of
    all others. ``weights`` (J,) float32 are 2 epsilon A_ij. ``changes`` (n,) gets each brick's largest change.
    All classes of a brick that is not VECTOR are equal; the sums over classes then are ``num_classes`` times one term.
    """
    num_neighbours = weights.size
    mixed = np.empty((num_classes, BRICK_CELLS), dtype=np.float32)
    delta = np.empty((num_classes, BRICK_CELLS), dtype=np.float32)
    sigma = np.empty((num_classes, BRICK_CELLS), dtype=np.float32)
    base = np.empty(BRICK_CELLS, dtype=np.float32)
    other = np.empty(BRICK_CELLS, dtype=np.float32)
    top = np.empty(BRICK_CELLS, dtype=np.float32)
    total = np.empty(BRICK_CELLS, dtype=np.float32)
    dot = np.empty(BRICK_CELLS, dtype=np.float32)
    moved = np.empty(BRICK_CELLS, dtype=np.float32)
    powers = np.empty(BRICK_CELLS, dtype=np.int32)
    scales = powers.view(np.float32)
    for b in range(addresses.shape[0]):
        tier = tiers[b, OWN]
        width = num_classes if tier == VECTOR else 1
        terms = np.float32(1.0) if tier == VECTOR else np.float32(num_classes)
        cells = 1 if tier == UNIFORM else BRICK_CELLS
        top[:] = np.float32(0.0)
        for c in range(width):
            row = mixed[c, :cells]
            _load(row, addresses[b, OWN], tier, c, num_classes)
            _load(base[:cells], addresses[b, BASE], tiers[b, BASE], c, num_classes)
            other[:cells] = np.float32(0.0)
            for j in range(num_neighbours):
                if tiers[b, NEIGHBOURS + j] == ABSENT:
                    for i in range(cells):
                        other[i] -= base[i] * weights[j]
                else:
                    _load(total[:cells], addresses[b, NEIGHBOURS + j], tiers[b, NEIGHBOURS + j], c, num_classes)
                    for i in range(cells):
                        other[i] += (total[i] - base[i]) * weights[j]
            for i in range(cells):
                row[i] += other[i]
                top[i] = max(top[i], row[i])
            if rule == BAYES:
                _add_scaled(row, addresses[b, EVIDENCE], tiers[b, EVIDENCE], c, np.float32(1.0), num_classes)
                _add_scaled(row, addresses[b, OLD_EVIDENCE], tiers[b, OLD_EVIDENCE], c, np.float32(-1.0), num_classes)
            elif rule == LOCAL:
                _load(row, addresses[b, EVIDENCE], tiers[b, EVIDENCE], c, num_classes)
            else:
                _load(other[:cells], addresses[b, EVIDENCE], tiers[b, EVIDENCE], c, num_classes)
                for i in range(cells):
                    delta[c, i] = row[i] - other[i]
        if rule == NATURAL:
            for c in range(width):
                for i in range(cells):
                    mixed[c, i] -= gamma * delta[c, i]
        elif rule == GRADIENT and gamma != np.float32(0.0):
            for i in range(cells):
                base[i] = -top[i]
            _exp_negative(base[:cells], total[:cells], powers[:cells], scales[:cells])
            dot[:] = np.float32(0.0)
            for c in range(width):
                for i in range(cells):
                    base[i] = mixed[c, i] - top[i]
                _exp_negative(base[:cells], sigma[c, :cells], powers[:cells], scales[:cells])
                for i in range(cells):
                    total[i] += terms * sigma[c, i]
                    dot[i] += terms * sigma[c, i] * delta[c, i]
            for i in range(cells):
                total[i] = np.float32(1.0) / total[i]
                dot[i] *= total[i]
            for c in range(width):
                for i in range(cells):
                    mixed[c, i] += gamma * (sigma[c, i] * total[i]) * (dot[i] - delta[c, i])
        moved[:cells] = np.float32(0.0)
        for c in range(width):
            target = carray(_float_pointer(addresses[b, OWN] + c * BRICK_CELLS * 4), (cells,))
            for i in range(cells):
                moved[i] = max(moved[i], abs(mixed[c, i] - target[i]))
                target[i] = mixed[c, i]
        largest = np.float32(0.0)
        for i in range(cells):
            largest = max(largest, moved[i])
        changes[b] = largest


@kernel
def finish_step(bricks, changes, known_changed, revision):
    """Set the revision of every brick that changed and prune those that became uniform."""
    for index in range(changes.size):
        if changes[index] > 0.0 or known_changed[index]:
            bricks.revisions[index] = revision
            _collapse(bricks, index)


@kernel
def needed_tiers(tiers, needed):
    """The tier (n,) that each own brick must have to hold the result: the highest that is present in its row."""
    for b in range(tiers.shape[0]):
        highest = UNIFORM
        for j in range(tiers.shape[1]):
            if tiers[b, j] != ABSENT and tiers[b, j] > highest:
                highest = tiers[b, j]
        needed[b] = highest


@kernel
def sum_evidence(addresses, tiers, count_tiers_offset, scales, num_classes, targets, target_tiers):
    """The sum over robots of log q for each brick, written to ``targets`` (n,) addresses: the oracle.

    ``addresses`` and ``tiers`` (n, N) are the robots' evidence; columns N.. hold the scan counts where
    ``count_tiers_offset`` is N, and -1 means that the evidence is multiplied by ``scales`` (N,).
    """
    robots = scales.size
    total = np.empty(BRICK_CELLS, dtype=np.float32)
    term = np.empty(BRICK_CELLS, dtype=np.float32)
    counts = np.empty(BRICK_CELLS, dtype=np.float32)
    for b in range(addresses.shape[0]):
        width = num_classes if target_tiers[b] == VECTOR else 1
        cells = 1 if target_tiers[b] == UNIFORM else BRICK_CELLS
        for c in range(width):
            total[:] = np.float32(0.0)
            for r in range(robots):
                count_column = count_tiers_offset + r if count_tiers_offset >= 0 else -1
                _load_evidence(
                    term[:cells], addresses[b], tiers[b], r, count_column, scales[r], c, counts[:cells], num_classes
                )
                for i in range(cells):
                    total[i] += term[i]
            out = carray(_float_pointer(targets[b] + c * BRICK_CELLS * 4), (cells,))
            for i in range(cells):
                out[i] = total[i]


# --- metrics ---------------------------------------------------------------------------------------------------------


@kernel
def _brick_labels(address, tier, prior, num_classes, labels, best, row):
    """Argmax class (512,) of a brick and its log-odds; free is 0, ties go to the lower id."""
    labels[:] = 0
    best[:] = np.float32(0.0)
    width = num_classes if tier == VECTOR else 1
    for c in range(width):
        _load(row, address, tier, c, num_classes)
        for i in range(BRICK_CELLS):
            value = row[i] + prior
            higher = value > best[i]
            labels[i] = np.uint8(c + 1) if higher else labels[i]
            best[i] = value if higher else best[i]


@kernel
def compare_maps(addresses, tiers, known, link_ends, prior, num_classes, distances, counts, entropies):
    """Each brick's part of the metrics, for N robots (columns 0..N-1 of ``addresses``) and the oracle (column N).

    ``known`` (n, N, 64) are the robots' masks and ``link_ends`` (L, 2) the links' robots. Outputs per brick:
    ``distances`` (n, 2): sum of squared differences over the links, and over all pairs of robots;
    ``counts`` (n, 3 + 3 N): cells known to any robot, those that the oracle calls occupied, those with differing
    labels; then per robot known cells, agreeing cells, agreeing cells that the oracle calls occupied;
    ``entropies`` (n, N): sum over the robot's known cells in nats.
    """
    robots = known.shape[1]
    labels = np.empty((robots + 1, BRICK_CELLS), dtype=np.uint8)
    best = np.empty(BRICK_CELLS, dtype=np.float32)
    best_oracle = np.empty(BRICK_CELLS, dtype=np.float32)
    rows = np.empty((robots, BRICK_CELLS), dtype=np.float32)
    row = np.empty(BRICK_CELLS, dtype=np.float32)
    oracle = np.empty((num_classes + 1, BRICK_CELLS), dtype=np.float32)
    seen = np.empty((robots, BRICK_CELLS), dtype=np.bool_)
    powers = np.empty(BRICK_CELLS, dtype=np.int32)
    scales = powers.view(np.float32)
    exps = np.empty(BRICK_CELLS, dtype=np.float32)
    total = np.empty(BRICK_CELLS, dtype=np.float32)
    weighted = np.empty(BRICK_CELLS, dtype=np.float32)
    for b in range(addresses.shape[0]):
        for r in range(robots):
            _brick_labels(addresses[b, r], tiers[b, r], prior, num_classes, labels[r], best, row)
            for byte in range(64):
                bits = known[b, r, byte]
                for j in range(8):
                    seen[r, byte * 8 + j] = (bits >> j) & 1
            width = num_classes if tiers[b, r] == VECTOR else 1
            terms = np.float32(1.0) if tiers[b, r] == VECTOR else np.float32(num_classes)
            for i in range(BRICK_CELLS):
                exps[i] = -best[i]
            _exp_negative(exps, total, powers, scales)
            weighted[:] = np.float32(0.0)
            for c in range(width):
                _load(row, addresses[b, r], tiers[b, r], c, num_classes)
                for i in range(BRICK_CELLS):
                    row[i] += prior - best[i]
                _exp_negative(row, exps, powers, scales)
                for i in range(BRICK_CELLS):
                    total[i] += terms * exps[i]
                    weighted[i] += terms * exps[i] * (row[i] + best[i])
            entropy = 0.0
            for i in range(BRICK_CELLS):
                if seen[r, i]:
                    entropy += best[i] + np.log(total[i]) - weighted[i] / total[i]
            entropies[b, r] = entropy
        _brick_labels(addresses[b, robots], tiers[b, robots], prior, num_classes, labels[robots], best_oracle, row)
        oracle[0, :] = np.float32(0.0)
        for c in range(num_classes):
            _load(oracle[c + 1], addresses[b, robots], tiers[b, robots], c, num_classes)
            for i in range(BRICK_CELLS):
                oracle[c + 1, i] += prior
        counts[b, :] = 0
        for i in range(BRICK_CELLS):
            anyone = False
            first = labels[0, i] if seen[0, i] else 255
            differs = False
            for r in range(robots):
                anyone |= seen[r, i]
                differs |= (labels[r, i] if seen[r, i] else 255) != first
            if not anyone:
                continue
            occupied = labels[robots, i] > 0
            counts[b, 0] += 1
            counts[b, 1] += occupied
            counts[b, 2] += differs
            for r in range(robots):
                if seen[r, i]:
                    agrees = oracle[labels[r, i], i] >= best_oracle[i] - np.float32(1e-3)
                    counts[b, 3 + 3 * r] += 1
                    counts[b, 4 + 3 * r] += agrees
                    counts[b, 5 + 3 * r] += agrees and occupied
        _brick_distances(addresses[b], tiers[b], link_ends, num_classes, rows, row, weighted, total, distances[b])


@kernel
def _brick_distances(
    addresses, tiers, link_ends, num_classes, rows, mean, over_links, over_pairs, distances
):  # fmt: skip
    """Squared differences of one brick, summed over the links and over all pairs: N sum_i ||h_i - mean||^2."""
    robots = rows.shape[0]
    width = 1
    for r in range(robots):
        if tiers[r] == VECTOR:
            width = num_classes
    over_links[:] = np.float32(0.0)
    over_pairs[:] = np.float32(0.0)
    for c in range(width):
        mean[:] = np.float32(0.0)
        for r in range(robots):
            _load(rows[r], addresses[r], tiers[r], c, num_classes)
        # Differences to robot 0 are exact where the maps are close, which a mean of large values would not be.
        for r in range(1, robots):
            for i in range(BRICK_CELLS):
                mean[i] += rows[r, i] - rows[0, i]
        for i in range(BRICK_CELLS):
            mean[i] /= np.float32(robots)
        for r in range(robots):
            for i in range(BRICK_CELLS):
                difference = (rows[r, i] - rows[0, i]) - mean[i]
                over_pairs[i] += difference * difference
        for k in range(link_ends.shape[0]):
            a, z = link_ends[k, 0], link_ends[k, 1]
            for i in range(BRICK_CELLS):
                difference = rows[a, i] - rows[z, i]
                over_links[i] += difference * difference
    repeats = num_classes if width == 1 else 1
    distances[0] = over_links.sum() * repeats
    distances[1] = over_pairs.sum() * repeats * robots


# --- packets ---------------------------------------------------------------------------------------------------------


@kernel
def _group_state(low, high, states, start, tolerance, num_classes):
    """State of the node whose eight children are ``start``..: what its parent's word says of it.

    ``low`` and ``high`` (C, n) bound the children's values, and get the node's own bounds at ``start``.
    """
    known = 0
    leaves = 0
    vector = False
    for k in range(8):
        state = states[start + k]
        known += state != CHILD_UNKNOWN
        leaves += state >= CHILD_SCALAR
        vector |= state == CHILD_VECTOR
    if known == 0:
        return CHILD_UNKNOWN
    if leaves < 8:
        return CHILD_INNER
    for c in range(num_classes):
        least, most = low[c, start], high[c, start]
        for k in range(1, 8):
            least = min(least, low[c, start + k])
            most = max(most, high[c, start + k])
        if most - least > tolerance:
            return CHILD_INNER
    for c in range(num_classes):
        for k in range(1, 8):
            low[c, start] = min(low[c, start], low[c, start + k])
            high[c, start] = max(high[c, start], high[c, start + k])
    return CHILD_VECTOR if vector else CHILD_SCALAR


@kernel
def _write_leaf(state, low, high, place, scalars, vectors, totals):
    """Append one leaf's value: the middle of its bounds, which is exact where they are equal."""
    if state == CHILD_SCALAR:
        scalars[totals[1]] = low[0, place] + (high[0, place] - low[0, place]) / np.float32(2.0)
        totals[1] += 1
    else:
        for c in range(vectors.shape[1]):
            vectors[totals[2], c] = low[c, place] + (high[c, place] - low[c, place]) / np.float32(2.0)
        totals[2] += 1


@kernel
def _word(states, start):
    """The 16-bit word of a node: two bits for each of its eight children, the first in the lowest bits."""
    word = 0
    for k in range(8):
        word |= np.int64(states[start + k]) << (2 * k)
    return np.uint16(word)


@kernel
def _load_cells(bricks, index, low, cells):
    """Values of a brick's cells (C, 512) and the state of each cell; returns how many classes have their own values."""
    tier = bricks.tiers[index]
    cells[:] = CHILD_SCALAR
    if tier == UNIFORM:
        low[0, :] = bricks.values[index]
    elif tier == SCALAR:
        low[0, :] = bricks.scalar[bricks.rows[index]]
    else:
        low[0, :] = bricks.vector[bricks.rows[index], 0]
        for c in range(1, low.shape[0]):
            row = bricks.vector[bricks.rows[index], c]
            for i in range(BRICK_CELLS):
                low[c, i] = row[i]
                cells[i] |= np.uint8(row[i] != low[0, i])
    if not _all_known(bricks.known[index]):
        for byte in range(64):
            for j in range(8):
                if (bricks.known[index, byte] >> j) & 1 == 0:
                    cells[8 * byte + j] = CHILD_UNKNOWN
    return low.shape[0] if tier == VECTOR else 1


@kernel
def _reduce(low, high, states, limit, width, low_out, high_out, states_out):
    """The nodes one level up: their bounds and states from those of their eight children each."""
    for k in range(states_out.size):
        states_out[k] = _group_state(low, high, states, 8 * k, limit, width)
        for c in range(width):
            low_out[c, k] = low[c, 8 * k]
            high_out[c, k] = high[c, 8 * k]


@kernel
def encode_bricks(bricks, order, prune, tolerance, words, scalars, vectors):
    """Write the octree over the bricks ``order`` (n,), sorted by code, in depth-first order.

    ``words`` gets 16 bits per inner node, two for each child; ``scalars`` and ``vectors`` (m, C) the leaves' values.
    Eight leaves that differ by at most ``tolerance`` are one leaf; nothing is merged without ``prune``.
    Returns the number of words, scalars and vectors.
    """
    num_classes = bricks.vector.shape[1]
    limit = tolerance if prune else np.float32(-1.0)
    low = np.empty((num_classes, BRICK_CELLS), dtype=np.float32)
    low8 = np.empty((num_classes, 64), dtype=np.float32)
    low64 = np.empty((num_classes, 8), dtype=np.float32)
    # The bounds of a node's values; without a tolerance they are equal, and one array serves as both.
    lossy = limit > np.float32(0.0)
    high = np.empty_like(low) if lossy else low
    high8 = np.empty_like(low8) if lossy else low8
    high64 = np.empty_like(low64) if lossy else low64
    cells = np.empty(BRICK_CELLS, dtype=np.uint8)
    eights = np.empty(64, dtype=np.uint8)
    groups = np.empty(8, dtype=np.uint8)
    totals = np.zeros(3, dtype=np.int64)
    # The open nodes from the root down: where each one's word stands, what was written before it, its children.
    starts = np.zeros((BRICK_DEPTH + 1, 3), dtype=np.int64)
    states = np.zeros((BRICK_DEPTH + 1, 8), dtype=np.uint8)
    node_low = np.zeros((BRICK_DEPTH + 1, num_classes, 8), dtype=np.float32)
    node_high = np.zeros((BRICK_DEPTH + 1, num_classes, 8), dtype=np.float32)
    for n in range(order.size):
        index = order[n]
        code = bricks.codes[index]
        first = 0
        if n > 0:
            difference = code ^ bricks.codes[order[n - 1]]
            while difference >> (3 * (BRICK_DEPTH - 1 - first)) == 0:
                first += 1
            for depth in range(BRICK_DEPTH - 1, first, -1):
                _close(depth, bricks.codes[order[n - 1]], limit, starts, states, node_low, node_high,
                       words, scalars, vectors, totals)  # fmt: skip
            first += 1
        for depth in range(first, BRICK_DEPTH):
            starts[depth, :] = totals
            states[depth, :] = CHILD_UNKNOWN
            totals[0] += 1
        parent = BRICK_DEPTH - 1
        place = code & 7
        if bricks.tiers[index] == UNIFORM and prune:
            state = CHILD_SCALAR if bricks.known[index, 0] else CHILD_UNKNOWN
            node_low[parent, :, place] = bricks.values[index]
            node_high[parent, :, place] = bricks.values[index]
        else:
            width = _load_cells(bricks, index, low, cells)
            if lossy:
                high[:width, :] = low[:width, :]
            _reduce(low, high, cells, limit, width, low8, high8, eights)
            _reduce(low8, high8, eights, limit, width, low64, high64, groups)
            state = _group_state(low64, high64, groups, 0, limit, width)
            for c in range(num_classes):
                node_low[parent, c, place] = low64[c if width > 1 else 0, 0]
                node_high[parent, c, place] = high64[c if width > 1 else 0, 0]
        states[parent, place] = state
        if state >= CHILD_SCALAR:
            _write_leaf(state, node_low[parent], node_high[parent], place, scalars, vectors, totals)
        elif state == CHILD_INNER:
            words[totals[0]] = _word(groups, 0)
            totals[0] += 1
            for g in range(8):
                if groups[g] >= CHILD_SCALAR:
                    _write_leaf(groups[g], low64, high64, g, scalars, vectors, totals)
                elif groups[g] == CHILD_INNER:
                    words[totals[0]] = _word(eights, 8 * g)
                    totals[0] += 1
                    for e in range(8 * g, 8 * g + 8):
                        if eights[e] >= CHILD_SCALAR:
                            _write_leaf(eights[e], low8, high8, e, scalars, vectors, totals)
                        elif eights[e] == CHILD_INNER:
                            words[totals[0]] = _word(cells, 8 * e)
                            totals[0] += 1
                            for i in range(8 * e, 8 * e + 8):
                                if cells[i] != CHILD_UNKNOWN:
                                    _write_leaf(cells[i], low, high, i, scalars, vectors, totals)
    if order.size > 0:
        for depth in range(BRICK_DEPTH - 1, -1, -1):
            _close(depth, bricks.codes[order[order.size - 1]], limit, starts, states, node_low, node_high,
                   words, scalars, vectors, totals)  # fmt: skip
    return totals


@kernel
def _close(depth, code, limit, starts, states, node_low, node_high, words, scalars, vectors, totals):
    """Finish the open node at ``depth`` above the brick ``code``: write its word, or make it one leaf."""
    width = node_low.shape[1]
    state = CHILD_INNER
    if depth > 0:
        state = _group_state(node_low[depth], node_high[depth], states[depth], 0, limit, width)
        parent, place = depth - 1, (code >> (3 * (BRICK_DEPTH - depth))) & 7
        states[parent, place] = state
        node_low[parent, :, place] = node_low[depth, :, 0]
        node_high[parent, :, place] = node_high[depth, :, 0]
    if state == CHILD_INNER:
        words[starts[depth, 0]] = _word(states[depth], 0)
        return
    totals[:] = starts[depth]
    if state >= CHILD_SCALAR:
        _write_leaf(state, node_low[depth - 1], node_high[depth - 1], place, scalars, vectors, totals)


@kernel
def walk_leaves(words, codes, depths, is_vector):
    """The leaves of a depth-first octree: Morton code of their lowest cell, depth and kind, (L,) each.

    Returns the number of leaves, or -1 when the words are no octree of at most L leaves.
    """
    if words.size == 0:
        return 0
    path_word = np.zeros(KEY_BITS + 1, dtype=np.int64)
    path_child = np.zeros(KEY_BITS + 1, dtype=np.int64)
    path_code = np.zeros(KEY_BITS + 1, dtype=np.int64)
    count = 0
    used = 1
    depth = 0
    path_word[0] = words[0]
    while depth >= 0:
        child = path_child[depth]
        if child == 8:
            depth -= 1
            continue
        path_child[depth] = child + 1
        state = (path_word[depth] >> (2 * child)) & 3
        code = path_code[depth] | child << (3 * (KEY_BITS - 1 - depth))
        if state == CHILD_INNER:
            if depth == KEY_BITS - 1 or used == words.size:
                return -1
            depth += 1
            path_word[depth] = words[used]
            path_child[depth] = 0
            path_code[depth] = code
            used += 1
        elif state >= CHILD_SCALAR:
            if count == codes.size:
                return -1
            codes[count] = code
            depths[count] = depth + 1
            is_vector[count] = state == CHILD_VECTOR
            count += 1
    return count if used == words.size else -1


@kernel
def fill_from_leaves(bricks, codes, depths, is_vector, scalars, vectors):
    """Write leaves (L,) into an octree without bricks. Room must be there."""
    num_scalars, num_vectors = 0, 0
    last_code, index = np.int64(-1), np.int64(-1)
    for n in range(codes.size):
        span = np.int64(1) << (3 * (KEY_BITS - depths[n]))
        brick_code = codes[n] >> 9
        if depths[n] <= BRICK_DEPTH:
            for k in range(span >> 9):
                index = add_brick(bricks, brick_code + k)
                bricks.known[index, :] = 255
                if is_vector[n]:
                    _make_vector(bricks, index)
                    for c in range(vectors.shape[1]):
                        bricks.vector[bricks.rows[index], c, :] = vectors[num_vectors, c]
                else:
                    bricks.values[index] = scalars[num_scalars]
        else:
            if brick_code != last_code:
                index = add_brick(bricks, brick_code)
                last_code = brick_code
                _make_scalar(bricks, index)
            start = codes[n] & 511
            if is_vector[n]:
                _make_vector(bricks, index)
            for i in range(start, start + span):
                bricks.known[index, i >> 3] |= np.uint8(1 << (i & 7))
            row = bricks.rows[index]
            if is_vector[n]:
                for c in range(vectors.shape[1]):
                    for i in range(start, start + span):
                        bricks.vector[row, c, i] = vectors[num_vectors, c]
            elif bricks.tiers[index] == VECTOR:
                for c in range(vectors.shape[1]):
                    for i in range(start, start + span):
                        bricks.vector[row, c, i] = scalars[num_scalars]
            else:
                for i in range(start, start + span):
                    bricks.scalar[row, i] = scalars[num_scalars]
        if is_vector[n]:
            num_vectors += 1
        else:
            num_scalars += 1
