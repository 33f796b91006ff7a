"""Intervals of cells on the Morton curve, against their single cells."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.evaluate.morton_intervals import bounding_box, common_intervals
from octoreplay.mapping.octree import LeafSpans, codes_to_keys, keys_to_codes
from support.long_suite import examples

cell_intervals = st.lists(st.tuples(st.integers(0, 300), st.integers(1, 200)), min_size=1, max_size=5)


@examples(100)
@given(
    intervals=cell_intervals,
    offset=st.sampled_from([0, 64, 512 * 7, int(keys_to_codes(np.zeros((1, 3), np.int64))[0])]),
)
def test_the_box_of_intervals_is_that_of_their_cells(intervals, offset) -> None:
    codes = np.array([first + offset for first, _ in intervals], np.int64)
    counts = np.array([count for _, count in intervals], np.int64)
    all_keys = codes_to_keys(np.concatenate([np.arange(c, c + n) for c, n in zip(codes, counts, strict=True)]))
    low, high = bounding_box(codes, counts)
    np.testing.assert_array_equal(low, all_keys.min(axis=0))
    np.testing.assert_array_equal(high, all_keys.max(axis=0))


def test_leaves_as_large_as_the_octree_are_not_expanded() -> None:
    size = 1 << 57
    world = LeafSpans(np.array([0]), np.array([size]), np.zeros((1, 2), np.float32))
    cell = LeafSpans(np.array([size - 9]), np.array([1]), np.ones((1, 2), np.float32))
    intervals = common_intervals(world, cell)
    assert intervals.codes.tolist() == [0, size - 9, size - 8]
    assert intervals.num_cells.tolist() == [size - 9, 1, 8]
    assert intervals.leaves_a.tolist() == [0, 0, 0]
    assert intervals.leaves_b.tolist() == [-1, 0, -1]
    low, high = bounding_box(intervals.codes, intervals.num_cells)
    assert (low.tolist(), high.tolist()) == ([-(1 << 18)] * 3, [(1 << 18) - 1] * 3)


def test_empty_maps_and_maps_far_apart() -> None:
    nothing = LeafSpans(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2), np.float32))
    one = LeafSpans(np.array([8]), np.array([8]), np.zeros((1, 2), np.float32))
    far = LeafSpans(np.array([1 << 50]), np.array([64]), np.zeros((1, 2), np.float32))
    assert common_intervals(nothing, nothing).codes.size == 0
    assert common_intervals(one, nothing).leaves_a.tolist() == [0]
    intervals = common_intervals(one, far)
    assert (intervals.leaves_a.tolist(), intervals.leaves_b.tolist()) == ([0, -1], [-1, 0])
    assert intervals.num_cells.tolist() == [8, 64]
