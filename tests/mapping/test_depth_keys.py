"""Keys and kinds of a depth image's pixels: float32 with a bound on the error gives what float64 gives."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from octoreplay.mapping.kernels import ends
from octoreplay.records import read_only
from support.long_suite import long

HEIGHT, WIDTH = 3, 70
CAMERA = np.array([32.0, 16.0, 35.0, 1.0])
CUT = 255


def _runs(depth_image, depth_unit, labels, pose, resolution, min_range, max_range):
    """Keys (n, 3) and kinds (n,) of the pixels that carry information, from the runs of the kernel."""
    size = depth_image.size + 1
    keys, kinds, lengths = np.empty((3, size), np.int32), np.empty(size, np.uint8), np.empty(size, np.int32)
    shape, counters = (ends.NUM_SCRATCH_ROWS, WIDTH + 1), np.zeros(2, np.int64)
    largest = float(np.iinfo(depth_image.dtype).max) if depth_image.dtype == np.uint16 else np.inf
    ends.depth_to_runs(
        depth_image, depth_unit, read_only(labels), CAMERA, pose, resolution, min_range, max_range, largest,
        np.empty(0), np.empty(0), read_only(np.empty(0, np.uint8)), np.empty((0, 4, 6)), np.empty(shape, np.float32),
        np.empty(shape), np.empty(shape, np.int32), keys, kinds, lengths, np.empty(size, np.int32), np.empty((0, 3)),
        np.empty((0, 3), np.int32), counters,
    )  # fmt: skip
    num_runs = counters[ends.NUM_RUNS]
    return np.repeat(keys[:, :num_runs].T, lengths[:num_runs], 0), np.repeat(kinds[:num_runs], lengths[:num_runs])


def _expected(depth_image, depth_unit, labels, pose, resolution, min_range, max_range):
    """The same in float64, with numpy."""
    x = (np.arange(WIDTH) - CAMERA[2]) / CAMERA[0]
    y = ((np.arange(HEIGHT) - CAMERA[3]) / CAMERA[1])[:, None]
    z = depth_image.astype(np.float64) * depth_unit
    squares = x * x + (y * y + 1.0)
    distances = z * z * squares
    is_cut = distances > max_range * max_range
    z = np.where(is_cut, max_range / np.sqrt(squares), z)
    is_used = (depth_image > 0) & ((distances >= min_range * min_range) | is_cut)
    coords = [z * (row[0] * x + row[2] + row[1] * y) + row[3] for row in pose[:3]]
    keys = np.floor(np.stack(coords, -1) / resolution).astype(np.int64)
    return keys[is_used], np.where(is_cut, CUT, labels)[is_used]


@st.composite
def _scans(draw):
    """A depth image whose points often lie on borders of cells or range limits, or one ulp beside them."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    resolution = draw(st.sampled_from([0.05, 0.1, 0.2, 0.25, 1 / 3, 0.7]))
    pose = np.eye(4)
    if draw(st.booleans()):
        pose[:3, :3] = np.eye(3)[rng.permutation(3)] * rng.choice([-1.0, 1.0], 3)[:, None]
    else:
        pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    cells = rng.integers(-(2 ** draw(st.integers(0, 17))), 2 ** draw(st.integers(0, 17)), 3)
    pose[:3, 3] = np.nextafter(cells * resolution, draw(st.sampled_from([-np.inf, 0.0, np.inf])))
    if draw(st.booleans()):
        pose[:3, 3] += rng.uniform(-1.0, 1.0, 3) * resolution
    walls = rng.integers(1, 40, (HEIGHT, WIDTH)) * resolution * draw(st.sampled_from([0.5, 1.0, 2.0]))
    if draw(st.booleans()):
        walls[:] = walls[:, :1]
    if draw(st.booleans()):
        depth_image, depth_unit = np.rint(walls / 0.001).clip(0, 65535).astype(np.uint16), 0.001
    else:
        depth_image = walls.astype(np.float32)
        beside = np.nextafter(depth_image, np.float32(draw(st.sampled_from([0.0, np.inf]))))
        depth_image, depth_unit = np.where(rng.random(walls.shape) < 0.5, beside, depth_image), 1.0
        depth_image[rng.random(walls.shape) < 0.1] = draw(st.sampled_from([np.nan, np.inf, -1.0, 1e-30, 1e-44]))
    depth_image[:, rng.integers(0, WIDTH, 8)] = 0
    depth_image = np.where(np.isfinite(depth_image), depth_image, 0).astype(depth_image.dtype)
    # A limit that is the depth of a pixel straight ahead is met exactly.
    measured = float(depth_image[1, 35]) * depth_unit
    max_range = draw(st.sampled_from([2.0, 10.0, 300.0]) | st.just(max(measured, 0.5)))
    min_range = draw(st.sampled_from([0.0, 0.3, 1.5]) | st.just(measured))
    labels = rng.integers(0, 4, (HEIGHT, WIDTH)).astype(np.uint8).repeat(2, 1)[:, :WIDTH].copy()
    return depth_image, depth_unit, labels, pose, resolution, min(min_range, max_range), max_range


@long
@settings(max_examples=150, deadline=None)
@given(_scans())
def test_keys_and_kinds_are_those_of_float64(scan):
    keys, kinds = _runs(*scan)
    expected_keys, expected_kinds = _expected(*scan)
    np.testing.assert_array_equal(kinds, expected_kinds)
    np.testing.assert_array_equal(keys, expected_keys)
