"""Boxes around the cells of a page against NumPy's quantiles."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.mapping.octree import keys_to_codes
from octoreplay.report.page.layers import Bounds
from support.long_suite import examples

cells = st.lists(st.tuples(*[st.integers(-300, 300)] * 3), max_size=40)


@examples(100)
@given(st.lists(cells, min_size=1, max_size=4), st.integers(1, 5))
def test_boxes_do_not_depend_on_the_parts_of_a_map(ticks: list[list[tuple[int, int, int]]], num_parts: int) -> None:
    bounds = Bounds(0.5)
    for part in range(num_parts):
        for index, keys in enumerate(ticks):
            bounds.add(index, keys_to_codes(np.array(keys[part::num_parts], np.int64).reshape(-1, 3)))
    everything = np.array([key for keys in ticks for key in keys], np.int64).reshape(-1, 3)
    if not len(everything):
        assert not np.isfinite(bounds.low).any()
        assert (bounds.near.tolist(), bounds.far.tolist()) == ([-1.0] * 3, [1.0] * 3)
        return
    assert bounds.low.tolist() == (everything.min(axis=0) * 0.5).tolist()
    assert bounds.high.tolist() == ((everything.max(axis=0) + 1) * 0.5).tolist()
    near, far = np.quantile([keys for keys in ticks if keys][-1], (0.01, 0.99), axis=0)
    np.testing.assert_allclose(bounds.near, near * 0.5)
    np.testing.assert_allclose(bounds.far, (far + 1) * 0.5)
